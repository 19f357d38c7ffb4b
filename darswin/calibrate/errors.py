"""The error of a calibration that the pictures do not allow."""


class CalibrationError(ValueError):
    """Pictures do not determine a lens; its message is one plain sentence for the user."""
