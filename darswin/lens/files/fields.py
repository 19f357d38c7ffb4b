"""Entries of a file. Errors name the entry, the expected value and the value found."""

import math
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_COEFFICIENTS = re.compile(r"^d(\d*|left|right)$|coef|(?<!un)dist(?!an[ct])")
_COEFFICIENT = re.compile(r"(cam)?[dkps]\d+")
_YES, _NO = ("1", "true", "yes", "on"), ("0", "false", "no", "off")
_MAX_WORD = 64
MAX_SIDE = 1_000_000

_short = reprlib.Repr()
_short.maxlevel, _short.maxstring, _short.maxother = 2, 60, 60


def short(value: Any) -> str:
    """A value for an error message; a long or deep one is cut."""
    return _short.repr(value)


def listed(names: Iterable[str]) -> str:
    """Names for an error message; many or long names are cut."""
    names = [name if len(name) <= _MAX_WORD else short(name) for name in map(str, names)]
    return ", ".join(names[:20]) + (", …" if len(names) > 20 else "")


def is_number(word: str) -> bool:
    """True if a word is a number in decimal notation; false for "nan"."""
    return len(word) <= _MAX_WORD and _NUMBER.fullmatch(word) is not None


def to_number(
    value: Any,
    name: str,
    expected: str = "a finite number",
    holds: Callable[[float], bool] = math.isfinite,
) -> float:
    """A finite number for which `holds` is true, from a number or its text."""
    number = math.nan
    if isinstance(value, str) and is_number(value.strip()):
        number = float(value)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
    if not (math.isfinite(number) and holds(number)):
        raise ValueError(f"{name} must be {expected}, got {short(value)}")
    return number


def to_side(value: Any, name: str, least: int = 1) -> int:
    """A whole number of pixels."""
    expected = f"a whole number of pixels, {least} to {MAX_SIDE}"
    number = to_number(value, name, expected, lambda n: least <= n <= MAX_SIDE and n.is_integer())
    return int(number)


def holds_numbers(value: Any) -> bool:
    """True for a number other than 0, and for a list or mapping that may hold one."""
    if isinstance(value, str):
        words = value[:1000].replace(",", " ").split()
        return all(map(is_number, words)) and any(float(word) for word in words)
    if isinstance(value, (list, Mapping)):
        entries = value.values() if isinstance(value, Mapping) else value
        return any(isinstance(v, (list, Mapping)) or holds_numbers(v) for v in entries)
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value != 0


def _is_zero(value: Any) -> bool:
    return str(value) != "False" and is_number(str(value)) and float(value) == 0


def to_flag(value: Any, name: str) -> bool:
    """Yes or no, in the words of JSON, YAML, Python and OpenCV."""
    word = plain_name(str(value)) if isinstance(value, (str, int)) else ""
    if word not in (*_YES, *_NO):
        raise ValueError(f"{name} must be 0 or 1, got {short(value)}")
    return word in _YES


def plain_name(name: str) -> str:
    """A name in lower case without separators, in which programs spell names differently."""
    return re.sub(r"[\W_]+", "", name.lower())


def like_coefficients(name: str, value: Any) -> bool:
    """True if an entry may be a distortion coefficient or a list of them, judged by its name.
    False for standard deviations of coefficients."""
    plain = plain_name(name)
    alone = not isinstance(value, (list, Mapping))
    found = _COEFFICIENTS.search(plain) or (alone and _COEFFICIENT.fullmatch(plain))
    return bool(found) and "std" not in plain


