"""Wide-angle and fisheye images for vision transformers, fast on CPUs."""

from importlib.metadata import version

from darswin import compat, lens, models, ops
from darswin.grid import PolarGrid, polar_grid
from darswin.layers import PolarSample, PolarWindowAttention
from darswin.models import DarSwin, create_model, list_models
from darswin.optimized import optimize

__version__ = version("darswin")

__all__ = [
    "DarSwin",
    "PolarGrid",
    "PolarSample",
    "PolarWindowAttention",
    "compat",
    "create_model",
    "lens",
    "list_models",
    "models",
    "ops",
    "optimize",
    "polar_grid",
]
