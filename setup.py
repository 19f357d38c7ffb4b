"""Builds libdarswin.so by calling CMake, which alone knows the sources and the flags."""

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent


class CMakeBuild(build_ext):
    def get_ext_filename(self, fullname):
        return fullname.replace(".", "/") + ".so"

    def build_extension(self, ext):
        torch = importlib.util.find_spec("torch")
        if torch is None:
            raise SystemExit(
                "darswin builds against an installed torch>=2.10: install torch first, "
                "then run pip with --no-build-isolation"
            )
        output = Path(self.get_ext_fullpath(ext.name)).resolve().parent
        sanitize = os.environ.get("DARSWIN_SANITIZE", "")
        build = ROOT / "build" / ("cmake-sanitized" if sanitize else "cmake")
        subprocess.check_call(
            ["cmake", "--log-level=NOTICE", "-S", ROOT, "-B", build, "-G", "Ninja",
             f"-DCMAKE_MAKE_PROGRAM={shutil.which('ninja')}",
             f"-DTORCH_DIR={Path(torch.origin).parent}",
             f"-DDARSWIN_OUTPUT_DIR={output}",
             f"-DDARSWIN_SANITIZE={sanitize}",
             f"-DDARSWIN_ONLY_TIER={os.environ.get('DARSWIN_ONLY_TIER', '')}"]
        )  # fmt: skip
        subprocess.check_call(["cmake", "--build", build])


class PlatformWheel(bdist_wheel):
    """The module holds nothing of Python: one wheel of a platform serves every version."""

    def get_tag(self):
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[Extension("darswin.libdarswin", sources=[])],
    cmdclass={"build_ext": CMakeBuild, "bdist_wheel": PlatformWheel},
)
