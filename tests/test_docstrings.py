"""Docstrings: all public names, those in `__all__`, have one, and each names its subject."""

import importlib
import inspect
import pkgutil
from collections.abc import Iterator

import darswin

MODULES = [
    importlib.import_module(found.name)
    for found in pkgutil.walk_packages(darswin.__path__, "darswin.")
    if not found.name.endswith(("__main__", "libdarswin", "libdarswin_frames"))
]


def public_names() -> dict[str, object]:
    """Each public class, function and module-level object by its shortest full name."""
    found: dict[int, tuple[str, object]] = {}
    for module in [darswin, *MODULES]:
        for name in getattr(module, "__all__", ()):
            value, path = getattr(module, name), f"{module.__name__}.{name}"
            before = found.get(id(value))
            if before is None or len(path) < len(before[0]):
                found[id(value)] = (path, value)
    return dict(found.values())


def undocumented() -> Iterator[str]:
    for path, value in public_names().items():
        if inspect.isfunction(value) and not value.__doc__:
            yield path
        if not inspect.isclass(value):
            continue
        # The default docstring of a dataclass is its signature.
        if not vars(value).get("__doc__") or value.__doc__.startswith(f"{value.__name__}("):
            yield path
        for name, member in vars(value).items():
            known = inspect.isroutine(member) or inspect.isclass(member)
            public = not name.startswith("_") and (known or isinstance(member, property))
            if public and not inspect.getdoc(getattr(value, name)):  # also that of a base class
                yield f"{path}.{name}"


def test_every_module_has_a_docstring():
    assert not [module.__name__ for module in MODULES if not module.__doc__]


def test_every_public_name_has_a_docstring():
    assert not list(undocumented())


def test_the_public_names_are_few():
    """A name counts once for each list that has it: as `darswin.PolarView` and in its room."""
    names = [name for module in [darswin, *MODULES] for name in getattr(module, "__all__", ())]
    assert len(names) <= 165


def test_nothing_is_public_where_only_darswin_looks():
    rooms = ("cli", "train", "utils")
    public = {path.split(".")[1] for path in public_names() if path.count(".") > 1}
    assert public and public.isdisjoint(rooms)
