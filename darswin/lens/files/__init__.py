"""Calibration files: ten formats are read, four are written."""
