"""What plans of one camera and of several have in common: normalization, equality, and files."""

import math
import os
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, Literal, Self, TypeVar, cast, get_args

import numpy as np

from darswin.frames.compiled import frames
from darswin.frames.tensor_file import write_tensors

Output = Literal["tokens", "image", "uint8"]
_LARGEST_SIDE = 2**15 - 1  # places are stored in 16 bits


class PlanFile:
    """A plan that a file holds: the attributes that are numbers as arrays, and a few texts."""

    output: Output
    mean: tuple[float, ...]
    std: tuple[float, ...]
    key: ClassVar[str]  # of the text that says what a file is, and its version
    version: ClassVar[int]
    kinds: ClassVar[Mapping[str, type[np.generic]]]  # of the arrays of a file

    def __post_init__(self) -> None:
        for name, least in (("mean", -math.inf), ("std", 0.0)):
            values = tuple(map(float, getattr(self, name)))
            if len(values) not in (1, 3):
                raise ValueError(f"a plan needs 1 {name}, or 3 for RGB, got {len(values)}")
            if not all(least < value < math.inf for value in values):
                above = " and above 0" * (least == 0)
                raise ValueError(f"{name} of a plan must be finite{above}, got {values}")
            object.__setattr__(self, name, values)
        if len(self.mean) != len(self.std):
            raise ValueError(f"a plan needs as many means as stds, got {self.mean} and {self.std}")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return NotImplemented
        others = other.parts()
        return all(np.array_equal(value, others[name]) for name, value in self.parts().items())

    def __hash__(self) -> int:
        return hash((self.output, self.mean, self.std))

    def parts(self) -> dict[str, Any]:
        """The attributes by name."""
        return {field.name: getattr(self, field.name) for field in fields(cast(Any, self))}

    def save(self, path: str | os.PathLike) -> None:
        """Writes the plan to a file, which `load` and `Sampler` read. Its name ends in
        ".safetensors".

        Raises:
            ValueError: the name has another ending, or the plan is larger than 2 GB.
            OSError: the file cannot be written.
        """
        write_tensors(path, self.arrays(), {self.key: str(self.version)} | self.texts())

    def arrays(self) -> dict[str, np.ndarray]:
        """The attributes that are numbers, as arrays for a file."""
        parts = self.parts()
        return {name: np.asarray(parts[name], kind) for name, kind in self.kinds.items()}

    def texts(self) -> dict[str, str]:
        """The other attributes, as texts for a file."""
        return {"output": self.output}

    @classmethod
    def load(cls, path: str | os.PathLike) -> Self:
        """Reads a plan from a file.

        Raises:
            ValueError: the file is no such plan, is damaged, or comes from another version of
                darswin.
            OSError: the file cannot be read.
        """
        return read_plan(path, cls)

    @classmethod
    def of_file(cls, parts: dict[str, Any], texts: dict[str, str]) -> Self:
        """The plan with these attributes, of which `parts` has the arrays of a file."""
        raise NotImplementedError


Kind = TypeVar("Kind", bound=PlanFile)


def read_plan(path: str | os.PathLike, *kinds: type[Kind]) -> Kind:
    """The plan of a file, which must be of one of these kinds; raises what `PlanFile.load` does."""
    try:
        arrays, texts = frames.read_tensors(os.fsencode(path))
        kind = next((kind for kind in kinds if kind.key in texts), kinds[0])
        version = int(texts[kind.key])
        if version > kind.version:
            raise ValueError("it comes from a newer version of darswin: update darswin")
        if version < kind.version:
            raise ValueError("it comes from an older version of darswin: make the plan again")
        for name, dtype in kind.kinds.items():
            if arrays[name].dtype != dtype:
                raise TypeError(f"its array {name!r} has another type")
        check_output(texts["output"])
        parts: dict[str, Any] = {name: arrays[name] for name in kind.kinds}
        for name in ("mean", "std"):
            parts[name] = tuple(arrays[name].tolist())
        return kind.of_file(parts | dict(output=texts["output"]), texts)
    except (KeyError, TypeError, ValueError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(
            f"{os.fspath(path)} is no plan that darswin.frames can read: {what}"
        ) from error


def check_output(output: str) -> None:
    """ValueError unless the output is one of a plan."""
    if output not in get_args(Output):
        raise ValueError(f"output must be one of {get_args(Output)}, got {output!r}")


def check_size(size: tuple[int, int]) -> tuple[int, int]:
    """(H, W) of frames; ValueError if a side is longer than a plan can have."""
    if max(size) > _LARGEST_SIDE:
        raise ValueError(f"size must be (H, W) of at most {_LARGEST_SIDE} pixels, got {size}")
    return size
