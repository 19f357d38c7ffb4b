"""Optional packages that some parts of darswin need."""

import importlib.util
import re
import shlex
from collections.abc import Sequence
from importlib.metadata import requires

# The names of modules that differ from their packages.
_MODULES = {"pillow": "PIL", "opencv-python-headless": "cv2", "scikit-learn": "sklearn"}


def lack(extra: str, modules: Sequence[str] | None = None) -> str | None:
    """A sentence that names the missing modules of an extra, or of `modules`; None if none is."""
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
    return f"{', '.join(missing)} missing; to install: pip install {packages}"
