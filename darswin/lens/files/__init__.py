"""Calibration files: those of ten formats are read, those of four written."""

from darswin.lens.files.load import load, load_all, save

__all__ = ["load", "load_all", "save"]
