"""Calibration: from pictures of boards, or of straight lines, to a lens."""

from darswin.calibrate.boards import Board, find_corners
from darswin.calibrate.calibrated import CalibratedLens
from darswin.calibrate.inputs import CalibrationError
from darswin.calibrate.lines import Estimate, estimate
from darswin.calibrate.search import calibrate

__all__ = [
    "Board", "CalibratedLens", "CalibrationError", "Estimate", "calibrate", "estimate",
    "find_corners",
]  # fmt: skip
