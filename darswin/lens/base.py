"""The base of all lens models: maps rays to pixels and pixels to rays, for a batch of lenses."""

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from darswin.lens.image import LensInImage, Size
from darswin.lens.parameter import Number
from darswin.lens.solve import direction_of, inverse, length_of, vector_of
from darswin.ops._library import no_gradients
from darswin.utils.arrays import as_tensor
from darswin.utils.nearest import did_you_mean

# A lens ends this far (rad) before the angle at which r stops rising or becomes infinite, where r
# does not determine θ.
MARGIN = 1e-6
# A field of view, or a θ_max from a file, that was rounded may exceed the limit by this, rad.
ROUNDING = 1e-4
IN_DEGREES = {"fov_deg": "fov", "theta_max_deg": "theta_max"}

# All lens models by name. Defining a class adds it.
MODELS: dict[str, type["Lens"]] = {}


class Lens(LensInImage):
    """Base of all lenses. A class declares each `Parameter` and defines `theta_limit`, `project`.

    A ray at incident angle θ and azimuth φ lands at

        (x, y) = center + affine @ (r(θ) (cos φ, sin φ) + offset(θ, φ)).

    Every lens is a batch: its parameters are tensors with one entry per lens. A plain number makes
    a batch of one. Parameters may require gradients; all methods are differentiable in them.

    Convention:
        θ is the angle from the optical axis, in [0, θ_max], rad; r is the distance from the
        principal point before `affine`, px. φ = 0 points right, π/2 down. Pixel centres are
        integers, x to the right and y down. The camera looks along z, with x right and y down.

    Every lens takes these arguments after its model's own parameters.

    Args:
        theta_max: in (0, theta_limit], rad, the widest angle that the lens is used for, at which
            the last ring of a polar grid ends. None means theta_limit.
        center: (x, y) or (N, 2) px, the principal point. None means the middle of the image.
        affine: (2, 2) or (N, 2, 2), for pixels that are skewed or not square. None means the
            identity.
        image_size: (H, W) or (N, 2), the size of the camera's images. None means any size: methods
            that need the middle of the image then take the size as an argument.

    Raises:
        ValueError: a parameter is out of its range. TypeError: an argument is not a number.
            Both messages name the parameter.

    Indexing gives lenses (`lens[3]` is a batch of one), `len` counts them, `cat` joins them, and
    a DataLoader batches a dataset's lenses like its tensors. Each class is added to `MODELS` under
    its name, unless it is defined with `register=False`, like the bases of several models.
    """

    terms: ClassVar[int] = 4  # the default number of polynomial terms for `fit`
    max_numbers: ClassVar[int] = 64  # the most numbers per parameter in a calibration file

    def __init_subclass__(cls, register: bool = True) -> None:
        super().__init_subclass__()
        if register:
            if cls.__name__ in MODELS:
                raise ValueError(f"a lens model {cls.__name__} exists already")
            MODELS[cls.__name__] = cls

    def __init__(self, *arguments: Number | None, **named: Number | None):
        super().__init__(*arguments, **named)
        for name in self._tensors():
            if name != "theta_max":  # checked below, together with its limit
                self._check(name)
        if self.affine is not None:
            self._require("affine", self.affine.detach().det() != 0, "invertible")
        self._validate()
        self._set_theta_max(self.theta_max)

    def _validate(self) -> None:
        """Raises ValueError for parameters that are in range but invalid together."""

    def _set_theta_max(self, wanted: Tensor | None, argument: str = "theta_max") -> None:
        """Checks and sets θ_max; None means `theta_limit`. Errors name the argument: "theta_max",
        or "fov", which is twice as large."""
        limit = self.theta_limit
        if not bool((limit > 0).all()):
            names = " and ".join(self.parameters)
            raise ValueError(f"{names} must be such that r rises with θ, got {self}")
        self.theta_max = limit if wanted is None else wanted
        if wanted is None:
            return
        times, kind = (2 if argument == "fov" else 1), self.declared["theta_max"]
        if not kind.holds(wanted):
            self._require(argument, (wanted > 0) & wanted.isfinite(), kind.range, times * wanted)
        if argument == "fov":
            wanted = self.theta_max = _without_rounding(wanted, limit)
        # A limit computed in another dtype differs by rounding; MARGIN is larger than that.
        slack = 1 + 2 * torch.finfo(limit.dtype).eps
        beyond = ~(wanted <= limit * slack)
        if bool(beyond.any()):
            # A θ_max beyond this dtype's limit is reduced; one beyond the model's is an error.
            exact = self.detach().to(torch.float64).theta_limit
            beyond &= ~(wanted <= exact * slack)
            if bool(beyond.any()):
                last = times * exact.detach()[beyond][0].item()
                end = f"where r of this {type(self).__name__} lens stops rising"
                range_ = f"at most {last:.6f} rad ({math.degrees(last):.2f}°), {end}"
                self._require(argument, ~beyond, range_, times * wanted)
        self.theta_max = torch.where(wanted > limit, limit, wanted)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """The same lens with another dtype or on another device; arguments: see `Tensor.to`."""
        lens = super().to(*args, **kwargs)
        # High powers of w overflow earlier in float32.
        if self.theta_max.dtype == torch.float64 and lens.theta_max.dtype == torch.float32:
            limit = lens.theta_limit
            lens.theta_max = torch.where(lens.theta_max > limit, limit, lens.theta_max)
        return lens

    def with_theta_max(self, theta_max: Number | None) -> Self:
        """The same lens with another θ_max, rad; None means `theta_limit`."""
        lens = self._map(lambda tensor: tensor)
        lens._set_theta_max(
            None if theta_max is None else self._aligned(theta_max)[0].expand(self.count)
        )
        return lens

    # -- the radial curve ---------------------------------------------------------------------

    def project(self, theta: Number) -> Tensor:
        """Radius r (px) at incident angle θ (rad): the radial curve, with a meaning up to θ_max.

        Args:
            theta: a number, or a tensor whose first dimension is the number of lenses or 1. For a
                single lens, a tensor of any shape.

        Returns:
            The shape of θ, with its first dimension broadcast to the number of lenses.
        """
        raise NotImplementedError

    def unproject(self, radius: Number) -> Tensor:
        """Incident angle θ (rad) at radius r (px): the inverse of `project`, with its shapes.

        NaN where no ray of [0, θ_max] lands: below 0, and beyond `r_max` by more than rounding.
        """
        (radius,) = self._aligned(radius)
        slack = 1 + 16 * torch.finfo(radius.dtype).eps
        with no_gradients():
            # In one call, which may be a search.
            ends = torch.stack((self.theta_max, self.theta_max * slack), 1)
            last, beyond = self.project(ends).unbind(1)
            # A little beyond θ_max, a model may have no radius or a smaller one.
            last = torch.where(beyond > last, beyond, last) * slack
            lands = (radius >= 0) & (radius <= self._row(last, radius.dim()))
        # Radii without an angle become 0: NaN would reach the gradients.
        return torch.where(lands, self._angle_at(torch.where(lands, radius, 0.0)), torch.nan)

    def _angle_at(self, radius: Tensor) -> Tensor:
        """θ at radii where rays land. Lenses with a closed-form inverse override this."""
        end = self._row(self.theta_max.detach(), radius.dim())
        return inverse(self.project, self._slope, radius, end)

    def _slope(self, theta: Tensor) -> Tensor:
        """dr/dθ at θ (N or 1, ...)."""
        return torch.func.jvp(self.project, (theta,), (torch.ones_like(theta),))[1]

    @property
    def theta_limit(self) -> Tensor:
        """(N,) rad: the largest angle of the model. Up to it, r rises and no two rays land on one
        pixel."""
        raise NotImplementedError

    @property
    def r_max(self) -> Tensor:
        """(N,) px: the radius of the image circle, at which θ_max lands."""
        return self.project(self.theta_max)

    def sees(self, theta: Tensor) -> Tensor:
        """True where θ (N or 1, ...), rad, is at most θ_max or larger by rounding only; False for
        NaN."""
        last = self.theta_max * (1 + 8 * torch.finfo(self.theta_max.dtype).eps)
        return theta <= self._row(last, theta.dim())

    # -- rays and pixels ----------------------------------------------------------------------

    @property
    def is_radial(self) -> bool:
        """True if rays keep their azimuth before `affine`: the lens has no `offset`."""
        return True

    def offset(self, theta: Tensor, direction: Tensor) -> Tensor:
        """(..., 2) px: the displacement of rays from the radial curve, before `affine`;
        direction: (N or 1, ..., 2), cos φ and sin φ."""
        return torch.zeros_like(theta)[..., None] * direction

    def project_rays(self, theta: Number, azimuth: Number, image_size: Size = None) -> Tensor:
        """Pixels (x, y), (..., 2) px, at which rays (θ, φ) land; NaN beyond θ_max.

        θ and φ, rad, broadcast; their shapes are those of `project`. image_size: (H, W).
        """
        (theta,), (azimuth,) = self._aligned(theta), self._aligned(azimuth)
        return self.seen_pixels(theta, direction_of(azimuth), image_size)

    def unproject_pixels(self, pixels: Tensor, image_size: Size = None) -> tuple[Tensor, Tensor]:
        """Rays (θ, φ) that land at pixels (x, y): the inverse of `project_rays`.

        Pixels are (N or 1, ..., 2) px; for a single lens (..., 2). image_size: (H, W). Returns θ
        and φ, (N, ...) rad. θ is NaN where no ray lands.
        """
        theta, direction = self.theta_and_direction(pixels, image_size)
        return theta, torch.atan2(direction[..., 1], direction[..., 0])

    def project_points(self, points: Tensor, image_size: Size = None) -> Tensor:
        """Pixels at which points (x, y, z) in camera coordinates are seen.

        Args:
            points: (N or 1, ..., 3), for a single lens (..., 3), in any unit of length: x to the
                right, y down, z forward. The distance of a point does not matter.
            image_size: (H, W).

        Returns:
            (N, ..., 2) px; NaN for points beyond θ_max and for (0, 0, 0).
        """
        (points,) = self._aligned(points)
        across, down, ahead = points.square().unbind(-1)  # not `sum`, as in `length_of`
        length = across + down + ahead
        # Like `length_of`, this has a gradient on the axis, for any unit of length.
        eps, tiny = torch.finfo(points.dtype).eps, torch.finfo(points.dtype).tiny
        least = (1e-12 * eps * length).clamp(min=tiny)
        aside = torch.maximum(across + down, least).sqrt()
        theta = torch.atan2(aside, points[..., 2])
        theta = torch.where(length > 0, theta, torch.nan)
        return self.seen_pixels(theta, points[..., :2] / aside[..., None], image_size)

    def unproject_points(self, pixels: Tensor, image_size: Size = None) -> Tensor:
        """Unit vectors (x, y, z), (N, ..., 3), towards the points seen at pixels: the inverse of
        `project_points`. NaN where no ray lands. Arguments: see `unproject_pixels`."""
        return vector_of(*self.theta_and_direction(pixels, image_size))

    def theta_and_direction(self, pixels: Tensor, image_size: Size = None) -> tuple[Tensor, Tensor]:
        """`unproject_pixels` with (cos φ, sin φ), (N, ..., 2), in place of φ. At the principal
        point this is (0, 0) and has a gradient."""
        flat = self.from_pixels(pixels, image_size)
        radius = length_of(flat)
        theta, direction = self.unproject(radius), flat / radius[..., None]
        if self.is_radial:
            return theta, direction
        return self._find_rays(flat, theta, direction)

    def _find_rays(self, flat: Tensor, theta: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The rays of a lens with an `offset` that land at points (N, ..., 2) before `affine`;
        theta, direction: the rays that would land there without the offset."""
        raise NotImplementedError

    def pixels(self, theta: Tensor, direction: Tensor, image_size: Size = None) -> Tensor:
        """`project_rays` with (cos φ, sin φ), (N or 1, ..., 2), in place of φ: the inverse of
        `theta_and_direction`. θ must be at most θ_max; `seen_pixels` takes any θ."""
        return self.to_pixels(self._flat(theta, direction), image_size)

    def seen_pixels(self, theta: Tensor, direction: Tensor, image_size: Size = None) -> Tensor:
        """`pixels`, but NaN where θ is NaN or beyond θ_max. Gradients are finite."""
        seen = self.sees(theta)
        inside = torch.where(seen, theta, self._row(self.theta_max, theta.dim()))
        return torch.where(seen[..., None], self.pixels(inside, direction, image_size), torch.nan)

    def _flat(self, theta: Tensor, direction: Tensor) -> Tensor:
        flat = self.project(theta)[..., None] * direction
        return flat if self.is_radial else flat + self.offset(theta, direction)

    def side_angles(self, image_size: Size = None) -> Tensor:
        """(N, 4) rad: θ at the image's left, upper, right and lower side.

        Each is taken on the row or column of the principal point. It is `theta_limit` where the
        image extends beyond the lens.
        """
        cx, cy = self.center_in(image_size).expand(self.count, 2).unbind(1)
        height, width = self._size_in(image_size).unbind(1)
        low = torch.full_like(cx, -0.5)
        right, below = (width - 0.5).expand_as(cx), (height - 0.5).expand_as(cy)
        pixels = torch.stack((low, cy, cx, low, right, cy, cx, below), 1).unflatten(1, (4, 2))
        whole = self.with_theta_max(None)
        theta = whole.theta_and_direction(pixels, image_size)[0]
        return torch.where(theta.isnan(), whole.theta_max[:, None], theta)

    def _rotated_terms(self, turn: Tensor) -> dict[str, Tensor]:
        """The parameters that change when the image is rotated or mirrored around the principal
        point by `turn`, (2, 2) and orthogonal."""
        return {}


def from_dict(description: Mapping[str, Any], image_size: Size = None) -> Lens:
    """Makes the lens that a JSON object describes.

    Args:
        description: {"model": "Spherical", "xi": 0.5, "focal": 300, "theta_max": 1.5}: a name in
            `MODELS` and the arguments of its constructor, rad and px. For models with a focal
            length, "fov" may replace "focal" and "theta_max": the full field of view, rad, which
            then fills the largest circle inside the image. "fov_deg" and "theta_max_deg" take
            degrees. "supported", which calibration files may have, is no part of the lens.
        image_size: (H, W) px of the lens's images, which "fov" requires.

    Raises:
        ValueError: an unknown model, or arguments that the model lacks or that are out of range.
    """
    if not isinstance(description, Mapping):
        raise ValueError(f"a lens must be a JSON object, got {description!r}")
    arguments = dict(description)
    arguments.pop("supported", None)
    for in_degrees, angle in IN_DEGREES.items():
        if in_degrees in arguments:
            return _from_degrees(arguments, in_degrees, angle, image_size)
    name = arguments.pop("model", None)
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(unknown_model(name))
    make: Callable[..., Lens] = MODELS[name]
    if "fov" in arguments and hasattr(make, "from_fov"):
        size = image_size or arguments.get("image_size")
        if size is None:
            raise ValueError('a lens with "fov" needs the image_size, (H, W)')
        make = functools.partial(make.from_fov, radius=min(size) / 2)
    try:
        return make(**arguments)
    except TypeError as error:
        raise ValueError(f"a {name} lens cannot be made from {arguments}: {error}") from error


def unknown_model(name: object) -> str:
    """What to say of a name that is not in `MODELS`, with the name that was probably meant."""
    meant, models = did_you_mean(str(name), MODELS), ", ".join(sorted(MODELS))
    return f"unknown lens model {repr(name)[:80]}{meant} The models are {models}"


def _from_degrees(arguments: dict[str, Any], in_degrees: str, angle: str, image_size: Size) -> Lens:
    """`from_dict` of a description with an angle in degrees, which its errors name."""
    if angle in arguments:
        raise ValueError(f"{angle} and {in_degrees} must not both be given")
    value = arguments.pop(in_degrees)
    if isinstance(value, bool) or not isinstance(value, (int, float, Tensor)):
        raise ValueError(f"{in_degrees} must be a number of degrees, got {value!r}")
    radians = torch.deg2rad(value) if isinstance(value, Tensor) else math.radians(value)
    with naming_degrees(angle, value):
        if angle == "fov":
            return from_dict(arguments | {"fov": radians}, image_size)
        return with_rounded_theta_max(from_dict(arguments, image_size), radians)


@contextmanager
def naming_degrees(angle: str, degrees: Any) -> Iterator[None]:
    """Lets errors about an angle name the entry that gave it in degrees."""
    try:
        yield
    except ValueError as error:
        if not str(error).startswith(f"{angle} "):
            raise
        if isinstance(degrees, Tensor):
            degrees = degrees.flatten()[0].item()
        raise ValueError(f"{angle}_deg is {degrees:g}, but {error}") from error


def with_rounded_theta_max(lens: Lens, theta_max: Number) -> Lens:
    """A lens with another θ_max, rad, which may exceed the limit by rounding."""
    wanted = as_tensor(theta_max, lens.theta_max.dtype)
    return lens.with_theta_max(_without_rounding(wanted, lens.theta_limit))


def _without_rounding(wanted: Tensor, limit: Tensor) -> Tensor:
    return torch.where((limit < wanted) & (wanted <= limit + ROUNDING), limit, wanted)


def to_dict(lens: Lens) -> dict[str, Any]:
    """Describes one lens as a JSON object: the inverse of `from_dict`.

    Raises:
        ValueError: several lenses, or a lens whose model is not in `MODELS`.
    """
    if len(lens) != 1:
        raise ValueError(f"to_dict takes one lens, got {len(lens)}")
    name = type(lens).__name__
    if MODELS.get(name) is not type(lens):
        raise ValueError(f"to_dict takes a lens whose model is in {sorted(MODELS)}, got {name}")
    described = {name: value.detach()[0].tolist() for name, value in lens._tensors().items()}
    if "image_size" in described:
        described["image_size"] = [round(side) for side in described["image_size"]]
    return {"model": name} | described
