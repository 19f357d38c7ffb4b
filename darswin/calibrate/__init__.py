"""Calibration: from pictures of boards to a lens."""

from darswin.calibrate.calibration import Calibration, CalibrationError, calibrate

__all__ = ["Calibration", "CalibrationError", "calibrate"]
