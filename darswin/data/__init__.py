"""Data: images seen through lenses."""

from darswin.data.warp import LEVELS, warp

__all__ = ["LEVELS", "warp"]
