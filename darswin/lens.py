"""Lenses: how far from the principal point, r, a ray at incident angle θ lands, and back.

Every lens is radially symmetric and a batch: its parameters are tensors with one entry a lens, and
a plain number makes a batch of one. Parameters may require gradients; `project` and `unproject` are
differentiable in them. Angles are radians, lengths pixels.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from functools import reduce
from numbers import Integral
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data._utils.collate import default_collate_fn_map

from darswin.inverse import inverse

Number = float | Sequence[float] | Tensor


class Lens:
    """Base of all lenses. A lens defines `parameters`, `project` and `unproject`.

    Convention:
        θ is the angle from the optical axis, in [0, θ_max]; r the distance from the principal
        point. Pixel centres are integers, x to the right and y down; `center` is (x, y) in pixels,
        and None means the middle of whatever image the lens is used with.

    Indexing gives lenses (`lens[3]` is a batch of one), `len` counts them, `stack` joins them, and
    a DataLoader batches a dataset's lenses like its tensors.
    """

    parameters: ClassVar[tuple[str, ...]]
    lengths: ClassVar[tuple[str, ...]]  # those of the parameters that are in pixels
    theta_limit: ClassVar[float] = math.pi
    theta_max: Tensor
    center: Tensor | None

    def __init_subclass__(cls) -> None:
        # So that a lens crosses torch.compile, torch.export and torch.func as its tensors.
        pytree.register_pytree_node(
            cls,
            lambda lens: ([getattr(lens, name) for name in lens._names()], None),
            lambda tensors, _: cls._from_tensors(dict(zip(cls._names(), tensors, strict=True))),
            serialized_type_name=f"darswin.lens.{cls.__name__}",
            flatten_with_keys_fn=lambda lens: (
                [(pytree.GetAttrKey(name), getattr(lens, name)) for name in lens._names()],
                None,
            ),
            to_dumpable_context=lambda _: None,
            from_dumpable_context=lambda _: None,
        )
        default_collate_fn_map[cls] = _collate

    def __init__(self, theta_max: Number, center: Number | None = None, **parameters: Number):
        given = {**parameters, "theta_max": theta_max, "center": center}
        tensors = _as_tensors({name: value for name, value in given.items() if value is not None})
        for name, tensor in tensors.items():
            row_dims = 1 if name in ("coefficients", "center") else 0
            if tensor.dim() not in (row_dims, row_dims + 1):
                form = "(K,) or (N, K)" if row_dims else "a number or (N,)"
                raise ValueError(f"{name} must be {form}, got shape {tuple(tensor.shape)}")
            tensors[name] = tensor[None] if tensor.dim() == row_dims else tensor
        sizes = {name: tensor.shape[0] for name, tensor in tensors.items()}
        count = next((size for size in sizes.values() if size != 1), 1)
        if any(size not in (1, count) for size in sizes.values()):
            raise ValueError(f"parameters must agree in the number of lenses, got {sizes}")
        for name in self._names():
            tensor = tensors.get(name)
            setattr(self, name, None if tensor is None else tensor.expand(count, *tensor.shape[1:]))
        if center is not None and self.center.shape[1] != 2:
            raise ValueError(f"center must be (x, y) or (N, 2), got {tuple(self.center.shape)}")
        self._require("theta_max", self.theta_max > 0, "greater than 0")
        self._require("theta_max", self.theta_max < self.theta_limit, "below π")
        self._validate()

    def _validate(self) -> None:
        """Raises ValueError, naming the parameter, where one is out of its range."""

    def _require(self, name: str, ok: Tensor, range_: str) -> None:
        if not bool(ok.all()):  # NaN is not ok
            bad = getattr(self, name).detach()[~ok][0].tolist()
            raise ValueError(f"{name} must be {range_}, got {bad}")

    def project(self, theta: Number) -> Tensor:
        """θ (rad) → r (px).

        Args:
            theta: a number, or a tensor whose first dimension is that of the lenses or 1. For a
                single lens, any shape.

        Returns:
            The shape of θ, its first dimension broadcast to the number of lenses.
        """
        raise NotImplementedError

    def unproject(self, radius: Number) -> Tensor:
        """r (px) → θ (rad), the inverse of `project` on [0, θ_max]. Shapes as there.

        NaN where no ray of the lens lands at that radius.
        """
        raise NotImplementedError

    @property
    def r_max(self) -> Tensor:
        """(N,) px: where θ_max lands, the radius of the image circle."""
        return self.project(self.theta_max)

    def _aligned(self, value: Number, *names: str) -> tuple[Tensor, ...]:
        """`value` and the named parameters, shaped to broadcast along the first dimension."""
        x = torch.as_tensor(value, dtype=self.theta_max.dtype, device=self.theta_max.device)
        if x.dim() == 0:
            x = x[None]
        if len(self) != 1 and x.shape[0] not in (1, len(self)):
            raise ValueError(
                f"the first dimension must be the number of lenses, {len(self)} or 1, "
                f"got shape {tuple(x.shape)}"
            )
        rank = (1,) * (x.dim() - 1)
        return x, *(getattr(self, name).reshape(len(self), *rank) for name in names)

    # -- a batch of tensors -------------------------------------------------------------------

    @classmethod
    def _names(cls) -> tuple[str, ...]:
        return (*cls.parameters, "theta_max", "center")

    @classmethod
    def _from_tensors(cls, tensors: dict[str, Tensor | None]) -> Self:
        """A lens of tensors that need no check: they come from a lens that was checked."""
        lens = object.__new__(cls)
        for name, tensor in tensors.items():
            setattr(lens, name, tensor)
        return lens

    def _map(self, function) -> Self:
        lens = copy.copy(self)
        for name in self._names():
            value = getattr(self, name)
            setattr(lens, name, None if value is None else function(value))
        return lens

    def __len__(self) -> int:
        return self.theta_max.shape[0]

    def __getitem__(self, index: int | slice | Tensor | Sequence[int]) -> Self:
        if isinstance(index, Integral):
            if not -len(self) <= index < len(self):
                raise IndexError(f"index {index} is out of range for {len(self)} lenses")
            index %= len(self)
            index = slice(index, index + 1)
        return self._map(lambda tensor: tensor[index])

    def to(self, *args, **kwargs) -> Self:
        """The same lens with another dtype or on another device, as `Tensor.to`."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def pin_memory(self, device=None) -> Self:
        """For DataLoader(pin_memory=True)."""
        return self._map(lambda tensor: tensor.pin_memory(device))

    def detach(self) -> Self:
        """The same lens without gradients."""
        return self._map(Tensor.detach)

    def replace(self, **tensors: Tensor) -> Self:
        """The same lens with some of its tensors replaced, unchecked."""
        return self._from_tensors({name: getattr(self, name) for name in self._names()} | tensors)

    def resized(self, scale: float) -> Self:
        """The same lens in an image `scale` times as large, as `cv2.resize` makes it."""
        lengths = {name: getattr(self, name) * scale for name in self.lengths}
        if self.center is not None:
            lengths["center"] = (self.center + 0.5) * scale - 0.5
        return self.replace(**lengths)

    def expand(self, count: int) -> Self:
        """A single lens as a batch of `count` equal ones."""
        if len(self) not in (1, count):
            raise ValueError(f"cannot expand {len(self)} lenses to {count}")
        return self._map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))

    def center_in(self, image_size: tuple[int, int]) -> Tensor:
        """(N or 1, 2) px: the principal point (x, y) in an image of (H, W)."""
        if self.center is not None:
            return self.center
        height, width = image_size
        return self.theta_max.new_tensor([[(width - 1) / 2, (height - 1) / 2]])

    def __repr__(self) -> str:
        values = (f"{n}={getattr(self, n).tolist()}" for n in self._names() if n != "center")
        center = None if self.center is None else self.center.tolist()
        return f"{type(self).__name__}({', '.join(values)}, center={center})"


