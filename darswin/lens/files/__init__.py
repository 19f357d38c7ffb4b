"""Calibration files: those of other tools are read, our own JSON is read and written."""

from darswin.lens.files.load import load, load_all, loads, save

__all__ = ["load", "load_all", "loads", "save"]
