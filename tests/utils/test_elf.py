"""Compiled modules that are cut off or damaged are told before they are loaded."""

import importlib.util
from pathlib import Path

import pytest
from helpers import refused

from darswin.ops import _module
from darswin.utils.elf import check_whole

pytestmark = pytest.mark.compiled


@pytest.mark.parametrize("module", ["ops", "frames"])
def test_cut_off_modules_are_told(module, tmp_path):
    found = importlib.util.find_spec("darswin.frames._frames")
    whole = Path(_module.FILE if module == "ops" else found.origin)
    check_whole(whole)
    data, path = whole.read_bytes(), tmp_path / whole.name
    if data[:6] != b"\x7fELF\x02\x01":
        pytest.skip("no ELF file of 64 bits")
    for size in (6, 40, 63, 64, 100, 5000, len(data) // 2, len(data) - 1):
        for end in (b"", bytes(len(data) - size)) if size < len(data) - 1 else (b"",):
            path.write_bytes(data[:size] + end)
            refused(f"{whole.name} is cut off or damaged", check_whole, path, error=ImportError)
    path.write_bytes(b"MZ and more")
    check_whole(path)  # no ELF file: whoever loads it says what is wrong


def test_loading_a_cut_off_module_is_an_import_error(tmp_path, monkeypatch):
    path = tmp_path / "libdarswin.so"
    path.write_bytes(_module.FILE.read_bytes()[:5000])
    monkeypatch.setattr(_module, "FILE", path)
    refused(r"is cut off or damaged.*Rebuild it", _module.load, error=ImportError)
