"""The methods of the sizes study: what a network sees of a picture and of its lens."""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from sizes_scene import SIZE
from torch import Tensor, nn

from darswin import create_model
from darswin.lens import Lens
from darswin.models import LensAdapter
from darswin.views import make_view

WIDEST = math.radians(96)  # the θ_max of grids with absolute θ, more than that of every test lens
MEAN, STD = 0.5, 0.25  # of the pixels, for the networks
TYPICAL = 2.5  # m, the distance around which networks start


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        model, options: the name and the options for `create_model`.
        view: the name of the view that the model sees; None means that it takes the pictures.
        scale: the side of the view, in sides of the pictures.
        rays: the viewing direction of each pixel is the input of three more channels.
        absolute: the square or the grid ends at `WIDEST` for every lens, not at θ_max of the lens.
        uses_lens: False if the results do not depend on the lens.
    """

    model: str
    options: dict[str, Any] = field(default_factory=dict)
    view: str | None = None
    view_options: dict[str, Any] = field(default_factory=dict)
    scale: float = 1.0
    rays: bool = False
    absolute: bool = False
    uses_lens: bool = True


_CONV, _END = "conv_unet_nano", math.radians(87.5)
_PLAIN: dict[str, Any] = dict(options=dict(rays=False))
# A perspective view of all that a lens sees, up to 175°.
_UNDISTORTED: dict[str, Any] = dict(reach=_END, theta_max=_END, supersampling=1)
METHODS = {
    "raw": Method(_CONV, **_PLAIN, uses_lens=False),
    "raw + rays": Method(_CONV),
    "undistorted": Method(_CONV, **_PLAIN, view="perspective", view_options=_UNDISTORTED),
    "equirectangular": Method(_CONV, **_PLAIN, view="equirectangular"),
    "LensAdapter": Method(_CONV, **_PLAIN, view="square"),
    "LensAdapter + rays": Method(_CONV, **_PLAIN, view="square", rays=True),
    "LensAdapter, absolute θ": Method(_CONV, **_PLAIN, view="square", absolute=True),
    "LensAdapter, absolute θ, 1.5 times larger": Method(
        _CONV, **_PLAIN, view="square", absolute=True, scale=1.5
    ),
    "DarSwin-Unet A": Method("darswin_unet_a_nano"),
    "DarSwin-Unet RA": Method("darswin_unet_ra_nano"),
    "DarSwin-Unet RA, absolute θ": Method("darswin_unet_ra_nano", absolute=True),
}


def pixel_directions(lens: Lens, size: tuple[int, int]) -> Tensor:
    """The viewing directions (x, y, z) of the pixels, (N, H, W, 3); NaN where no ray lands."""
    rows, columns = (torch.arange(side, dtype=lens.theta_max.dtype) for side in size)
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    return lens.unproject_points(pixels[None], size)


class Measurer(nn.Module):
    """A method's network: images uint8 (B, H, W, 3) and B lenses → distances (B, 1, H, W), m."""

    def __init__(self, method: Method):
        super().__init__()
        self.method = method
        # The same directions for all lenses, as in Depth Any Camera (CVPR 2025).
        same = method.absolute or method.view == "equirectangular"
        grid = dict(theta_max=WIDEST) if method.absolute and method.view is None else {}
        self.network: nn.Module = create_model(
            method.model, task="distance", in_chans=6 if method.rays else 3,
            typical_distance=TYPICAL, **method.options, **grid,
        )  # fmt: skip
        if method.view:
            side = round(method.scale * SIZE)
            options = method.view_options | (dict(fov=2 * WIDEST) if same else {})
            view = make_view(method.view, side, **options, mean=None, std=None)
            self.network = LensAdapter(self.network, view=view)

    def forward(self, images: Tensor, lens: Lens) -> Tensor:
        x = (images.permute(0, 3, 1, 2) / 255 - MEAN) / STD
        if self.method.rays:
            rays = pixel_directions(lens, x.shape[2:]).nan_to_num().movedim(-1, 1)
            x = torch.cat((x, rays.expand(len(x), -1, -1, -1)), 1)
        return self.network(x, lens)
