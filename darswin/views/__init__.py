"""What a network sees of a picture through a lens: one file for each view, registered by name."""

import importlib
import pkgutil

from darswin.views.base import (
    PolarGrid,
    View,
)
from darswin.views.camera import CameraView
from darswin.views.crop import CropView
from darswin.views.cylindrical import CylindricalView
from darswin.views.directions import RayView
from darswin.views.equirectangular import EquirectangularView
from darswin.views.ground import GroundView
from darswin.views.mercator import MercatorView
from darswin.views.orientation import turned, up_of
from darswin.views.panorama import PanoramaView
from darswin.views.perspective import PerspectiveView
from darswin.views.pixels import PixelView
from darswin.views.plain import PlainView
from darswin.views.polar import PolarView
from darswin.views.registry import list_views, make_view, register_view
from darswin.views.remap import Remap
from darswin.views.square import SquareView
from darswin.views.stereographic import StereographicView
from darswin.views.tiles import TilesView
from darswin.views.turn import Turn

__all__ = [
    "CameraView",
    "CropView",
    "CylindricalView",
    "EquirectangularView",
    "GroundView",
    "MercatorView",
    "PanoramaView",
    "PerspectiveView",
    "PixelView",
    "PlainView",
    "PolarGrid",
    "PolarView",
    "RayView",
    "Remap",
    "SquareView",
    "StereographicView",
    "TilesView",
    "Turn",
    "View",
    "list_views",
    "make_view",
    "register_view",
    "turned",
    "up_of",
]

for _module in pkgutil.iter_modules(__path__):  # each registers its view
    importlib.import_module(f"{__name__}.{_module.name}")
