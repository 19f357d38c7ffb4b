"""Data: images seen through lenses."""

from darswin.data.augment import RandAugment
from darswin.data.cameras import Calibrations
from darswin.data.lens_distributions import LEVELS, PolynomialLenses, SphericalLenses
from darswin.data.pictures import open_source
from darswin.data.reframing import Moved, RandomTurns, Reframing, Turn, Warped, at_size, reframe
from darswin.data.sample import Sample
from darswin.data.samples import Calibrated
from darswin.data.scenes import open_scenes
from darswin.data.scenes.dataset import SceneSamples
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import IGNORE
from darswin.data.warping import FullSize, lens_at_size, warp_map
from darswin.data.wide_angle import WideAngle

__all__ = [
    "IGNORE",
    "LEVELS",
    "Calibrated",
    "Calibrations",
    "FullSize",
    "Moved",
    "PolynomialLenses",
    "RandAugment",
    "RandomTurns",
    "Reframing",
    "Sample",
    "SceneSamples",
    "Scenes",
    "SphericalLenses",
    "Turn",
    "Warped",
    "WideAngle",
    "at_size",
    "lens_at_size",
    "open_scenes",
    "open_source",
    "reframe",
    "warp_map",
]
