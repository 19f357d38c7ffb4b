"""Data: images seen through lenses."""

from darswin.data.warp import LEVELS, warp, warp_map

__all__ = ["LEVELS", "warp", "warp_map"]
