"""Builds the compiled modules by calling CMake, which alone knows the sources and the flags."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pybind11
from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent


def pythons() -> str:
    """CMake's list DARSWIN_PYTHONS: this Python, and the others that the environment names."""
    code = (
        "import sysconfig; print(sysconfig.get_config_var('EXT_SUFFIX'), "
        "sysconfig.get_path('include'), sep=':')"
    )
    found = {}
    for python in (sys.executable, *os.environ.get("DARSWIN_PYTHONS", "").split()):
        entry = subprocess.check_output([python, "-c", code], text=True).strip()
        suffix, _, include = entry.partition(":")
        if Path(include, "Python.h").exists():
            found.setdefault(suffix, entry)
    return ";".join(found.values())


class CMakeBuild(build_ext):
    def get_ext_filename(self, fullname):
        if fullname.rpartition(".")[2].startswith("libdarswin"):
            return fullname.replace(".", "/") + ".so"
        return super().get_ext_filename(fullname)

    def build_extensions(self):
        torch = importlib.util.find_spec("torch")
        if torch is None:
            raise SystemExit(
                "darswin builds against an installed torch>=2.10: install torch first, "
                "then run pip with --no-build-isolation"
            )
        output = Path(self.get_ext_fullpath("darswin.libdarswin")).resolve().parent
        sanitize = os.environ.get("DARSWIN_SANITIZE", "")
        build = ROOT / "build" / os.environ.get("DARSWIN_BUILD", "cmake")
        subprocess.check_call(
            ["cmake", "--log-level=NOTICE", "-S", ROOT, "-B", build, "-G", "Ninja",
             f"-DCMAKE_MAKE_PROGRAM={shutil.which('ninja')}",
             f"-DTORCH_DIR={Path(torch.origin).parent}",
             f"-DPYBIND11_DIR={pybind11.get_include()}",
             f"-DDARSWIN_PYTHONS={pythons()}",
             f"-DDARSWIN_OUTPUT_DIR={output}",
             f"-DDARSWIN_SANITIZE={sanitize}",
             f"-DDARSWIN_ONLY_TIERS={os.environ.get('DARSWIN_ONLY_TIERS', '.*')}"]
        )  # fmt: skip
        subprocess.check_call(["cmake", "--build", build])


class PlatformWheel(bdist_wheel):
    """One wheel of a platform serves every Python: libdarswin.so does not depend on Python, and the
    wheel has a module darswin.frames._frames for each Python it was built for."""

    def get_tag(self):
        return "py3", "none", super().get_tag()[2]  # "any" if there are no modules


pure = os.environ.get("DARSWIN_PURE") == "1"  # a wheel without compiled modules, for any system
MODULES = ("libdarswin", "frames._frames", "frames.libdarswin_frames")
setup(
    ext_modules=[] if pure else [Extension(f"darswin.{name}", []) for name in MODULES],
    cmdclass={"build_ext": CMakeBuild, "bdist_wheel": PlatformWheel},
)
