"""The base of the models that predict a class or a distance for every pixel, and their heads."""

import math
from typing import Any, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.overrides import handle_torch_function, has_torch_function_unary

from darswin.layers.linear import Linear
from darswin.models.base import Model, init_by_width
from darswin.utils.tasks import PixelTask

# exp(±8): distances lie between 1/3000 of the typical distance and 3000 times that distance.
LARGEST_EXPONENT = 8.0
RAYS = 3  # the channels of viewing directions


def with_rays(images: Tensor, rays: Tensor | None) -> Tensor:
    """Images (B, C, H, W) and the viewing directions of their pixels, (B or 1, 3, H, W), joined."""
    if rays is None:
        return images
    rays = rays.to(images).expand(images.shape[0], -1, -1, -1)
    return torch.cat((images, rays), 1)


class PixelHead(nn.Module):
    """The last map of a network → K logits of each pixel, refined by the pixels of the image.

    With a `skip_width`, that many channels of the map are resampled to the pixels, and convolutions
    join them with the image, which may have rays as more channels. Without it, only the logits are
    resampled.
    """

    # A linear layer before the resampling gives the same as one after it, at less cost.

    def __init__(self, dim: int, channels: int, in_chans: int, skip_width: int):
        super().__init__()
        self.skip_width = skip_width
        if skip_width:
            self.carry = Linear(dim, skip_width)
            self.stem = nn.Conv2d(in_chans, skip_width, 3, padding=1)
            self.mix = nn.Conv2d(skip_width, skip_width, 3, padding=1)
        self.proj = Linear(skip_width or dim, channels)

    def carried(self, x: Tensor) -> Tensor:
        """The last map → the channels that are resampled to the pixels, channels last."""
        return self.carry(x) if self.skip_width else self.proj(x)

    def refine(self, carried: Tensor, images: Tensor | None) -> Tensor:
        """The carried channels at the pixels and the images (B, C, H, W) → logits (B, K, H, W)."""
        if not self.skip_width:
            return carried
        assert images is not None
        # With channels last, as in `carried`, convolutions of few channels take half the time.
        skip = self.stem(images.contiguous(memory_format=torch.channels_last))
        x = F.gelu(skip + carried.to(skip.dtype))
        x = x + F.gelu(self.mix(x))
        return self.proj(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)

    def finish(self, logits: Tensor, shown: Tensor | None = None) -> Tensor:
        """Logits (B, K, H, W) → the model's result; shown: see `PreparedPixels`."""
        return logits

    def extra_repr(self) -> str:
        return f"skip_width={self.skip_width}"


class DistanceHead(PixelHead):
    """Distances in m, `typical_distance` · e^x. x is bounded, so they are positive and finite; 0
    is unknown."""

    def __init__(self, dim: int, in_chans: int, skip_width: int, typical_distance: float):
        super().__init__(dim, 1, in_chans, skip_width)
        if not 0 < typical_distance < math.inf:
            raise ValueError(f"typical_distance must be above 0 m, got {typical_distance}")
        self.typical_distance = float(typical_distance)

    def finish(self, logits: Tensor, shown: Tensor | None = None) -> Tensor:
        """x (B, 1, H, W) → distances (B, 1, H, W) in m, in float32 or float64; 0 unless shown."""
        metres = distances(logits, self.typical_distance)
        return (
            metres if shown is None else torch.where(shown.to(metres.device)[:, None], metres, 0.0)
        )

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, typical_distance={self.typical_distance}"


def distances(x: Tensor, typical: float) -> Tensor:
    """The distances of a `DistanceHead`, in m, in float32 or float64."""
    if has_torch_function_unary(x):
        return handle_torch_function(distances, (x,), x, typical)
    x = x.to(torch.promote_types(x.dtype, torch.float32))
    return typical * torch.exp(LARGEST_EXPONENT * torch.tanh(x / LARGEST_EXPONENT))


class PixelModel(Model[Tensor]):
    """The base of `Unet` and `ConvUnet`: a model whose head predicts every pixel.

    A subclass makes the rest of the network and then calls `_make_head`.

    Attributes:
        task: "segmentation" or "distance".
        segmentation_head or distance_head: the part that makes the result from the last map.
    """

    task: PixelTask
    in_chans: int

    def __init__(self, task: PixelTask, typical_distance: float):
        super().__init__()
        if task not in get_args(PixelTask):
            raise ValueError(f"task must be one of {get_args(PixelTask)}, got {task!r}")
        self.task, self._typical_distance = task, typical_distance

    def _make_head(
        self, num_classes: int, dim: int, in_chans: int = 0, skip_width: int = 0
    ) -> None:
        if skip_width < 0:
            raise ValueError(f"skip_width must be at least 0, got {skip_width}")
        self._head_options = dict(dim=dim, in_chans=in_chans, skip_width=skip_width)
        self.reset_classifier(num_classes)

    @property
    def head(self) -> PixelHead:
        """`segmentation_head` or `distance_head`."""
        return self.get_submodule(f"{self.task}_head")  # type: ignore[return-value]

    def get_classifier(self) -> nn.Module:
        """The head, the same as `head`."""
        return self.head

    def reset_classifier(self, num_classes: int) -> None:
        """Replaces the head by a new one for `num_classes` classes; "distance" ignores the number.

        The new head has the dtype, the device and the matmul backend of the model.

        Raises:
            ValueError: there is less than one class.
        """
        options: dict[str, Any] = self._head_options
        like = next(self.parameters())
        head: PixelHead
        if self.task == "distance":
            self.num_classes = 1
            head = DistanceHead(typical_distance=self._typical_distance, **options)
        elif num_classes < 1:
            raise ValueError(f"num_classes must be at least 1, got {num_classes}")
        else:
            self.num_classes = num_classes
            head = PixelHead(channels=num_classes, **options)
        head.apply(init_by_width)
        self.add_module(f"{self.task}_head", head.to(like).train(self.training))
