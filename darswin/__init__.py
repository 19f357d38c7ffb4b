"""Wide-angle and fisheye images for vision transformers, fast on CPUs.

A public name is imported when it is first used, and torch with it: `import darswin` alone loads
neither, and registers no operator. `import darswin.ops` registers those of `torch.ops.darswin`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from darswin import boxes, compat, frames, lens, models, ops, views
    from darswin.deploy.optimize import optimize
    from darswin.layers.attention import PolarWindowAttention
    from darswin.lens.rig import Rig
    from darswin.models import DarSwin, create_model, list_models, load_model
    from darswin.views import PolarView

    __version__: str

__all__ = [
    "DarSwin",
    "PolarView",
    "PolarWindowAttention",
    "Rig",
    "boxes",
    "compat",
    "create_model",
    "frames",
    "lens",
    "list_models",
    "load_model",
    "models",
    "ops",
    "optimize",
    "views",
]

# The module of each public name that is no module.
_MODULES = {
    "DarSwin": "darswin.models",
    "PolarView": "darswin.views",
    "PolarWindowAttention": "darswin.layers.attention",
    "Rig": "darswin.lens.rig",
    "create_model": "darswin.models",
    "list_models": "darswin.models",
    "load_model": "darswin.models",
    "optimize": "darswin.deploy.optimize",
}


if not TYPE_CHECKING:  # with a `__getattr__`, mypy would take any name for a public one

    def __getattr__(name: str) -> object:
        if name == "__version__":
            from importlib.metadata import version

            value = version("darswin")
        elif name in _MODULES:
            value = getattr(import_module(_MODULES[name]), name)
        elif name in __all__:
            value = import_module(f"darswin.{name}")
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
