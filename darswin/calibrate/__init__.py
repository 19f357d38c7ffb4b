"""Calibration: from pictures of a board to a lens."""

from darswin.calibrate.boards import Board, find_corners

__all__ = ["Board", "find_corners"]
