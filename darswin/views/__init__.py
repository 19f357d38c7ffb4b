"""What a network sees of a picture through a lens: one file for each view, registered by name."""

from darswin.views.base import (
    PixelGrid,
    PixelView,
    PolarGrid,
    Prepared,
    View,
    list_views,
    make_view,
    register_view,
)
from darswin.views.perspective import PerspectiveView
from darswin.views.plain import PlainView
from darswin.views.polar import PolarSample, PolarView, polar_grid
from darswin.views.square import SquareView

__all__ = [
    "PerspectiveView",
    "PixelGrid",
    "PixelView",
    "PlainView",
    "PolarGrid",
    "PolarSample",
    "PolarView",
    "Prepared",
    "SquareView",
    "View",
    "list_views",
    "make_view",
    "polar_grid",
    "register_view",
]
