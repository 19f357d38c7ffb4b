"""Calibration files: those of ten formats are read, those of four written."""
