"""Pictures of lenses, grids and results."""
