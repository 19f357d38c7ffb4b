"""The seam between lenses and networks: what a view is."""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Self, TypeVar, cast

import numpy as np
import torch
from torch import Tensor, nn

from darswin.lens import Lens
from darswin.ops._library import autocast_dtype
from darswin.ops.checks import (
    FRAME_CHANNELS,
    channels_first,
    check_has_batch,
    per_channel,
    readable,
)
from darswin.ops.reference import normalized

Pair = tuple[int, int]
PerChannel = float | Sequence[float]


class PolarGrid(NamedTuple):
    """The points at which `polar_sample` reads the images of N lenses, and the ring borders.

    Shapes: radii (N, R·S_r) px, azimuths (A·S_φ,) rad, center (N or 1, 2) px, borders (N, R+1) px,
    last (N,) rad, the angle at the end of the last ring; for general lenses also affine
    (N or 1, 2, 2) and offsets (N or 1, 2, R·S_r, A·S_φ) px.
    """

    radii: Tensor
    azimuths: Tensor
    center: Tensor
    borders: Tensor
    last: Tensor
    affine: Tensor | None = None
    offsets: Tensor | None = None


class PixelGrid(NamedTuple):
    """The arguments of `polar_to_image` that resample a polar map to the pixels of the images.

    Shapes: radii of the ring centres (N, R) px; r_max (N,) px; for radial lenses center
    (N or 1, 2) px and affine (N, 2, 2), for general lenses points (N, H, W, 2) px; for a single
    lens also plan (1, H, 3, W).
    """

    radii: Tensor
    r_max: Tensor
    center: Tensor | None = None
    affine: Tensor | None = None
    points: Tensor | None = None
    plan: Tensor | None = None


class PreparedPixels(NamedTuple):
    """What a view of pixels needs of N lenses, for images of one size.

    - `size`: (H, W) of the images.
    - `points`: the points at which the view reads the images, k² for each of its pixels, (N, k·H',
      k·W', 2) px. None means that the view is the images.
    - `back`: the points of the view that the pixels of the images show, (N, H, W, 2) px. None means
      that the view is the images, or that the way back was not asked for.
    - `shown`: (N or 1, H, W), True for the pixels of the images that the view shows: elsewhere a
      network has no answer. None means all pixels, or that the way back was not asked for.
    - `around`: (N or 1,), True if the view goes all around, so that its first column follows its
      last. None means that none does.
    """

    size: Pair
    points: Tensor | None
    back: Tensor | None = None
    shown: Tensor | None = None
    around: Tensor | None = None

    @property
    def grid(self) -> None:
        """Only a polar view has a polar grid."""


class PreparedPolar(NamedTuple):
    """What a polar view needs of N lenses, for images of one size.

    `size` and `shown` are those of `PreparedPixels`. `grid` is where the view reads the images, and
    `back` brings polar maps to their pixels; None means that the way back was not asked for.
    """

    size: Pair
    grid: PolarGrid
    back: PixelGrid | None = None
    shown: Tensor | None = None


Prepares = TypeVar("Prepares", bound=Callable[..., Any])


def in_full_precision(method: Prepares) -> Prepares:
    """A method of a view, of a lens and a size, without autocast, whose matrix products would move
    points by pixels."""

    @functools.wraps(method)
    def run(self: Any, lens: Lens | None, size: Pair, **options: Any) -> Any:
        # Where autocast is off, there is no context: a graph would get one of its own.
        if not isinstance(lens, Lens) or autocast_dtype(lens.theta_max) is None:
            return method(self, lens, size, **options)
        with torch.autocast(lens.theta_max.device.type, enabled=False):
            return method(self, lens, size, **options)

    return cast(Prepares, run)


