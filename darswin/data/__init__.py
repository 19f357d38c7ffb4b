"""Data: images seen through lenses."""

from darswin.data import labels
from darswin.data.augment import RandAugment
from darswin.data.cameras import Calibrations
from darswin.data.framing import FullSize, fitted
from darswin.data.lens_distributions import LEVELS, PolynomialLenses, SphericalLenses
from darswin.data.pictures import open_source
from darswin.data.sample import Sample
from darswin.data.samples import Calibrated
from darswin.data.scenes import open_scenes
from darswin.data.scenes.dataset import SceneSamples
from darswin.data.scenes.scene import Scenes
from darswin.data.turns import RandomTurns
from darswin.data.wide_angle import WideAngle
from darswin.utils.tasks import IGNORE

__all__ = [
    "IGNORE",
    "LEVELS",
    "Calibrated",
    "Calibrations",
    "FullSize",
    "PolynomialLenses",
    "RandAugment",
    "RandomTurns",
    "Sample",
    "SceneSamples",
    "Scenes",
    "SphericalLenses",
    "WideAngle",
    "fitted",
    "labels",
    "open_scenes",
    "open_source",
]
