"""Calibration: from pictures of boards to a lens."""

from darswin.calibrate.boards import Board, find_corners
from darswin.calibrate.calibration import Calibration, CalibrationError, calibrate

__all__ = ["Board", "Calibration", "CalibrationError", "calibrate", "find_corners"]
