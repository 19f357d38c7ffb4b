"""Data: images seen through lenses."""

from darswin.data.calibrated import Calibrated
from darswin.data.calibrations import Calibrations
from darswin.data.datasets import open_source
from darswin.data.dense import DenseSamples
from darswin.data.lenses import LEVELS, PolynomialLenses, SphericalLenses, parse_lenses
from darswin.data.scenes import IGNORE, Scene, Scenes, open_scenes
from darswin.data.warp import warp, warp_map
from darswin.data.wide_angle import WideAngle

__all__ = [
    "IGNORE",
    "LEVELS",
    "Calibrated",
    "Calibrations",
    "DenseSamples",
    "PolynomialLenses",
    "Scene",
    "Scenes",
    "SphericalLenses",
    "WideAngle",
    "open_scenes",
    "open_source",
    "parse_lenses",
    "warp",
    "warp_map",
]
