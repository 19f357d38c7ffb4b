"""A convolutional U-Net that reads the ray of each pixel: a baseline for the dense models."""

from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.models.base import check_given_once, view_of_model
from darswin.models.features import FeatureInfo
from darswin.models.pixel import RAYS, PixelModel, with_rays
from darswin.models.prepared import Prepared
from darswin.models.registry import Presets, register_model
from darswin.utils.tasks import PixelTask
from darswin.views import View
from darswin.views.base import Pair, PerChannel, check_count

# About as many parameters as "darswin_unet_a" of the same size.
_SIZES: Presets = dict(
    small=dict(widths=(88, 176, 352, 704, 1408)),
    tiny=dict(widths=(64, 128, 256, 512, 1024)),
    micro=dict(widths=(40, 80, 160, 320)),
    nano=dict(widths=(15, 30, 60, 120)),
)


class ConvBlock(nn.Sequential):
    """Two 3×3 convolutions, each followed by a batch norm and a ReLU."""

    def __init__(self, in_chans: int, width: int):
        layers: list[nn.Module] = []
        for channels in (in_chans, width):
            conv = nn.Conv2d(channels, width, 3, padding=1, bias=False)
            layers += [conv, nn.BatchNorm2d(width), nn.ReLU(inplace=True)]
        super().__init__(*layers)


@register_model("conv_unet", presets={}, sizes=_SIZES)
class ConvUnet(PixelModel):
    """A class or a distance for every pixel: a convolutional U-Net on the images, or on a view.

    The result is that of a `Unet`. Each level halves the resolution. Beside the colours, the first
    level reads the viewing direction (x, y, z) of each pixel, or zeros where no ray lands. That is
    the simplest way to tell a network about its lens, so it is a baseline for the other models.

    The images have any size. By default the network sees them as they are. With another view, it
    sees the pixels of the view and their viewing directions, and its logits go back to the images.

    Args:
        num_classes: the number of classes; "distance" ignores it.
        in_chans: C, the number of channels of the images.
        task: "segmentation" or "distance".
        widths: the number of channels of each level.
        rays: False leaves the viewing directions out; with the view "none", the model then ignores
            its lens.
        typical_distance: the distance, in m, around which "distance" starts.
        view: what the network sees of the images through their lenses: a `View`, or the name of
            one, `list_views()`, of `size` and with its own defaults. "none" takes the images as
            they are.
        size: (H', W') of a view by name, or the side of a square; "none" ignores it.
        mean, std: normalization of uint8 images, `(pixel/255 - mean) / std`, by default with 0 and
            1, unless a `View` has them; images in floating point are not normalized.

    Raises:
        ValueError: a width or another option is wrong, or the view is of several pictures.

    Source: Ronneberger et al., MICCAI 2015; with padding, batch norm and bilinear upsampling. The
        rays as channels are those of CAM-Convs, CVPR 2019, in another parametrization.
    """

    stages = ()

    def __init__(
        self,
        num_classes: int = 10,
        in_chans: int = 3,
        *,
        task: PixelTask = "segmentation",
        widths: Sequence[int] = (15, 30, 60, 120),
        rays: bool = True,
        typical_distance: float = 10.0,
        view: str | View = "none",
        size: int | Pair | None = None,
        mean: PerChannel | None = None,
        std: PerChannel | None = None,
    ):
        super().__init__(task, typical_distance)
        if min(widths, default=0) < 1:
            raise ValueError(f"widths must be at least 1, for at least one level, got {widths}")
        self.in_chans, self.reads_rays = in_chans, rays
        if isinstance(view, View):
            check_given_once(size=size)
        self.view = view_of_model(view, None if view == "none" else size, in_chans, mean, std)
        self.goes_back = self.view.uses_lens
        self.feature_info = FeatureInfo(
            dict(num_chs=width, reduction=2**level, module=f"down.{level}", map_size=None)
            for level, width in enumerate(widths)
        )
        self.down = nn.ModuleList(
            ConvBlock(before, width)
            for before, width in pairwise((in_chans + (RAYS if rays else 0), *widths))
        )
        self.up = nn.ModuleList(ConvBlock(fine + coarse, fine) for fine, coarse in pairwise(widths))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._make_head(num_classes, dim=widths[0])
        self.pretrained_cfg = dict(
            num_classes=self.num_classes, input_size=(in_chans, 128, 128), fixed_input_size=False,
            mean=self.mean, std=self.std, interpolation="bilinear", crop_pct=1.0,
            first_conv="down.0.0", classifier=f"{task}_head.proj",
        )  # fmt: skip

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Tensor:
        if prepared.rays is not None:
            check_count(prepared.rays.shape[0], x.shape[0])
        x = with_rays(x, prepared.rays)
        x = x.contiguous(memory_format=torch.channels_last)
        maps: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(F.max_pool2d(x, 2, ceil_mode=True) if level else x)
            maps.append(x)
        for skip, block in zip(maps[-2::-1], reversed(self.up), strict=True):
            x = F.interpolate(x, skip.shape[2:], mode="bilinear", align_corners=False)
            x = block(torch.cat((x, skip), 1))
        logits = self.head.proj(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
        return self.head.finish(self.view.back(logits, prepared.view), prepared.view.shown)
