"""A batch of lenses as tensors, with one entry per lens, all of one dtype and on one device."""

import copy
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from darswin.lens.parameter import Arguments, Number, Parameter, as_tensors
from darswin.ops.checks import readable
from darswin.utils.angles import degrees_hint
from darswin.utils.arrays import as_tensor
from darswin.utils.words import counted

NUMBER = Parameter()


class LensBatch:
    """The tensors of N lenses: constructing, indexing, moving and copying them."""

    # The names of the parameters that all lenses have; of the required and the optional ones of a
    # class; and of all together, in the order of the constructor.
    common: ClassVar[tuple[str, ...]] = ("theta_max", "center", "affine", "image_size")
    parameters: ClassVar[tuple[str, ...]]
    optional: ClassVar[tuple[str, ...]]
    declared: ClassVar[dict[str, Parameter]] = {}
    names: ClassVar[tuple[str, ...]]
    _arguments: ClassVar[Arguments]
    __signature__: ClassVar[object]  # for `help`
    theta_max: Tensor

    def __init_subclass__(cls) -> None:
        own = {name: p for name, p in vars(cls).items() if isinstance(p, Parameter)}
        for name in own:
            delattr(cls, name)  # instance attributes without a class attribute are faster
        declared = own | {name: p for name, p in cls.declared.items() if name not in own}
        cls.parameters = tuple(name for name, p in declared.items() if not p.optional)
        cls.optional = tuple(
            name for name, p in declared.items() if p.optional and name not in cls.common
        )
        others = (*cls.optional, *cls.common)
        cls.names = (*cls.parameters, *others)
        cls.declared = {name: declared[name] for name in cls.names}
        by_place = [name for name in others if declared[name].by_place]
        by_name = [name for name in others if not declared[name].by_place]
        cls._arguments = Arguments(cls.parameters, by_place, by_name)
        cls.__signature__ = cls._arguments.signature
        # torch.compile, torch.export and torch.func then see a lens as its tensors.
        pytree.register_pytree_node(
            cls,
            lambda lens: ([getattr(lens, name) for name in lens.names], None),
            lambda tensors, _: cls._from_tensors(dict(zip(cls.names, tensors, strict=True))),
            serialized_type_name=f"darswin.lens.{cls.__name__}",
            flatten_with_keys_fn=lambda lens: (
                [(pytree.GetAttrKey(name), getattr(lens, name)) for name in lens.names],
                None,
            ),
            to_dumpable_context=lambda _: None,
            from_dumpable_context=lambda _: None,
        )

    def __init__(self, *arguments: Number | None, **named: Number | None):
        rows = self._expanded(self._arguments.bind(type(self).__name__, arguments, named))
        for name in self.names:
            setattr(self, name, rows.get(name))

    def __setattr__(self, name: str, value: object) -> None:
        # Code compiled ahead of time may ignore strides.
        super().__setattr__(name, value.contiguous() if isinstance(value, Tensor) else value)

    @classmethod
    def _rows(cls, values: Mapping[str, Number]) -> dict[str, Tensor]:
        """The values as tensors (N or 1, ...)."""
        tensors = as_tensors(values).items()
        return {name: cls.declared.get(name, NUMBER).rows(name, value) for name, value in tensors}

    @classmethod
    def _expanded(cls, values: Mapping[str, Number]) -> dict[str, Tensor]:
        """`_rows`, expanded to N lenses."""
        rows = cls._rows(values)
        sizes = {name: tensor.shape[0] for name, tensor in rows.items()}
        counts = {*sizes.values()} - {1} or {1}
        if len(counts) > 1:
            raise ValueError(f"parameters must agree in the number of lenses, got {sizes}")
        (count,) = counts
        return {name: tensor.expand(count, *tensor.shape[1:]) for name, tensor in rows.items()}

    @classmethod
    def _from_tensors(cls, tensors: Mapping[str, Tensor | None]) -> Self:
        """A lens made from tensors (N, ...) without checks."""
        lens = object.__new__(cls)
        for name in cls.names:
            setattr(lens, name, tensors.get(name))
        return lens

    def _tensors(self) -> dict[str, Tensor]:
        """The parameters that are not None, by name."""
        values = ((name, getattr(self, name)) for name in self.names)
        return {name: value for name, value in values if value is not None}

    def _map(self, function: Callable[[Tensor], Tensor]) -> Self:
        lens = copy.copy(self)
        for name, value in self._tensors().items():
            setattr(lens, name, function(value))
        return lens

    def _require(self, name: str, ok: Tensor, range_: str, value: Tensor | None = None) -> None:
        """Raises ValueError with the first bad value unless `ok`, (N,), is true for all lenses. The
        value, (N, ...), is that of the parameter, unless it is given."""
        if not bool(ok.all()):  # NaN is not ok
            bad = (getattr(self, name) if value is None else value).detach()[~ok][0]
            is_angle = name == "fov" or self.declared.get(name, NUMBER).angle
            hint = degrees_hint(bad.abs().max().item()) if is_angle else ""
            raise ValueError(f"{name} must be {range_}, got {bad.tolist()}{hint}")

    def _check(self, name: str) -> None:
        """Raises ValueError if a parameter is out of its range."""
        declared, value = self.declared[name], getattr(self, name)
        if not declared.holds(value):
            ok = torch.tensor([declared.holds(row) for row in value], device=value.device)
            self._require(name, ok, declared.range)

    @staticmethod
    def _row(tensor: Tensor, dims: int) -> Tensor:
        """(N, ...) with ones inserted after N, so that it has `dims` dimensions."""
        ones = (1,) * (dims - tensor.dim())
        return tensor.reshape(tensor.shape[0], *ones, *tensor.shape[1:])

    def _aligned(self, value: Number, *names: str) -> tuple[Tensor, ...]:
        """`value` and the named parameters, shaped to broadcast along the first dimension."""
        x = as_tensor(value, self.theta_max.dtype, self.theta_max.device)
        if x.dim() == 0:
            x = x[None]
        if self.count != 1 and x.shape[0] not in (1, self.count):
            raise ValueError(
                f"the first dimension must be the number of lenses, {self.count} or 1, "
                f"got shape {tuple(x.shape)}"
            )
        return x, *(self._row(getattr(self, name), x.dim()) for name in names)

    def _by_lens(self, x: Tensor) -> Tensor:
        """(N, ...) as (N, K); of a single lens, any shape as (1, K)."""
        return x.reshape(self.count, x.numel() // max(self.count, 1))

    @property
    def count(self) -> int:
        """The number of lenses. Unlike `len`, it stays variable in an exported graph."""
        return self.theta_max.shape[0]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int | slice | Tensor | Sequence[int]) -> Self:
        if isinstance(index, Integral):
            number = int(index)
            if not -len(self) <= number < len(self):
                raise IndexError(f"index {number} is out of range for {counted(len(self), 'lens')}")
            number %= len(self)
            index = slice(number, number + 1)
        return self._map(lambda tensor: tensor[index])

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """The same lens with another dtype or on another device; arguments: see `Tensor.to`."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def pin_memory(self, device: torch.device | str | None = None) -> Self:
        """The same lens in pinned memory, for DataLoader(pin_memory=True)."""
        return self._map(lambda tensor: tensor.pin_memory(device))

    def detach(self) -> Self:
        """The same lens without gradients."""
        return self._map(Tensor.detach)

    def replace(self, **tensors: Tensor | None) -> Self:
        """The same lens with some tensors replaced, without checks."""
        return self._from_tensors(self._tensors() | tensors)

    def same_as(self, other: object) -> bool:
        """True if `other` has the same class and equal tensors."""
        if type(other) is not type(self):
            return False
        mine, others = self._tensors(), other._tensors()
        return mine.keys() == others.keys() and all(
            (a.dtype, a.device) == (b.dtype, b.device) and torch.equal(a, b)
            for a, b in zip(mine.values(), others.values(), strict=True)
        )

    def merged(self) -> Self:
        """A single lens if all lenses are equal, else all of them.

        On a device, all of them: comparing them would wait for the device.
        """
        if not readable(self.theta_max):
            return self
        same = all(torch.equal(v, v[:1].expand_as(v)) for v in self._tensors().values())
        return self[:1] if same else self

    def expand(self, count: int) -> Self:
        """A single lens repeated `count` times, as a batch."""
        if len(self) not in (1, count):
            raise ValueError(f"cannot expand {len(self)} lenses to {count}")
        return self._map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))

    def __repr__(self) -> str:
        shown = (f"{name}={value.tolist()}" for name, value in self._tensors().items())
        return f"{type(self).__name__}({', '.join(shown)})"
