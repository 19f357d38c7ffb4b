"""The packages that some of darswin needs beyond its own requirements: what is missing, and how to
get it."""

import importlib.util
import re
import shlex
from collections.abc import Sequence
from importlib.metadata import requires

# Packages whose modules have other names.
_PACKAGES = {"PIL": "pillow", "cv2": "opencv-python-headless", "sklearn": "scikit-learn"}


def lack(extra: str, modules: Sequence[str]) -> str | None:
    """None if all modules are installed, else a sentence on which are not and what installs them.

    Args:
        extra: of darswin, which declares the modules' packages and their versions.
    """
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if not missing:
        return None
    of_extra = re.compile(rf"extra == ['\"]{extra}['\"]")
    declared = {}
    for requirement in requires("darswin") or ():
        name, _, when = requirement.partition(";")
        if of_extra.search(when):
            declared[re.split(r"[^\w.-]", name, maxsplit=1)[0]] = name.strip()
    packages = shlex.join(declared[_PACKAGES.get(module, module)] for module in missing)
    return f"{', '.join(missing)} missing; to install what is needed: pip install {packages}"
