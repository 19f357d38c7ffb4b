"""Lens models. A lens maps rays, at incident angle θ and azimuth φ, to pixels, and pixels to rays.

Every lens is a batch, is differentiable in its parameters, and works beyond 90° if its model does.
"""

from darswin.lens.base import MODELS, Lens, from_dict, to_dict
from darswin.lens.curves import Tabulated, cat
from darswin.lens.distorted import BrownConrady, Fisheye624, KannalaBrandt, Mei
from darswin.lens.files.load import load, load_all, load_up
from darswin.lens.files.save import save
from darswin.lens.fitting import Fit, fit
from darswin.lens.ideal import (
    Equidistant,
    Equisolid,
    FieldOfView,
    Orthographic,
    Perspective,
    Stereographic,
)
from darswin.lens.parameter import Number
from darswin.lens.pixels import distance_to_z, pixel_rays, z_to_distance
from darswin.lens.plausible import ImplausibleLens
from darswin.lens.polynomial import OCam, OCamInverse, Polynomial
from darswin.lens.sphere import DoubleSphere, EnhancedUnified, Spherical

__all__ = [
    "MODELS", "BrownConrady", "DoubleSphere", "EnhancedUnified", "Equidistant", "Equisolid",
    "FieldOfView", "Fisheye624", "Fit", "ImplausibleLens", "KannalaBrandt", "Lens", "Mei", "Number",
    "OCam", "OCamInverse", "Orthographic", "Perspective", "Polynomial", "Spherical",
    "Stereographic", "Tabulated", "cat", "distance_to_z", "fit", "from_dict", "load",
    "load_all", "load_up", "pixel_rays", "save", "to_dict",
    "z_to_distance",
]  # fmt: skip
