"""The packages that some of darswin needs beyond its own requirements: what is missing, and how to
get it."""

import importlib.util
import re
import shlex
from collections.abc import Sequence
from importlib.metadata import requires


def lack(extra: str, modules: Sequence[str]) -> str | None:
    """None if all modules are installed, else a sentence on which are not and what installs them.

    It names the packages of the extra with their versions, as no index has darswin itself.
    """
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if not missing:
        return None
    declared = (requirement.partition(";") for requirement in requires("darswin") or ())
    of_extra = re.compile(rf"extra == ['\"]{extra}['\"]")
    packages = shlex.join(name.strip() for name, _, when in declared if of_extra.search(when))
    return f"{', '.join(missing)} missing; to install what is needed: pip install {packages}"
