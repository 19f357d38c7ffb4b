"""Draws what a detector finds in real fisheye pictures: raw, in slices, in views and in tiles.

    python studies/real_pictures.py FOLDER --network detector.onnx --out out/real

FOLDER has pictures, NAME.jpg or NAME.png, and beside each its calibration NAME.json, in any format
that `darswin.lens.load` reads. Nothing is fetched: docs/study_pretrained.md names the repositories
of the pictures that it shows. The ONNX file is a detector of 512×512 pixels with outputs boxes,
scores and labels, as `pretrained.py` leaves it: out/pretrained/onnx/CenterNet-512-512.onnx.

It writes NAME.jpg, the picture in each way one below the other, and prints how many things of each
class were found, right or wrong: only eyes can tell. The best box of each class has its name.
"""

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from pretrained_scenes import COCO

from darswin import lens
from darswin.boxes import Instances
from darswin.frames.onnx import OnnxNetwork
from darswin.lens import Lens
from darswin.models.detections import in_picture
from darswin.utils.image import read_image
from darswin.views import Remap, make_view, up_of
from darswin.viz.pixels import draw_boxes

SIDE = 512  # px, of what the network sees
MEAN, STD = 0.0, 1 / 255  # the network takes pixels of 0 to 255
SLICES = {2: 0.56, 3: 0.5}  # the side of a slice in parts of the picture's, by the number in a row
COLOR = (255, 220, 0)


def seen_by(network: OnnxNetwork, picture: np.ndarray) -> Instances:
    """The detections in a flat picture (H, W, 3) of any size, which black rows make square."""
    scale = SIDE / max(picture.shape[:2])
    width, height = (round(scale * side) for side in picture.shape[1::-1])
    image = np.zeros((SIDE, SIDE, 3), np.float32)
    image[:height, :width] = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    (found,) = network(np.ascontiguousarray(image.transpose(2, 0, 1)[None]))
    return replace(found, boxes=found.boxes / scale)


def slices(network: OnnxNetwork, picture: np.ndarray, count: int) -> list[Instances]:
    """In `count` × `count` overlapping parts of the picture."""
    found = []
    height, width = (round(SLICES[count] * side) for side in picture.shape[:2])
    for y in np.linspace(0, picture.shape[0] - height, count).round().astype(int):
        for x in np.linspace(0, picture.shape[1] - width, count).round().astype(int):
            part = seen_by(network, picture[y : y + height, x : x + width])
            part = part.through(lambda xy: xy, (height, width), cut=(height, width))
            found.append(replace(part, boxes=part.boxes + np.array([x, y, x, y])))
    return found


def through(network: OnnxNetwork, picture: np.ndarray, remap: Remap) -> list[Instances]:
    """In a view, or in all of its tiles together."""
    images = remap.sampler("image", mean=MEAN, std=STD)(picture).reshape(-1, 3, SIDE, SIDE)
    return [in_picture(remap, network(images))]


def look(
    way: str, network: OnnxNetwork, picture: np.ndarray, camera: Lens, up: Sequence[float]
) -> Instances:
    """What is found in one way: "raw", "slices:2" with the whole picture, or a view's name."""
    kind, _, count = way.partition(":")
    if kind in ("raw", "slices"):
        whole = seen_by(network, picture).through(lambda xy: xy, picture.shape[:2])
        parts = [whole.with_columns(cut=np.zeros(len(whole), bool))]
        parts += slices(network, picture, int(count)) if kind == "slices" else []
    else:
        options = {"count": int(count)} if count else {}
        view = make_view(kind, (SIDE, SIDE), up=tuple(up), **options)
        parts = through(network, picture, view.at(camera, picture.shape[:2]))
    return Instances.joined(parts).merged()


def up_in(calibration: Path, pitch: float) -> tuple[float, float, float]:
    """The direction away from gravity, by the calibration if it says so."""
    try:
        return lens.load_up(calibration)
    except ValueError:
        return up_of(pitch=-math.radians(pitch))


def drawn(title: str, picture: np.ndarray, found: Instances, width: int) -> np.ndarray:
    """The picture of a width with its boxes, below a title."""
    scale = width / picture.shape[1]
    size = width, round(scale * picture.shape[0])
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else None)
    texts = [COCO[label] for label in found.labels]
    texts = [text if text not in texts[:k] else "" for k, text in enumerate(texts)]
    image = draw_boxes(resized, scale * found.boxes, texts, [COLOR] * len(texts))
    bar = np.full((34, width, 3), 255, np.uint8)
    cv2.putText(bar, title, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 2)
    return np.vstack((bar, image))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--network", required=True)
    parser.add_argument("--out", type=Path, default=Path("out") / "real")
    parser.add_argument("--threshold", type=float, default=0.35)
    parser.add_argument("--ways", nargs="*", default=["raw", "slices:2", "mercator", "tiles:5"])
    parser.add_argument(
        "--pitch", type=float, default=0.0, help="degrees that cameras look down, if not known"
    )
    parser.add_argument("--titles", nargs="*", help="above the pictures, in place of the ways")
    parser.add_argument("--width", type=int, default=1200, help="of the drawn pictures, px")
    parser.add_argument("--upper", type=float, default=1.0, help="the share of rows that are drawn")
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    network = OnnxNetwork(args.network, (SIDE, SIDE), threshold=args.threshold)
    for path in sorted([*args.folder.glob("*.jpg"), *args.folder.glob("*.png")]):
        picture, calibration = read_image(path), path.with_suffix(".json")
        camera = lens.load(calibration, image_size=picture.shape[:2])
        up, shown = up_in(calibration, args.pitch), round(args.upper * picture.shape[0])
        panels = []
        for way, title in zip(args.ways, args.titles or args.ways, strict=True):
            found = look(way, network, picture, camera, up)
            counts = Counter(COCO[label] for label in found.labels)
            print(f"{path.stem}, {way}: " + ", ".join(f"{n} {of}" for of, n in counts.items()))
            panels.append(drawn(title, picture[:shown], found, args.width))
        drawing, quality = np.vstack(panels)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85]
        cv2.imwrite(str(args.out / f"{path.stem}.jpg"), drawing, quality)


if __name__ == "__main__":
    main()
