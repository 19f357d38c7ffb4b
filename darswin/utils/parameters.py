"""Errors that carry the names of their parameters, so that a command can show them as its flags."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

Said = TypeVar("Said", bound=Exception)


def naming(said: Said, *parameters: str) -> Said:
    """The same error or warning, which now carries the parameters that its text has in `backticks`.

    Errors that are raised from this one need not carry them again.
    """
    vars(said)["parameters"] = parameters
    return said


def check(name: str, value: object, ok: bool, allowed: str) -> None:
    """Raises ValueError, which names the parameter, what it must be, and its value, unless `ok`."""
    if not ok:
        raise naming(ValueError(f"`{name}` must be {allowed}, got {value!s:.200}"), name)


def check_statistics(mean: Sequence[float] | None, std: Sequence[float] | None) -> None:
    """ValueError unless a mean and a std are parts of 255, as in (pixel/255 - mean) / std. Other
    tools write them for pixels from 0 to 255."""
    for name, values in (("mean", mean or ()), ("std", std or ())):
        given = ",".join(f"{value:g}" for value in values)
        check(name, given, all(map(math.isfinite, values)), "finite")
        most = max(map(abs, values), default=0.0)
        hint = "in parts of 255, at most 1"
        if 1 < most <= 255:
            parts = ",".join(f"{value / 255:.4g}" for value in values)
            hint += f" (of pixels from 0 to 255, this is {parts})"
        check(name, given, most <= 1, hint)
        if name == "std":
            check(name, given, all(value > 0 for value in values), "above 0")


def with_flags(said: Exception, flag_of: Callable[[str], str] = "--{}".format) -> str:
    """The text of an error or a warning. Flags replace the parameters that it, or an error that
    caused it, carries."""
    text = str(said)
    cause: BaseException | None = said
    while cause is not None:
        for name in getattr(cause, "parameters", ()):
            text = text.replace(f"`{name}`", flag_of(name))
        cause = cause.__cause__
    return text
