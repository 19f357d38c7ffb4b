"""Wide-angle and fisheye images for vision transformers, fast on CPUs."""

from importlib.metadata import version

from darswin import compat, lens, models, ops
from darswin.deploy.optimize import optimize
from darswin.layers.attention import PolarWindowAttention
from darswin.layers.grid import PolarGrid, polar_grid
from darswin.layers.sampling import PolarSample
from darswin.models import DarSwin, create_model, list_models

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
