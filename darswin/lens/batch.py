"""A batch of lenses as tensors: one entry a lens in each, all of one dtype, on one device."""

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from numbers import Integral
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from darswin.ops.waiting import readable

Number = float | Sequence[float] | Sequence[Sequence[float]] | Tensor

# What the user may give, for a parameter of 0, 1 or 2 dimensions a lens.
FORMS = ("a number or (N,)", "(K,) or (N, K)", "(K, L) or (N, K, L)")


class LensBatch:
    """The tensors of N lenses: how they are given, indexed, joined, moved and copied.

    A class says what its tensors are in `parameters`, `optional` and `lists`; all lenses also
    have those of `common`.
    """

    parameters: ClassVar[tuple[str, ...]] = ()
    optional: ClassVar[tuple[str, ...]] = ()  # parameters that may be None
    lists: ClassVar[tuple[str, ...]] = ()  # those of the parameters that are several numbers a lens
    common: ClassVar[tuple[str, ...]] = ("theta_max",)
    theta_max: Tensor

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

    def __init__(self, **given: Number | None):
        if unknown := sorted(given.keys() - set(self._names())):
            raise TypeError(
                f"{type(self).__name__} takes {', '.join(self._names())}, got {', '.join(unknown)}"
            )
        rows = self._expanded({name: v for name, v in given.items() if v is not None})
        for name in self._names():
            setattr(self, name, rows.get(name))

    def __setattr__(self, name: str, value: object) -> None:
        # What is compiled ahead of time may take memory in order, whatever the strides.
        super().__setattr__(name, value.contiguous() if isinstance(value, Tensor) else value)

    @classmethod
    def _names(cls) -> tuple[str, ...]:
        return (*cls.parameters, *cls.optional, *cls.common)

    @classmethod
    def _dims(cls, name: str) -> int:
        """How many dimensions one lens's part of a tensor has."""
        return int(name in cls.lists)

    @classmethod
    def _rows(cls, given: Mapping[str, Number]) -> dict[str, Tensor]:
        """Values as tensors (N or 1, ...).

        Raises:
            ValueError: a wrong number of dimensions. TypeError: what is no number.
        """
        rows = as_tensors(given)
        for name, tensor in rows.items():
            dims = cls._dims(name)
            if tensor.dim() not in (dims, dims + 1):
                raise ValueError(f"{name} must be {FORMS[dims]}, got shape {tuple(tensor.shape)}")
            rows[name] = tensor[None] if tensor.dim() == dims else tensor
        return rows

    @classmethod
    def _expanded(cls, given: Mapping[str, Number]) -> dict[str, Tensor]:
        """`_rows`, all of N lenses."""
        rows = cls._rows(given)
        sizes = {name: tensor.shape[0] for name, tensor in rows.items()}
        count = next((size for size in sizes.values() if size != 1), 1)
        if any(size not in (1, count) for size in sizes.values()):
            raise ValueError(f"parameters must agree in the number of lenses, got {sizes}")
        return {name: tensor.expand(count, *tensor.shape[1:]) for name, tensor in rows.items()}

    @classmethod
    def _from_tensors(cls, tensors: Mapping[str, Tensor | None]) -> Self:
        """A lens of tensors (N, ...) that need no check: they come from a lens that was checked."""
        lens = object.__new__(cls)
        for name in cls._names():
            setattr(lens, name, tensors.get(name))
        return lens

    def _map(self, function: Callable[[Tensor], Tensor]) -> Self:
        lens = copy.copy(self)
        for name in self._names():
            value = getattr(self, name)
            setattr(lens, name, None if value is None else function(value))
        return lens

    def _require(self, name: str, ok: Tensor, range_: str) -> None:
        """ValueError unless a parameter is ok, (N,), of all lenses."""
        if not bool(ok.all()):  # NaN is not ok
            bad = getattr(self, name).detach()[~ok][0].tolist()
            raise ValueError(f"{name} must be {range_}, got {bad}")

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

    def __len__(self) -> int:
        return self.theta_max.shape[0]

    def __getitem__(self, index: int | slice | Tensor | Sequence[int]) -> Self:
        if isinstance(index, Integral):
            number = int(index)
            if not -len(self) <= number < len(self):
                raise IndexError(f"index {number} is out of range for {len(self)} lenses")
            number %= len(self)
            index = slice(number, number + 1)
        return self._map(lambda tensor: tensor[index])

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """The same lens with another dtype or on another device, as `Tensor.to`."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def pin_memory(self, device: torch.device | str | None = None) -> Self:
        """For DataLoader(pin_memory=True)."""
        return self._map(lambda tensor: tensor.pin_memory(device))

    def detach(self) -> Self:
        """The same lens without gradients."""
        return self._map(Tensor.detach)

    def replace(self, **tensors: Tensor | None) -> Self:
        """The same lens with some of its tensors replaced, unchecked."""
        return self._from_tensors({name: getattr(self, name) for name in self._names()} | tensors)

    def same_as(self, other: object) -> bool:
        """Whether `other` is of the same class and has the same numbers, for as many lenses."""
        if type(other) is not type(self):
            return False
        pairs = [(getattr(self, name), getattr(other, name)) for name in self._names()]
        return all(a is b or (a is not None and b is not None and _same(a, b)) for a, b in pairs)

    def merged(self) -> Self:
        """A single lens, where all of them have the same numbers; else all of them.

        On a device, which would be waited for, they stay as many as they are.
        """
        if not readable(self.theta_max):
            return self
        values = (getattr(self, name) for name in self._names())
        same = all(v is None or torch.equal(v, v[:1].expand_as(v)) for v in values)
        return self[:1] if same else self

    def expand(self, count: int) -> Self:
        """A single lens as a batch of `count` equal ones."""
        if len(self) not in (1, count):
            raise ValueError(f"cannot expand {len(self)} lenses to {count}")
        return self._map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))

    def __repr__(self) -> str:
        values = {name: getattr(self, name) for name in self._names()}
        shown = (f"{name}={value.tolist()}" for name, value in values.items() if value is not None)
        return f"{type(self).__name__}({', '.join(shown)})"


def _same(a: Tensor, b: Tensor) -> bool:
    return a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


def as_tensors(values: Mapping[str, Number]) -> dict[str, Tensor]:
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