class View(nn.Module):
    """What a network sees of images through their lenses: pixels, or the tokens of a polar map.

    A view alone knows images and lenses. `view(images, lens)` is what the network sees. It has
    three steps of its own: `prepare`, `see` and `back`.

    Args:
        mean, std: normalization of uint8 images, `(pixel/255 - mean) / std`, one number or one for
            each channel. None refuses uint8 images. Images in floating point are not normalized.

    Raises:
        ValueError: one of mean and std is missing, their numbers of channels differ, or std is not
            above 0.

    Attributes:
        uses_lens: False if the view ignores its lens, which may then be None.
        in_pixels: True if the network sees pixels (B, C, H', W'), False for tokens (B, R, A, S).
        coordinates: the number of coordinates of a token's position.
        count: the number of pictures that the network sees of each image.
        made: the name, size and options by which `make_view` made the view; its class alone has
            None.
    """

    uses_lens = True
    in_pixels = True
    coordinates = 2
    count = 1
    made: dict[str, Any] | None = None

    def __init__(self, mean: PerChannel | None = 0.0, std: PerChannel | None = 1.0):
        super().__init__()
        if (mean is None) != (std is None):
            raise ValueError(f"mean and std must be given together, got {mean} and {std}")
        if mean is not None and std is not None:
            channels = max(len(tuple(v)) if isinstance(v, Iterable) else 1 for v in (mean, std))
            per_channel("mean", mean, channels), per_channel("std", std, channels)
        self.mean, self.std = mean, std

    def for_lens(self, lens: Lens | None, size: Pair) -> Self:
        """The same view for these N lenses alone, with what takes long to compute of them."""
        return self

    def _with(self, **values: Any) -> Self:
        """The same view with these attributes. Dynamo cannot trace `copy.copy` of a module."""
        view = object.__new__(type(self))
        view.__dict__.update(self.__dict__, **values)
        return view

    def prepare(self, lens: Lens | None, size: Pair, *, back: bool | Pair = True) -> Any:
        """Everything of N lenses that `see` and `back` need, a `PreparedPixels` or `PreparedPolar`.

        Args:
            lens: N lenses, or None if the view ignores its lens.
            size: (H, W) of the images.
            back: whether the way back is prepared; or the size of the maps that go back, if they
                are not of the size of what the network sees.

        Raises:
            TypeError: the lens is missing, and the view uses one.
            ValueError: the lens belongs to images of another size.
        """
        raise NotImplementedError

    def ray_channels(self, lens: Lens | None, size: Pair) -> Tensor:
        """The viewing directions of the pixels that a dense network predicts, (N, 3, h, w): of the
        pixels of the view, or of the images if the view has no pixels; 0 where no ray lands. Errors
        are those of `prepare`, also for a view that ignores its lens."""
        raise NotImplementedError

    def token_positions(self, lens: Lens | None, size: Pair) -> Tensor:
        """The positions of the tokens of a map of this size, (N or 1, H', W', `coordinates`)."""
        raise NotImplementedError

    def see(self, images: Tensor, prepared: Any, dtype: torch.dtype = torch.float32) -> Tensor:
        """Images (B, C, H, W) → what the network sees of them, in floating point.

        Args:
            prepared: the result of `prepare` for B lenses or one.
            dtype: of the result for images of uint8; polar tokens are at least float32.
        """
        raise NotImplementedError

    def back(self, maps: Tensor, prepared: Any) -> Tensor:
        """A map of the network → the pixels of the images, (B, K, H, W); 0 unless `shown`.

        Args:
            maps: (B, K, H', W') if the view is `in_pixels`, else (B, R, A, K). Values between
                pixels are interpolated; maps of integers, such as ids, give the nearest.
        """
        raise NotImplementedError

    def check_seen(self, sampled: Tensor, prepared: Any, channels: int | None) -> Tensor:
        """The result of `see` for images with C channels; TypeError or ValueError otherwise."""
        raise NotImplementedError

    def forward(
        self, images: Tensor, lens: Lens | None = None, channels_last: bool | None = None
    ) -> Tensor:
        """Images and their lenses (B or 1) → what the network sees.

        Args:
            images: (B, C, H, W) or (B, H, W, C).
            channels_last: the layout of the images; see `polar_sample`.
        """
        images = check_images(images, channels_last)
        height, width = images.shape[2:]
        return self.see(images, self.prepare(lens, (height, width), back=False))

    def floating(self, images: Tensor, dtype: torch.dtype) -> Tensor:
        """The images in floating point: uint8 images are normalized, others stay as they are."""
        if images.dtype == torch.uint8:
            return self.normalized(images, dtype)
        if not images.is_floating_point():
            raise TypeError(f"images must be uint8 or in floating point, got {images.dtype}")
        return images

    def normalized(self, images: Tensor, dtype: torch.dtype) -> Tensor:
        """`(image - mean) / std` for each channel, in `dtype`; uint8 images are divided by 255."""
        if self.mean is None or self.std is None:
            raise TypeError(
                f"images must be in floating point, got {images.dtype}: without mean and std, they "
                "cannot be normalized"
            )
        exact = torch.promote_types(dtype, torch.float32)
        mean = per_channel("mean", self.mean, images.shape[1])
        std = per_channel("std", self.std, images.shape[1])
        return normalized(images, mean, std, exact).to(dtype)


