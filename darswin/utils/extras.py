"""The packages that some of darswin needs beyond its own requirements."""

import importlib.util
import re
import shlex
from collections.abc import Sequence
from importlib.metadata import requires

# Packages whose modules have other names.
_MODULES = {"pillow": "PIL", "opencv-python-headless": "cv2", "scikit-learn": "sklearn"}


def lack(extra: str, modules: Sequence[str] | None = None) -> str | None:
    """A sentence that names those of an extra's modules, or of `modules`, that are missing."""
    of_extra = re.compile(rf"extra == ['\"]{extra}['\"]")
    declared = {}
    for requirement in requires("darswin") or ():
        named, _, when = requirement.partition(";")
        if of_extra.search(when):
            package = re.split(r"[^\w.-]", named, maxsplit=1)[0]
            declared[_MODULES.get(package, package)] = named.strip()
    wanted = declared if modules is None else modules
    missing = [module for module in wanted if importlib.util.find_spec(module) is None]
    if not missing:
        return None
    packages = shlex.join(declared[module] for module in missing)
    return f"{', '.join(missing)} missing; to install what is needed: pip install {packages}"
