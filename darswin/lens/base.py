"""What all lenses share: a batch of parameters, the image they belong to, rays and pixels."""

import copy
import math
import operator
from collections.abc import Sequence
from functools import reduce
from numbers import Integral, Real
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data._utils.collate import default_collate_fn_map

from darswin.lens.inverse import inverse

Number = float | Sequence[float] | Tensor

# Where r stops rising, or grows beyond all bounds, θ cannot be told from r; a lens is used up to
# this far (rad) from there.
MARGIN = 1e-6

FRAME = ("center", "affine", "image_size")
# Dimensions of one lens's part of a tensor, where it is not a number.
ROW_DIMS = {
    "coefficients": 1, "radial": 1, "denominator": 1, "tangential": 1, "prism": 1, "angles": 1,
    "radii": 1, "slopes": 1, "center": 1, "affine": 2, "image_size": 1,
}  # fmt: skip
FORMS = ("a number or (N,)", "(K,) or (N, K)", "(K, L) or (N, K, L)")


class Lens:
    """Base of all lenses. A lens defines `parameters`, `theta_limit`, `project` and `unproject`.

    A ray at incident angle θ and azimuth φ lands at

        (x, y) = center + affine @ (r(θ) (cos φ, sin φ) + offset(θ, φ)).

    Every lens is a batch: its parameters are tensors with one entry a lens, and a plain number
    makes a batch of one. Parameters may require gradients; all methods are differentiable in them.

    Convention:
        θ is the angle from the optical axis, in [0, θ_max], rad; r the distance from the principal
        point before `affine`, px. φ = 0 points right, π/2 down. Pixel centres are integers, x to
        the right and y down.

    Args, beside a model's own:
        theta_max: in (0, theta_limit], the widest angle that the lens is used for: where the last
            ring of a polar grid ends. None means theta_limit.
        center: (x, y) or (N, 2) px, the principal point. None means the middle of whatever image
            the lens is used with.
        affine: (2, 2) or (N, 2, 2): pixels that are not square, or skewed. None means the identity.
        image_size: (H, W) or (N, 2) of the images that the lens belongs to. None means any.

    Raises:
        ValueError: a parameter out of its range, by name. TypeError: one that is no number.

    Indexing gives lenses (`lens[3]` is a batch of one), `len` counts them, `cat` joins them, and
    a DataLoader batches a dataset's lenses like its tensors.
    """

    parameters: ClassVar[tuple[str, ...]]
    optional: ClassVar[tuple[str, ...]] = ()  # parameters that may be None
    lengths: ClassVar[tuple[str, ...]]  # those of the parameters that are in pixels
    theta_max: Tensor
    center: Tensor | None
    affine: Tensor | None
    image_size: Tensor | None

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

    def __init__(
        self,
        theta_max: Number | None = None,
        center: Number | None = None,
        affine: Number | None = None,
        image_size: Number | None = None,
        **parameters: Number | None,
    ):
        given = {**parameters, "theta_max": theta_max, "center": center, "affine": affine,
                 "image_size": image_size}  # fmt: skip
        if unknown := sorted(given.keys() - set(self._names())):
            raise TypeError(
                f"{type(self).__name__} takes {', '.join(self._names())}, got {', '.join(unknown)}"
            )
        tensors = _as_tensors({name: value for name, value in given.items() if value is not None})
        for name, tensor in tensors.items():
            row_dims = ROW_DIMS.get(name, 0)
            if tensor.dim() not in (row_dims, row_dims + 1):
                shape = tuple(tensor.shape)
                raise ValueError(f"{name} must be {FORMS[row_dims]}, got shape {shape}")
            tensors[name] = tensor[None] if tensor.dim() == row_dims else tensor
        sizes = {name: tensor.shape[0] for name, tensor in tensors.items()}
        count = next((size for size in sizes.values() if size != 1), 1)
        if any(size not in (1, count) for size in sizes.values()):
            raise ValueError(f"parameters must agree in the number of lenses, got {sizes}")
        varied = [name for name, size in sizes.items() if size == count]
        if count > 1 and varied == ["radial"] and tensors["radial"].shape[1] == 1:  # OpenCV's form
            raise ValueError(
                f"radial of shape ({count}, 1) is {count} lenses of one coefficient each: give "
                f"({count},) for one lens, or another parameter with {count} numbers"
            )
        for name in self._names():
            tensor = tensors.get(name)
            setattr(self, name, None if tensor is None else tensor.expand(count, *tensor.shape[1:]))
        self._check_frame()
        self._validate()
        self._set_theta_max()

    def __setattr__(self, name: str, value: object) -> None:
        # What is compiled ahead of time may take memory in order, whatever the strides.
        super().__setattr__(name, value.contiguous() if isinstance(value, Tensor) else value)

    def _check_frame(self) -> None:
        for name, shape in (("center", (2,)), ("affine", (2, 2)), ("image_size", (2,))):
            tensor = getattr(self, name)
            if tensor is None:
                continue
            if tensor.shape[1:] != shape:
                forms = {"center": "(x, y)", "affine": "(2, 2)", "image_size": "(H, W)"}
                raise ValueError(
                    f"{name} must be {forms[name]} or {('N', *shape)}, got {tuple(tensor.shape)}"
                )
            self._require(name, tensor.isfinite().flatten(1).all(1), "finite")
        if self.affine is not None:
            self._require("affine", self.affine.detach().det() != 0, "invertible")
        if self.image_size is not None:
            self._require("image_size", (self.image_size >= 1).all(1), "at least (1, 1)")

    def _validate(self) -> None:
        """Raises ValueError, naming the parameter, where one is out of its range."""

    def _require(self, name: str, ok: Tensor, range_: str) -> None:
        if not bool(ok.all()):  # NaN is not ok
            bad = getattr(self, name).detach()[~ok][0].tolist()
            raise ValueError(f"{name} must be {range_}, got {bad}")

    def _set_theta_max(self) -> None:
        limit = self.theta_limit
        if not bool((limit > 0).all()):
            raise ValueError(f"{self._curve} must be such that r rises with θ, got {self}")
        if self.theta_max is None:
            self.theta_max = limit
            return
        self._require("theta_max", self.theta_max > 0, "greater than 0")
        # A limit found in another dtype differs by a rounding, which MARGIN leaves room for.
        beyond = ~(self.theta_max <= limit * (1 + 2 * torch.finfo(limit.dtype).eps))
        if bool(beyond.any()):
            last, got = (t.detach()[beyond][0].item() for t in (limit, self.theta_max))
            raise ValueError(
                f"theta_max must be at most {last:.6f} rad ({math.degrees(last):.2f}°), as far as "
                f"this {type(self).__name__} lens's r rises, got {got:.6f}"
            )
        self.theta_max = torch.where(self.theta_max > limit, limit, self.theta_max)

    @property
    def _curve(self) -> str:
        return " and ".join(self.parameters)

    def project(self, theta: Number) -> Tensor:
        """θ (rad) → r (px), the radial curve.

        Args:
            theta: a number, or a tensor whose first dimension is that of the lenses or 1. For a
                single lens, any shape.

        Returns:
            The shape of θ, its first dimension broadcast to the number of lenses.
        """
        raise NotImplementedError

    def unproject(self, radius: Number) -> Tensor:
        """r (px) → θ (rad), the inverse of `project` on [0, θ_max]. Shapes as there.

        NaN where no ray of [0, θ_max] lands: below 0 and, but for rounding, beyond `r_max`.
        """
        (radius,) = self._aligned(radius)
        slack = 1 + 16 * torch.finfo(radius.dtype).eps
        with torch.no_grad():
            last, beyond = self.r_max, self.project(self.theta_max * slack)
            last = torch.where(beyond > last, beyond, last) * slack  # which may be none
            lands = (radius >= 0) & (radius <= self._row(last, radius.dim()))
        # 0 in place of what has no angle: NaN would reach the gradients.
        return torch.where(lands, self._angle_at(torch.where(lands, radius, 0.0)), torch.nan)

    def _angle_at(self, radius: Tensor) -> Tensor:
        """θ at radii where rays land. Lenses with a closed inverse override this."""
        end = self._row(self.theta_max.detach(), radius.dim())
        return inverse(self.project, self._slope, radius, end)

    def _slope(self, theta: Tensor) -> Tensor:
        """dr/dθ, of θ (N or 1, ...)."""
        return torch.func.jvp(self.project, (theta,), (torch.ones_like(theta),))[1]

    @property
    def theta_limit(self) -> Tensor:
        """(N,) rad: the largest angle that the model is valid for, up to which r rises and no two
        rays land on one pixel."""
        raise NotImplementedError

    @property
    def r_max(self) -> Tensor:
        """(N,) px: where θ_max lands, the radius of the image circle."""
        return self.project(self.theta_max)

    # -- rays and pixels ----------------------------------------------------------------------

    @property
    def is_radial(self) -> bool:
        """Whether a ray keeps its azimuth, but for `affine`: there is no `offset`."""
        return True

    def offset(self, theta: Tensor, direction: Tensor) -> Tensor:
        """(..., 2) px: how far from its place on the radial curve a ray lands, before `affine`.

        Args:
            theta: (N or 1, ...) rad. direction: (N or 1, ..., 2), cos φ and sin φ.
        """
        return torch.zeros_like(theta)[..., None] * direction

    def project_rays(
        self, theta: Number, azimuth: Number, image_size: tuple[int, int] | None = None
    ) -> Tensor:
        """Rays (θ, φ) → the pixels (x, y) where they land.

        Args:
            theta, azimuth: rad, shapes as in `project`, which broadcast.
            image_size: (H, W), for the principal point of a lens that has none.

        Returns:
            (..., 2) px.
        """
        theta, azimuth = self._aligned(theta)[0], self._aligned(azimuth)[0]
        direction = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
        return self.pixels(theta, direction, image_size)

    def unproject_pixels(
        self, pixels: Tensor, image_size: tuple[int, int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Pixels (x, y) → the rays (θ, φ) that land there, the inverse of `project_rays`.

        Args:
            pixels: (N or 1, ..., 2) px; for a single lens (..., 2).
            image_size: (H, W), for the principal point of a lens that has none.

        Returns:
            θ and φ, (N, ...) rad. θ is NaN where no ray lands.
        """
        theta, direction = self.rays(pixels, image_size)
        return theta, torch.atan2(direction[..., 1], direction[..., 0])

    def rays(
        self, pixels: Tensor, image_size: tuple[int, int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """`unproject_pixels` with (cos φ, sin φ), (N, ..., 2), which has a gradient at the
        principal point too; there it is (0, 0)."""
        flat = self._aligned(pixels)[0] - self._row(self.center_in(image_size), pixels.dim())
        if self.affine is not None:
            flat = _apply(torch.linalg.inv(self.affine), flat)
        radius = length_of(flat)
        theta, direction = self.unproject(radius), flat / radius[..., None]
        if self.is_radial:
            return theta, direction
        return self._find_rays(flat, theta, direction)

    def pixels(
        self, theta: Tensor, direction: Tensor, image_size: tuple[int, int] | None = None
    ) -> Tensor:
        """`project_rays` with (cos φ, sin φ) in place of φ: the inverse of `rays`.

        Args:
            theta: (N or 1, ...) rad. direction: (N or 1, ..., 2).
        """
        return self.to_pixels(self._flat(theta, direction), image_size)

    def to_pixels(self, flat: Tensor, image_size: tuple[int, int] | None = None) -> Tensor:
        """Points (N, ..., 2) around the principal point, before `affine` → pixels."""
        return self.through_affine(flat) + self._row(self.center_in(image_size), flat.dim())

    def through_affine(self, flat: Tensor) -> Tensor:
        """`affine` @ points or offsets (N or 1, ..., 2)."""
        return flat if self.affine is None else _apply(self.affine, flat)

    def _flat(self, theta: Tensor, direction: Tensor) -> Tensor:
        flat = self.project(theta)[..., None] * direction
        return flat if self.is_radial else flat + self.offset(theta, direction)

    @staticmethod
    def _row(tensor: Tensor, dims: int) -> Tensor:
        """(N, ...) with ones after N, to broadcast along the first of `dims` dimensions."""
        ones = (1,) * (dims - tensor.dim())
        return tensor.reshape(tensor.shape[0], *ones, *tensor.shape[1:])

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
        return x, *(self._row(getattr(self, name), x.dim()) for name in names)

    def center_in(self, image_size: tuple[int, int] | None = None) -> Tensor:
        """(N or 1, 2) px: the principal point (x, y) in an image of (H, W)."""
        if self.center is not None:
            return self.center
        if image_size is not None:
            size = self.theta_max.new_tensor([image_size])
        elif self.image_size is not None:
            size = self.image_size
        else:
            raise ValueError("a lens with no center needs the image_size, (H, W)")
        return (size.flip(1) - 1) / 2

    def side_angles(self, image_size: tuple[int, int] | None = None) -> Tensor:
        """(N, 4) rad: θ where the image ends to the left, above, to the right and below.

        On the row and the column of the principal point; `theta_limit` where the image reaches
        further than the lens.
        """
        cx, cy = self.center_in(image_size).expand(len(self), 2).unbind(1)
        if image_size is not None:
            height, width = self.theta_max.new_tensor(image_size)
        elif self.image_size is not None:
            height, width = self.image_size.unbind(1)
        else:
            raise ValueError("side_angles needs the image_size, (H, W)")
        low = torch.full_like(cx, -0.5)
        sides = ((low, cy), (cx, low), ((width - 0.5).expand_as(cx), cy),
                 (cx, (height - 0.5).expand_as(cy)))  # fmt: skip
        whole = self.with_theta_max(None)
        pixels = torch.stack([torch.stack(side, -1) for side in sides], 1)
        theta = whole.rays(pixels, image_size)[0]
        return torch.where(theta.isnan(), whole.theta_max[:, None], theta)

    # -- the same lens in another image, or used otherwise ------------------------------------

    def with_theta_max(self, theta_max: Number | None) -> Self:
        """The same lens used up to another angle (rad); None means `theta_limit`."""
        lens = self._map(lambda tensor: tensor)
        if theta_max is not None:
            like = self.theta_max
            theta_max = torch.as_tensor(theta_max, dtype=like.dtype, device=like.device)
            theta_max = theta_max.expand(len(self))
        lens.theta_max = theta_max
        lens._set_theta_max()
        return lens

    def resized(self, scale: float | tuple[int, int]) -> Self:
        """The same lens in a resized image, as `cv2.resize` makes it.

        Args:
            scale: how many times as large the image is, above 0; or its new (H, W), in whole
                pixels, for a lens with an `image_size`. Images have whole pixels, so that (H, W)
                is exact where a number is not.

        Raises:
            ValueError: a scale or a size that is no image's, or an (H, W) for a lens that does not
                know its image_size. TypeError: neither a number nor two.
        """
        if isinstance(scale, Real) or getattr(scale, "ndim", None) == 0:
            across = down = float(scale)
            if not 0 < across < math.inf:
                raise ValueError(f"resized must be given a finite scale above 0, got {across}")
            size = None
            if self.image_size is not None:
                size = (self.image_size * across).round().clamp(min=1)
        elif self.image_size is None:
            raise ValueError(f"resized to (H, W) = {scale} needs a lens that has an image_size")
        else:
            size = self.theta_max.new_tensor([_size(scale)]).expand(len(self), 2)
            down, across = (size / self.image_size).unbind(1)
        lens = self._scaled(across)
        lens.image_size = size
        if self.center is not None:
            like = dict(dtype=self.center.dtype, device=self.center.device)
            factors = (torch.as_tensor(factor, **like) for factor in (across, down))
            factor = torch.stack(torch.broadcast_tensors(*factors), -1)
            lens.center = (self.center + 0.5) * factor - 0.5
        if isinstance(across, Tensor) and bool((down != across).any()):
            rows = torch.stack((torch.ones_like(down), down / across), -1)
            lens.affine = rows[..., None] * (
                _identity(self) if self.affine is None else self.affine
            )
        return lens

    def in_picture(self, size: tuple[int, int]) -> Self:
        """The lens in a picture of (H, W) that shows all that the lens was calibrated with.

        A lens without an `image_size` stays as it is.

        Raises:
            ValueError: a picture of another shape, by more than the rounding of its sides.
        """
        if self.image_size is None:
            return self
        height, width = (round(side) for side in self.image_size[0].tolist())
        off = abs(size[0] * width - size[1] * height)  # px times the other side
        if off > width and off > height:
            raise ValueError(
                f"the lens is of pictures of {height}×{width} px, and {size[0]}×{size[1]} is not "
                "of that shape"
            )
        return self if tuple(size) == (height, width) else self.resized(tuple(size))

    def _scaled(self, scale: float | Tensor) -> Self:
        """The same lens with all its lengths `scale` times as long."""
        lengths = {}
        for name in self.lengths:
            value = getattr(self, name)
            if value is not None:
                factor = self._row(scale, value.dim()) if isinstance(scale, Tensor) else scale
                lengths[name] = value * factor
        return self.replace(**lengths)

    def cropped(self, top: int, left: int, height: int, width: int) -> Self:
        """The same lens in a part of the image: `image[..., top:top + height, left:left + width]`.

        The part may reach beyond the image, as padding does: `cropped(-8, -8, H + 16, W + 16)`.

        Raises:
            ValueError: a part of no pixels, or a lens with neither a center nor an image_size.
            TypeError: what is not in whole pixels.
        """
        top, left = (_whole(side) for side in (top, left))
        height, width = _size((height, width))
        center = self.center_in() - self.theta_max.new_tensor([left, top])
        size = self.theta_max.new_tensor([[height, width]]).expand(len(self), 2)
        return self.replace(center=center.expand(len(self), 2), image_size=size)

    # -- a batch of tensors -------------------------------------------------------------------

    @classmethod
    def _names(cls) -> tuple[str, ...]:
        return (*cls.parameters, *cls.optional, "theta_max", *FRAME)

    @classmethod
    def _from_tensors(cls, tensors: dict[str, Tensor | None]) -> Self:
        """A lens of tensors that need no check: they come from a lens that was checked."""
        lens = object.__new__(cls)
        for name in cls._names():
            setattr(lens, name, tensors.get(name))
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

    def replace(self, **tensors: Tensor | None) -> Self:
        """The same lens with some of its tensors replaced, unchecked."""
        return self._from_tensors({name: getattr(self, name) for name in self._names()} | tensors)

    def expand(self, count: int) -> Self:
        """A single lens as a batch of `count` equal ones."""
        if len(self) not in (1, count):
            raise ValueError(f"cannot expand {len(self)} lenses to {count}")
        return self._map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))

    def __repr__(self) -> str:
        values = {name: getattr(self, name) for name in self._names()}
        shown = (f"{name}={value.tolist()}" for name, value in values.items() if value is not None)
        return f"{type(self).__name__}({', '.join(shown)})"


def _whole(value: Number) -> int:
    try:
        return operator.index(value)
    except TypeError:
        if isinstance(value, Real) and float(value).is_integer():
            return int(value)
        raise TypeError(f"an image has whole pixels, got {value!r}") from None


def _size(size: tuple[int, int]) -> tuple[int, int]:
    """(H, W) of an image, or ValueError."""
    try:
        height, width = size
    except (TypeError, ValueError):
        raise TypeError(f"an image's size must be (H, W), got {size!r}") from None
    height, width = _whole(height), _whole(width)
    if height < 1 or width < 1:
        raise ValueError(f"an image's (H, W) must be at least (1, 1), got {(height, width)}")
    return height, width


def _collate(batch, *, collate_fn_map=None) -> Lens:
    from darswin.lens.curves import cat  # curves are lenses

    return cat(batch)


def _identity(lens: Lens) -> Tensor:
    return torch.eye(2, dtype=lens.theta_max.dtype, device=lens.theta_max.device)


def _apply(matrix: Tensor, points: Tensor) -> Tensor:
    """(N, 2, 2) @ (N or 1, ..., 2)."""
    return (Lens._row(matrix, points.dim() + 1) @ points[..., None])[..., 0]


def length_of(points: Tensor) -> Tensor:
    """The length of (..., 2), never 0, where a root has no slope."""
    return points.square().sum(-1).clamp(min=1e-12 * torch.finfo(points.dtype).eps).sqrt()


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
