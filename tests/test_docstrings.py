"""Every public name says what it is: its own docstring, or that of what it overrides in darswin."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from functools import cached_property

import darswin
from darswin.ops import triton

MODULES = [
    importlib.import_module(found.name)
    for found in pkgutil.walk_packages(darswin.__path__, "darswin.")
    if not found.name.endswith(("__main__", "libdarswin"))  # what runs, and what is no module
    and (triton.INSTALLED or not found.name.startswith("darswin.ops.triton."))
]


def public_members(of: type) -> Iterator[tuple[str, object]]:
    """Methods and properties that a class defines itself."""
    for name, member in vars(of).items():
        plain = inspect.isfunction(member) or inspect.isclass(member)
        wrapped = isinstance(member, property | cached_property | classmethod | staticmethod)
        if not name.startswith("_") and (plain or wrapped):
            yield name, member


def inherited(of: type, name: str) -> bool:
    """Whether a class of darswin below says what the method is; torch says it of `extra_repr`."""
    bases = [base for base in of.__mro__[1:] if base.__module__.startswith("darswin")]
    said = any(inspect.getdoc(vars(base)[name]) for base in bases if name in vars(base))
    return said or name == "extra_repr"


def missing() -> Iterator[str]:
    for module in MODULES:
        for name, thing in vars(module).items():
            own = getattr(thing, "__module__", None) == module.__name__
            if name.startswith("_") or not own:
                continue
            if inspect.isfunction(thing) and not thing.__doc__:
                yield f"{module.__name__}.{name}"
            if inspect.isclass(thing):
                # A dataclass without a docstring has its signature for one.
                if not vars(thing).get("__doc__") or thing.__doc__.startswith(f"{name}("):
                    yield f"{module.__name__}.{name}"
                for method, member in public_members(thing):
                    if not getattr(member, "__doc__", None) and not inherited(thing, method):
                        yield f"{module.__name__}.{name}.{method}"


def test_every_module_says_what_it_is():
    assert not [module.__name__ for module in MODULES if not module.__doc__]


def test_every_public_name_has_a_docstring():
    assert not list(missing())
