"""Errors that carry the names of their parameters, so that a command can show them as its flags."""

from collections.abc import Callable
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