class Fields:
    """A mapping of a file. Its methods read entries by name and remember which ones were read.

    The methods raise ValueError for an entry that is missing or of the wrong kind.
    """

    def __init__(self, entries: Mapping[str, Any], where: str = ""):
        self.entries, self._where = entries, where
        self._read: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self.entries

    def path(self, name: str) -> str:
        """The entry's name after the names of the mappings around it, as in `cam0.intrinsics`."""
        return f"{self._where}{name if len(str(name)) <= _MAX_WORD else short(name)}"

    def get(self, name: str, expected: str) -> Any:
        """The entry `name`; `expected` describes a valid value in the error."""
        if name not in self.entries:
            raise ValueError(f"{self.path(name)} is missing: it must be {expected}")
        self._read.add(name)
        return self.entries[name]

    def check_all_read(
        self, camera: str, like: Callable[[str, Any], bool] = lambda name, value: True
    ) -> None:
        """Raises ValueError if an entry that holds numbers was not read: it might be a coefficient
        under another name. Only entries for which `like` is true count."""
        left = [
            self.path(name) for name, value in self.entries.items()
            if name not in self._read and like(str(name), value) and holds_numbers(value)
        ]  # fmt: skip
        if left:
            raise ValueError(f"{camera} does not use the numbers of {listed(left)}")

    def of_kind(self, name: str, kind: type, expected: str) -> Any:
        value = self.get(name, expected)
        if not isinstance(value, kind):
            raise ValueError(f"{self.path(name)} must be {expected}, got {short(value)}")
        return value

    def section(self, name: str) -> "Fields":
        return Fields(self.of_kind(name, Mapping, "a mapping"), f"{self.path(name)}.")

    def sections(self, name: str) -> "list[Fields]":
        expected = "a list of mappings"
        entries = self.of_kind(name, list, expected)
        if not all(issubclass(kind, Mapping) for kind in {*map(type, entries)}):
            raise ValueError(f"{self.path(name)} must be {expected}, got {short(entries)}")
        where = self.path(name)
        return [Fields(entry, f"{where}[{i}].") for i, entry in enumerate(entries)]

    def number(self, name: str, default: float | None = None, *expected: Any) -> float:
        """The entry as a finite number; `default`, if given, for a missing entry. `expected` are
        the last arguments of `to_number`."""
        if default is not None and name not in self.entries:
            return default
        value = self.get(name, expected[0] if expected else "a finite number")
        return to_number(value, self.path(name), *expected)

    def positive(self, name: str) -> float:
        return self.number(name, None, "a finite number above 0", lambda n: n > 0)

    def values(
        self, names: str, default: float | None = None, prefix: str = ""
    ) -> dict[str, float]:
        """Several numbers by our names, such as "fx fy k1". "fx=gamma1" reads `fx` from the file's
        entry `gamma1`, after a prefix. Focal lengths must be above 0."""
        found = {}
        for word in names.split():
            ours, _, theirs = word.partition("=")
            name = prefix + (theirs or ours)
            is_focal = ours in ("fx", "fy")
            found[ours] = self.positive(name) if is_focal else self.number(name, default)
        return found

    def side(self, name: str) -> int:
        """One side of an image, px."""
        return to_side(self.get(name, "a whole number of pixels"), self.path(name))

    def sides(self, name: str) -> tuple[int, int]:
        """Two sides of an image, px, in the file's order, from a list or text with spaces."""
        expected = "two whole numbers of pixels"
        value, where = self.get(name, expected), self.path(name)
        words = value.split() if isinstance(value, str) else value
        if not isinstance(words, list) or len(words) != 2:
            raise ValueError(f"{where} must be {expected}, got {short(value)}")
        return to_side(words[0], f"{where}[0]"), to_side(words[1], f"{where}[1]")

    def text(self, name: str, expected: str = "text") -> str:
        return self.of_kind(name, str, expected)

    def one_of(self, name: str, allowed: Iterable[str]) -> str:
        """One of several words, which programs spell differently, in our spelling."""
        words = {plain_name(word): word for word in allowed}
        expected = f"one of {', '.join(words.values())}"
        value = self.text(name, expected)
        if plain_name(value) not in words:
            raise ValueError(f"{self.path(name)} must be {expected}, got {short(value)}")
        return words[plain_name(value)]

    def numbers(self, name: str, counts: tuple[int, ...], least: int | None = None) -> list[float]:
        """A list of numbers, from a list or from text with spaces; `counts` are the valid lengths.

        Zeros at the end of a list of another length, but not its first `least` numbers, are left
        out: some programs fill up shorter lists of coefficients.
        """
        expected = f"{' or '.join(map(str, counts))} finite numbers"
        value = self.get(name, expected)
        words = value.split() if isinstance(value, str) else value
        if isinstance(words, list) and least is not None:
            count = len(words)
            while count > least and count not in counts and _is_zero(words[count - 1]):
                count -= 1
            words = words[:count]
        if not isinstance(words, list) or len(words) not in counts:
            raise ValueError(f"{self.path(name)} must be {expected}, got {short(value)}")
        return [to_number(word, f"{self.path(name)}[{i}]") for i, word in enumerate(words)]
