"""Lenses: where a ray at incident angle θ and azimuth φ lands in the image, and back.

Every lens is a batch, differentiable in its parameters, and works beyond 90° where its model does.
"""

from darswin.lens.base import MODELS, Lens
from darswin.lens.batch import Number
from darswin.lens.curves import Tabulated, as_curves, cat
from darswin.lens.description import from_dict, to_dict
from darswin.lens.distorted import BrownConrady, Fisheye624, KannalaBrandt, Mei
from darswin.lens.files import load, load_all, save
from darswin.lens.fitting import Fit, fit
from darswin.lens.ideal import (
    Equidistant,
    Equisolid,
    FieldOfView,
    Orthographic,
    Perspective,
    Stereographic,
)
from darswin.lens.polynomial import OCam, OCamInverse, Polynomial
from darswin.lens.sphere import DoubleSphere, EnhancedUnified, Spherical

__all__ = [
    "MODELS", "BrownConrady", "DoubleSphere", "EnhancedUnified", "Equidistant", "Equisolid",
    "FieldOfView", "Fisheye624", "Fit", "KannalaBrandt", "Lens", "Mei", "Number", "OCam",
    "OCamInverse", "Orthographic", "Perspective", "Polynomial", "Spherical", "Stereographic",
    "Tabulated", "as_curves", "cat", "fit", "from_dict", "load", "load_all", "save", "to_dict",
]  # fmt: skip
