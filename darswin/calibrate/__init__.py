"""Calibration: from pictures of boards, or of straight lines, to a lens."""

from darswin.calibrate.boards import Board, find_corners
from darswin.calibrate.calibration import Calibration
from darswin.calibrate.inputs import CalibrationError
from darswin.calibrate.lines import Estimate, estimate
from darswin.calibrate.search import calibrate

__all__ = [
    "Board", "Calibration", "CalibrationError", "Estimate", "calibrate", "estimate",
    "find_corners",
]  # fmt: skip
