"""Builds darswin._C by calling CMake, which alone knows the sources and the flags."""

import importlib.util
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pybind11
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent


class CMakeBuild(build_ext):
    def build_extension(self, ext):
        torch = importlib.util.find_spec("torch")
        if torch is None:
            raise SystemExit(
                "darswin builds against an installed torch>=2.10: install torch first, "
                "then run pip with --no-build-isolation"
            )
        output = Path(self.get_ext_fullpath(ext.name)).resolve().parent
        sanitize = os.environ.get("DARSWIN_SANITIZE", "")
        kind = "sanitized" if sanitize else "cmake"
        build = ROOT / "build" / f"{kind}-{sysconfig.get_config_var('SOABI')}"
        subprocess.check_call(
            ["cmake", "--log-level=NOTICE", "-S", ROOT, "-B", build, "-G", "Ninja",
             f"-DTORCH_DIR={Path(torch.origin).parent}",
             f"-DDARSWIN_OUTPUT_DIR={output}",
             f"-DDARSWIN_SANITIZE={sanitize}",
             f"-DPython_EXECUTABLE={sys.executable}",
             f"-Dpybind11_DIR={pybind11.get_cmake_dir()}"]
        )  # fmt: skip
        subprocess.check_call(["cmake", "--build", build])


setup(ext_modules=[Extension("darswin._C", sources=[])], cmdclass={"build_ext": CMakeBuild})
