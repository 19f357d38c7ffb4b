"""Figures of lenses, grids and results."""
