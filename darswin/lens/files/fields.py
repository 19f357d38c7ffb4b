"""Reading entries of a file so that an error says which one, what it must be and what it is."""

import math
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_MAX_WORD = 64
MAX_SIDE = 1_000_000

_short = reprlib.Repr()
_short.maxlevel, _short.maxstring, _short.maxother = 2, 60, 60


def short(value: Any) -> str:
    """A value for a message, cut where it is long or deep."""
    return _short.repr(value)


def listed(names: Iterable[str]) -> str:
    """Names for a message, cut where there are many or where one is long."""
    names = [name if len(name) <= _MAX_WORD else short(name) for name in map(str, names)]
    return ", ".join(names[:20]) + (", …" if len(names) > 20 else "")


def is_number(word: str) -> bool:
    """Whether a word is written as a number; "nan" is not."""
    return len(word) <= _MAX_WORD and _NUMBER.fullmatch(word) is not None


def to_number(value: Any, name: str, expected: str = "a finite number") -> float:
    """A finite number, from a number or the text of one."""
    number = math.nan
    if isinstance(value, str) and is_number(value.strip()):
        number = float(value)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} must be {expected}, got {short(value)}")
    return number


def to_positive(value: Any, name: str) -> float:
    """A finite number above 0."""
    number = to_number(value, name, "a finite number above 0")
    if not number > 0:
        raise ValueError(f"{name} must be a finite number above 0, got {short(value)}")
    return number


def to_side(value: Any, name: str) -> int:
    """A side of an image, in pixels."""
    expected = f"a whole number of pixels, 1 to {MAX_SIDE}"
    number = to_number(value, name, expected)
    if not (1 <= number <= MAX_SIDE and number.is_integer()):
        raise ValueError(f"{name} must be {expected}, got {short(value)}")
    return int(number)


def holds_numbers(value: Any) -> bool:
    """Whether a value is a number other than 0, or may hold some."""
    if isinstance(value, str):
        words = value[:1000].replace(",", " ").split()
        return all(map(is_number, words)) and any(float(word) for word in words)
    if isinstance(value, (list, Mapping)):
        entries = value.values() if isinstance(value, Mapping) else value
        return any(isinstance(v, (list, Mapping)) or holds_numbers(v) for v in entries)
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value != 0


class Fields:
    """A mapping of a file. Its methods read an entry by name, and it knows which ones were read.

    Raises:
        ValueError: an entry that is missing or of the wrong kind.
    """

    def __init__(self, entries: Mapping[str, Any], where: str = ""):
        self.entries, self._where = entries, where
        self._read: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self.entries

    def path(self, name: str) -> str:
        """The entry's name with those of the mappings that it is in."""
        return f"{self._where}{name if len(str(name)) <= _MAX_WORD else short(name)}"

    def get(self, name: str, expected: str) -> Any:
        """The entry `name`; `expected` says what it must be, for the error."""
        if name not in self.entries:
            raise ValueError(f"{self.path(name)} is missing, it must be {expected}")
        self._read.add(name)
        return self.entries[name]

    def check_all_read(
        self,
        camera: str,
        *,
        known: tuple[str, ...] = (),
        like: Callable[[str, Any], Any] = lambda name, value: True,
    ) -> None:
        """That no number was left out, which might be a coefficient under another name.

        Args:
            camera: what the numbers are of. known: names of what may be left out. like: whether
                an entry, a name and a value, looks like coefficients.
        """
        left = [
            name for name, value in self.entries.items()
            if name not in self._read and name not in known and holds_numbers(value)
            and like(str(name), value)
        ]  # fmt: skip
        if left:
            where = listed(self.path(name) for name in left)
            raise ValueError(f"{camera} has no place for the numbers of {where}")

    def section(self, name: str) -> "Fields":
        """The entry as a mapping."""
        value = self.get(name, "a mapping")
        if not isinstance(value, Mapping):
            raise ValueError(f"{self.path(name)} must be a mapping, got {short(value)}")
        return Fields(value, f"{self.path(name)}.")

    def sections(self, name: str) -> "list[Fields]":
        """The entry as a list of mappings."""
        value = self.get(name, "a list of mappings")
        if not isinstance(value, list) or not all(isinstance(v, Mapping) for v in value):
            raise ValueError(f"{self.path(name)} must be a list of mappings, got {short(value)}")
        return [Fields(v, f"{self.path(name)}[{i}].") for i, v in enumerate(value)]

    def number(self, name: str, default: float | None = None) -> float:
        """The entry as a finite number; `default`, if there is one, where it is missing."""
        if default is not None and name not in self.entries:
            return default
        return to_number(self.get(name, "a finite number"), self.path(name))

    def positive(self, name: str) -> float:
        """The entry as a finite number above 0."""
        return to_positive(self.get(name, "a finite number above 0"), self.path(name))

    def side(self, name: str) -> int:
        """The entry as a side of an image, in pixels."""
        return to_side(self.get(name, "a whole number of pixels"), self.path(name))

    def text(self, name: str, expected: str = "text") -> str:
        """The entry as text."""
        value = self.get(name, expected)
        if not isinstance(value, str):
            raise ValueError(f"{self.path(name)} must be {expected}, got {short(value)}")
        return value

    def numbers(self, name: str, counts: tuple[int, ...]) -> list[float]:
        """A list of as many numbers as one of `counts`; as text, they stand between spaces."""
        expected = f"{' or '.join(map(str, counts))} finite numbers"
        value = self.get(name, expected)
        words = value.split() if isinstance(value, str) else value
        if not isinstance(words, list) or len(words) not in counts:
            raise ValueError(f"{self.path(name)} must be {expected}, got {short(value)}")
        return [to_number(word, f"{self.path(name)}[{i}]") for i, word in enumerate(words)]

    def sides(self, name: str) -> tuple[int, int]:
        """Two sides of an image, in the file's order."""
        return _pair(self.get(name, "two whole numbers of pixels"), self.path(name))

    def sizes(self, name: str, count: int) -> list[tuple[int, int]]:
        """A list of as many pairs, each a width and a height, as (H, W)."""
        value = self.get(name, f"{count} pairs of a width and a height")
        if not isinstance(value, list) or len(value) != count:
            raise ValueError(
                f"{self.path(name)} must be {count} pairs of a width and a height, got "
                f"{short(value)}"
            )
        return [_pair(pair, f"{self.path(name)}[{i}]")[::-1] for i, pair in enumerate(value)]


def _pair(value: Any, name: str) -> tuple[int, int]:
    words = value.split() if isinstance(value, str) else value
    if not isinstance(words, list) or len(words) != 2:
        raise ValueError(f"{name} must be two whole numbers of pixels, got {short(value)}")
    return to_side(words[0], f"{name}[0]"), to_side(words[1], f"{name}[1]")