def check_images(
    images: Tensor, channels_last: bool | None = None, channels: int | None = None
) -> Tensor:
    """The images as (B, C, H, W); TypeError or ValueError if that fails, see `channels_first`."""
    if not isinstance(images, Tensor):
        raise TypeError(f"images must be a tensor, got {type(images).__name__}")
    check_has_batch("images", images, channels_last, channels)
    return channels_first("images", images, channels_last, channels)


def check_seen_images(sampled: Tensor, size: Pair, channels: int | None) -> Tensor:
    """What a view of (H, W) pixels sees, as (B, C, H, W); TypeError or ValueError otherwise."""
    sampled = check_images(sampled, channels=channels)
    if channels is not None and sampled.shape[1] != channels:
        raise ValueError(f"sampled must have {channels} channels, got {sampled.shape[1]}")
    if sampled.shape[2:] != size:
        raise ValueError(
            f"sampled must have the size of the view, (H, W) = {size}, "
            f"got {tuple(sampled.shape[2:])}"
        )
    return sampled


def size_of(view: View) -> Pair | None:
    """(H', W') of what a network sees by a view of pixels; None for a view of any images."""
    if not view.in_pixels:
        raise ValueError(f"the network needs a view of pixels, got {view}")
    size: Pair | None = getattr(view, "size", None) or getattr(view, "map_size", None)
    return size


def check_one_picture(view: View) -> None:
    """ValueError for a view that shows several pictures of each image."""
    if view.count != 1:
        raise ValueError(
            f"this model takes one picture of each image, but the view shows {view.count}: put a "
            "network behind them with LensAdapter"
        )


def check_lens(lens: Lens | None, size: Pair) -> Lens:
    """Returns the lens if it is one for images of (H, W); its size is checked if `readable`."""
    if not isinstance(lens, Lens):
        joined = "; lens.cat joins several" if isinstance(lens, list | tuple) else ""
        raise TypeError(f"lens must be a darswin.lens.Lens, got {type(lens).__name__}{joined}")
    if lens.image_size is None or not readable(lens.image_size):
        return lens
    for other in lens.image_size.unique(dim=0).tolist():
        if tuple(other) != size:
            advice = f"if the image was resized, use lens.resized({size})"
            if size[0] == other[1] and size[1] in FRAME_CHANNELS:
                advice = "the channels come first: pass images.permute(0, 3, 1, 2)"
            raise ValueError(
                f"the lens belongs to images of (H, W) = {tuple(round(s) for s in other)}, got "
                f"images of {size}; {advice}"
            )
    return lens


def check_count(lenses: int, images: int) -> None:
    """ValueError unless there is one lens for each image or one for all. Both numbers must come
    from shapes: `len` would fix the batch size of a graph."""
    if lenses not in (1, images):
        raise ValueError(
            f"there must be one lens, or one for each of the {images} images, got {lenses}"
        )


def form_of_frames(
    view: Any, output: str, mean: PerChannel | None, std: PerChannel | None
) -> dict[str, Any]:
    """The output of a plan, and its mean and std for each channel: those of a view if None."""
    from darswin.frames.plan_files import check_output

    check_output(output)
    mean, std = view.mean if mean is None else mean, view.std if std is None else std
    if output == "uint8":
        mean, std = 0.0, 1.0
    if mean is None or std is None:
        raise ValueError("frames are normalized: give the mean and the std of the network")
    channels = max(np.size(mean), np.size(std))
    each = {name: per_channel(name, v, channels) for name, v in (("mean", mean), ("std", std))}
    return {"output": output, **each}
