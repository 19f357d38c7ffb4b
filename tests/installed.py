"""Runs tests on the darswin that this Python has installed, not on the checkout's: the tests of the
operators and of darswin.frames, or, without the compiled modules, those of models and lenses.

    python tests/installed.py [options of pytest]

Beside darswin it needs pytest, hypothesis and allpairspy.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests"
COMPILED = [TESTS / "ops", TESTS / "frames" / "test_plans.py"]
PURE = [
    "-m",
    "not slow and not compiled",
    TESTS / "layers",
    TESTS / "lens" / "test_models.py",
    TESTS / "models" / "test_models.py",
]


def main(options: list[str]) -> int:
    import darswin

    if Path(darswin.__file__).is_relative_to(ROOT / "darswin"):
        sys.exit(f"darswin must be an installed one, got the checkout's, {darswin.__file__}")
    tests = PURE if darswin.ops.cpu_capability() == "reference" else COMPILED
    settings = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT)]
    with tempfile.TemporaryDirectory() as elsewhere, contextlib.chdir(elsewhere):
        return pytest.main(["-q", *settings, *options, *map(str, tests)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