def stack(lenses: Sequence[Lens]) -> Lens:
    """One batch of all the lenses of a sequence, which must be of one model.

    Raises:
        TypeError: several models.
        ValueError: no lens, polynomials of several degrees, or principal points for only some.
    """
    lenses = list(lenses)
    if not lenses:
        raise ValueError("stack needs at least one lens")
    if len({type(lens) for lens in lenses}) > 1:
        names = sorted({type(lens).__name__ for lens in lenses})
        raise TypeError(f"stack needs lenses of one model, got {names}")
    if len({lens.center is None for lens in lenses}) > 1:
        raise ValueError("stack needs a center for all lenses or for none")
    tensors = {}
    for name in lenses[0]._names():
        values = [getattr(lens, name) for lens in lenses]
        if values[0] is not None and len({value.shape[1:] for value in values}) > 1:
            shapes = sorted({tuple(value.shape[1:]) for value in values})
            raise ValueError(f"stack needs {name} of one degree, got {shapes}")
        tensors[name] = None if values[0] is None else torch.cat(values)
    return lenses[0]._from_tensors(tensors)


def _collate(batch, *, collate_fn_map=None) -> Lens:
    return stack(batch)


def _as_tensors(values: dict[str, Number]) -> dict[str, Tensor]:
    """All values as tensors of one dtype and device: those of the tensors among them, if any."""
    given = [v for v in values.values() if isinstance(v, Tensor) and v.is_floating_point()]
    dtype, device = torch.get_default_dtype(), None
    if given:
        dtype, device = reduce(torch.promote_types, (v.dtype for v in given)), given[0].device
    tensors = {}
    for name, value in values.items():
        try:
            tensors[name] = torch.as_tensor(value, dtype=dtype, device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(f"{name} must be a number or a tensor, got {value!r}") from error
    return tensors


class Perspective(Lens):
    """r = f tan θ, θ < 90°.

    Args:
        focal: f > 0, px. theta_max: in (0, π/2). center: (x, y) px, or None.
    """

    parameters = ("focal",)
    lengths = ("focal",)
    focal: Tensor

    def __init__(self, focal: Number, theta_max: Number, center: Number | None = None):
        super().__init__(theta_max, center, focal=focal)

    @classmethod
    def from_fov(cls, fov: Number, radius: Number, center: Number | None = None) -> Self:
        """The lens whose full field of view `fov` (rad) fills a circle of `radius` px."""
        t = _as_tensors({"fov": fov, "radius": radius})
        theta_max = t["fov"] / 2
        return cls(t["radius"] / torch.tan(theta_max), theta_max, center)

    def _validate(self) -> None:
        self._require("focal", (self.focal > 0) & self.focal.isfinite(), "finite and above 0")
        self._require("theta_max", self.theta_max < math.pi / 2, "below π/2 for a perspective lens")

    def project(self, theta: Number) -> Tensor:
        theta, focal = self._aligned(theta, "focal")
        return focal * torch.tan(theta)

    def unproject(self, radius: Number) -> Tensor:
        radius, focal = self._aligned(radius, "focal")
        return torch.atan(radius / focal)


class Spherical(Lens):
    """r = f sin θ / (ξ + cos θ): the unified model, perspective at ξ = 0, stereographic at ξ = 1.

    Args:
        xi: ξ ≥ 0. focal: f > 0, px. center: (x, y) px, or None.
        theta_max: in (0, π) and where the curve still rises: cos θ > -ξ for ξ ≤ 1,
            cos θ > -1/ξ for ξ > 1.

    Source: DarSwin, ICCV 2023, eq. 5; Barreto, CVIU 2006.
    """

    parameters = ("xi", "focal")
    lengths = ("focal",)
    xi: Tensor
    focal: Tensor

    def __init__(self, xi: Number, focal: Number, theta_max: Number, center: Number | None = None):
        super().__init__(theta_max, center, xi=xi, focal=focal)

    @classmethod
    def from_fov(
        cls, xi: Number, fov: Number, radius: Number, center: Number | None = None
    ) -> Self:
        """The lens of ξ whose full field of view `fov` (rad) fills a circle of `radius` px."""
        t = _as_tensors({"xi": xi, "fov": fov, "radius": radius})
        theta_max = t["fov"] / 2
        focal = t["radius"] * (t["xi"] + torch.cos(theta_max)) / torch.sin(theta_max)
        return cls(t["xi"], focal, theta_max, center)

    def _validate(self) -> None:
        self._require("xi", (self.xi >= 0) & self.xi.isfinite(), "finite and at least 0")
        limit = torch.where(self.xi <= 1, self.xi, 1 / self.xi.clamp(min=1))
        rises = torch.cos(self.theta_max) > -limit
        self._require("theta_max", rises, "where r still rises: cos θ > -min(ξ, 1/ξ)")
        self._require("focal", (self.focal > 0) & self.focal.isfinite(), "finite and above 0")

    def project(self, theta: Number) -> Tensor:
        theta, xi, focal = self._aligned(theta, "xi", "focal")
        return focal * torch.sin(theta) / (xi + torch.cos(theta))

    def unproject(self, radius: Number) -> Tensor:
        # tan ψ = r/f, θ = ψ + asin(ξ sin ψ); as atan2, exact also where the sine nears 1.
        radius, xi, focal = self._aligned(radius, "xi", "focal")
        rho = radius / focal
        return torch.atan(rho) + torch.atan2(xi * rho, torch.sqrt(1 + (1 - xi * xi) * rho * rho))


class Polynomial(Lens):
    """r = k₁ θ + k₂ θ² + … + k_n θⁿ, of any degree; WoodScape's `radial_poly` has four.

    Args:
        coefficients: (n,) or (N, n): k₁ … k_n, in px. r must rise on all of [0, θ_max].
        theta_max: in (0, π). center: (x, y) px, or None.

    Source: DarSwin, ICCV 2023, eq. 4.
    """

    parameters = ("coefficients",)
    lengths = ("coefficients",)
    coefficients: Tensor

    def __init__(self, coefficients: Number, theta_max: Number, center: Number | None = None):
        super().__init__(theta_max, center, coefficients=coefficients)

    def _validate(self) -> None:
        finite = self.coefficients.isfinite().all(1)
        self._require("coefficients", finite, "finite")
        steps = torch.linspace(0, 1, 1025, dtype=self.theta_max.dtype, device=finite.device)
        slope = self._slope(self.theta_max.detach()[:, None] * steps)
        self._require("coefficients", (slope > 0).all(1), "such that r rises on all of [0, θ_max]")

    def _horner(self, theta: Tensor, coefficients: Tensor) -> Tensor:
        """c₀ + c₁ θ + …, for coefficients (N, n) and θ (N or 1, ...)."""
        columns = coefficients.reshape(*coefficients.shape, *(1,) * (theta.dim() - 1)).unbind(1)
        value = torch.zeros_like(theta)
        for column in reversed(columns):
            value = value * theta + column
        return value

    def _slope(self, theta: Tensor) -> Tensor:
        degrees = torch.arange(1, self.coefficients.shape[1] + 1, device=theta.device)
        return self._horner(theta, self.coefficients * degrees)

    def project(self, theta: Number) -> Tensor:
        (theta,) = self._aligned(theta)
        return theta * self._horner(theta, self.coefficients)

    def unproject(self, radius: Number) -> Tensor:
        (radius,) = self._aligned(radius)
        rank = (1,) * (radius.dim() - 1)
        end, r_max = (t.detach().reshape(-1, *rank) for t in (self.theta_max, self.r_max))
        slack = 4 * torch.finfo(radius.dtype).eps
        lands = (radius >= 0) & (radius <= r_max * (1 + slack))
        return torch.where(lands, inverse(self.project, self._slope, radius, end), torch.nan)


def from_dict(description: Mapping[str, Any], image_size: tuple[int, int]) -> Lens:
    """The lens that a JSON object describes: its model's name and the arguments of its constructor.

    Args:
        description: {"model": "Spherical", "xi": 0.5, "focal": 300, "theta_max": 1.5}, angles in
            rad and lengths in px; "center": [x, y] is optional. Instead of "theta_max" and the
            focal length, "fov" may stand: the full field of view, that fills the circle inside the
            image.
        image_size: (H, W) px of the lens's images.

    Raises:
        ValueError: an unknown model, or arguments that are not its own, by name.
    """
    if not isinstance(description, Mapping):
        raise ValueError(f"a lens must be a JSON object, got {description!r}")
    arguments = dict(description)
    models = {model.__name__: model for model in (Perspective, Spherical, Polynomial)}
    name = arguments.pop("model", None)
    if name not in models:
        raise ValueError(f'a lens\'s "model" must be one of {list(models)}, got {name!r}')
    model = models[name]
    try:
        if "fov" in arguments and hasattr(model, "from_fov"):
            return model.from_fov(**arguments, radius=min(image_size) / 2)
        return model(**arguments)
    except TypeError as error:
        raise ValueError(f"a {name} lens cannot be made of {arguments}: {error}") from error
