"""The image of a lens: principal point, shape of the pixels, size, resizing and cropping."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from darswin.lens.batch import LensBatch
from darswin.lens.parameter import Parameter
from darswin.lens.solve import solve
from darswin.ops.checks import tensor_there
from darswin.utils.arrays import as_tensor
from darswin.utils.words import in_px

Size = tuple[int, int] | None  # (H, W) px


class LensInImage(LensBatch):
    """Lenses in their images: maps points around the principal point to pixels, and back."""

    theta_max = Parameter(low=0, open=True, optional=True, by_place=True, angle=True)
    center = Parameter(shape=(2,), optional=True, by_place=True)
    affine = Parameter(shape=(2, 2), optional=True)
    image_size = Parameter(low=1, shape=(2,), optional=True)

    def center_in(self, image_size: Size = None) -> Tensor:
        """(N or 1, 2) px: the principal point (x, y) in an image of (H, W)."""
        if self.center is not None:
            return self.center
        return (self._size_in(image_size).flip(1) - 1) / 2

    def _size_in(self, image_size: Size) -> Tensor:
        """(N or 1, 2): the given image size, or else the lens's own."""
        if image_size is not None:
            return tensor_there(image_size, self.theta_max)[None]
        if self.image_size is None:
            raise ValueError("this lens has no image_size and needs the image_size, (H, W)")
        return self.image_size

    def to_pixels(self, flat: Tensor, image_size: Size = None) -> Tensor:
        """Pixels of points (N, ..., 2) around the principal point, before `affine`."""
        return self.through_affine(flat) + self._row(self.center_in(image_size), flat.dim())

    def from_pixels(self, pixels: Tensor, image_size: Size = None) -> Tensor:
        """The inverse of `to_pixels`."""
        (pixels,) = self._aligned(pixels)
        flat = pixels - self._row(self.center_in(image_size), pixels.dim())
        # `torch.linalg.inv` would wait for the device, and ONNX has none.
        return flat if self.affine is None else solve(self._row(self.affine, flat.dim() + 1), flat)

    def through_affine(self, flat: Tensor) -> Tensor:
        """`affine` @ points or offsets (N or 1, ..., 2)."""
        if self.affine is None:
            return flat
        return (self._row(self.affine, flat.dim() + 1) @ flat[..., None])[..., 0]

    def resized(self, scale: float | Tensor | Sequence[int]) -> Self:
        """The same lens for an image resized like `cv2.resize` does.

        Args:
            scale: the factor, above 0; or, for a lens with an `image_size`, the new (H, W) in whole
                pixels, which is exact where the factor would be rounded.

        Warns:
            UserWarning: an (H, W) that looks like (W, H), which alone would keep the proportions.

        Raises:
            ValueError: a scale or side that is not positive, or an (H, W) for a lens without an
                image_size. TypeError: neither a number nor (H, W).
        """
        number, size = _plain(scale), self.image_size
        if isinstance(number, float):
            if not 0 < number < math.inf:
                raise ValueError(f"resized must be given a finite scale above 0, got {number}")
            size = None if size is None else (size * number).round().clamp(min=1)
            across = down = self.theta_max.new_tensor([number])
        elif size is None:
            raise ValueError(f"resized to (H, W) = {scale} needs a lens that has an image_size")
        else:
            given, own = _image_size(number), size[0].tolist()
            if not _same_shape(given, own, 0.02) and _same_shape(given[::-1], own, 0.02):
                text = f"the size {in_px(given)} changes the proportions of {in_px(own)}"
                warnings.warn(f"{text}, which {in_px(given[::-1])} keeps", stacklevel=2)
            before, size = size, self._sizes(given)
            down, across = (size / before).unbind(1)
        lens = self._scaled(across)
        lens.image_size = size
        if self.center is not None:
            lens.center = (self.center + 0.5) * torch.stack((across, down), -1) - 0.5
        if down is not across and bool((down != across).any()):
            rows = torch.stack((torch.ones_like(down), down / across), -1)
            lens.affine = rows[..., None] * self._affine()
        return lens

    def _affine(self) -> Tensor:
        """(N, 2, 2): `affine`, or else the identity."""
        if self.affine is not None:
            return self.affine
        eye = torch.eye(2, dtype=self.theta_max.dtype, device=self.theta_max.device)
        return eye.expand(self.count, 2, 2)

    def _sizes(self, size: tuple[int, int]) -> Tensor:
        """One size for all lenses, (N, 2)."""
        return tensor_there(size, self.theta_max).expand(self.count, 2)

    def in_picture(self, size: tuple[int, int]) -> Self:
        """The lens resized to a picture of (H, W); without an `image_size`, the lens itself.

        Raises:
            ValueError: the picture has another aspect ratio, by more than rounding of its sides.
        """
        if self.image_size is None:
            return self
        own = [round(side) for side in self.image_size[0].tolist()]
        if not _same_shape(size, own):
            turned = _same_shape(size[::-1], own)
            raise ValueError(
                f"the calibration is for {in_px(own)}, but the picture has {in_px(size)}: "
                + ("it looks turned by 90°, so turn it back" if turned else "crop the lens too")
            )
        return self if list(size) == own else self.resized(size)

    def _scaled(self, scale: Tensor) -> Self:
        """The same lens with all its lengths multiplied by `scale`, (N or 1,)."""
        lengths = {n: v for n, v in self._tensors().items() if self.declared[n].in_pixels}
        return self.replace(**{n: v * self._row(scale, v.dim()) for n, v in lengths.items()})

    def cropped(self, top: int, left: int, height: int, width: int) -> Self:
        """The same lens for a crop: `image[..., top:top + height, left:left + width]`.

        The crop may extend beyond the image, like padding: `cropped(-8, -8, H + 16, W + 16)`.

        Raises:
            ValueError: an empty crop, or a lens with neither a center nor an image_size.
            TypeError: a number that is not whole.
        """
        top, left = _whole((top, left))
        height, width = _image_size((height, width))
        center = self.center_in() - self.theta_max.new_tensor([left, top])
        size = self._sizes((height, width))
        return self.replace(center=center.expand(self.count, 2), image_size=size)


def _same_shape(size: Sequence[int], other: Sequence[float], part: float = 0.0) -> bool:
    """True if two sizes have the same ratio of sides, but for rounding, and a part of it."""
    across, down = size[0] * other[1], size[1] * other[0]  # px times the other side
    return abs(across - down) <= max(*other, part * down)


def _plain(value: Any) -> Any:
    """A number as a float, or several numbers as a list, from Python, NumPy or torch."""
    try:
        return as_tensor(value, torch.float64).tolist()
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"an image has whole pixels, got {value!r}") from error


def _whole(sides: Any) -> tuple[int, int]:
    """Two whole numbers of pixels."""
    numbers = _plain(sides)
    if not isinstance(numbers, list) or len(numbers) != 2:
        raise TypeError(f"an image's size must be (H, W), got {sides!r}")
    if not all(isinstance(number, float) and number.is_integer() for number in numbers):
        raise TypeError(f"an image has whole pixels, got {sides!r}")
    return int(numbers[0]), int(numbers[1])


def _image_size(size: Any) -> tuple[int, int]:
    """(H, W) of an image with one pixel or more."""
    height, width = _whole(size)
    if height < 1 or width < 1:
        raise ValueError(f"an image's (H, W) must be at least (1, 1), got {(height, width)}")
    return height, width
