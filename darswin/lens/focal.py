"""Lenses with a focal length."""

import math
from typing import ClassVar, Self

import torch
from torch import Tensor

from darswin.lens.base import Lens
from darswin.lens.batch import Number


class FocalLens(Lens, register=False):
    """Base of the lenses whose only length is the focal length: r = f u(θ).

    Args:
        focal: f > 0, px. Others: as `Lens`.
    """

    parameters: ClassVar[tuple[str, ...]] = ("focal",)
    lengths = ("focal",)
    bounds: ClassVar = {"focal": (1e-9, math.inf)}
    focal: Tensor

    def _validate(self) -> None:
        self._require("focal", (self.focal > 0) & self.focal.isfinite(), "finite and above 0")

    @classmethod
    def from_fov(cls, *arguments: Number, **named: Number | None) -> Self:
        """The lens whose full field of view fills a circle.

        Args:
            arguments: the model's parameters but `focal`, in the order of its constructor, then
                `fov`, rad, the full field of view, `radius`, px, of the circle, and `center`, as
                `Lens` has it.
            named: any of them by name, also `affine`, `image_size` and what is optional.

        Raises what the constructor does.
        """
        own = tuple(name for name in cls.parameters if name != "focal")
        order = (*own, "fov", "radius", "center")
        given = dict(zip(order, arguments, strict=False)) | named
        missing = sorted({*own, "fov", "radius"} - given.keys())
        if missing or len(arguments) > len(order) or named.keys() & {*order[: len(arguments)]}:
            raise TypeError(
                f"{cls.__name__}.from_fov takes {', '.join(order)}, got {len(arguments)} without "
                f"a name and {', '.join(named) or 'none'} by name"
            )
        rows = cls._expanded({name: value for name, value in given.items() if value is not None})
        theta_max, radius = rows.pop("fov") / 2, rows.pop("radius")
        unit = rows | {"focal": torch.ones_like(radius), "theta_max": theta_max}
        focal = cls._from_tensors(unit)._scale_to(radius)
        return cls(**rows, focal=focal, theta_max=theta_max)

    def _scale_to(self, radius: Tensor) -> Tensor:
        """(N,): how many times larger the lens must be for θ_max to land at a radius."""
        return radius / self.r_max
