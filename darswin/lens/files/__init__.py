"""Calibration files: seventeen formats are read, four are written."""
