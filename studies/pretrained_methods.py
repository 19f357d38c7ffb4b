"""What the pretrained study compares: ways to show a wide picture to a detector.

A `Look` is one view of a picture. A method is one or several looks, whose detections are merged.
Detections are found once for each network, picture and look, and kept in files.
"""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import onnxruntime
from pretrained_files import MODELS, Files
from pretrained_graphs import DETECTORS, export
from pretrained_scenes import LENSES, SIZE, WRONG, Shot, spherical

from darswin import frames
from darswin.boxes import Instances
from darswin.deploy import camera
from darswin.lens import Lens
from darswin.views import make_view

LEAST = 0.02  # the lowest score of a detection that counts for the average precision
SURE = 0.3  # the lowest score of a detection that counts for recall and precision
PICTURE_TOP = (0.0, -1.0, 0.0)


@dataclass(frozen=True)
class Look:
    """A view of a picture; or "raw": the reduced picture itself, or slices of it."""

    view: str
    size: tuple[int, int] = (512, 512)
    options: dict[str, Any] = field(default_factory=dict)
    tilted: bool = False  # level with the picture, not with gravity
    wrong: bool = False  # told a wrong lens

    def resized(self, side: int) -> "Look":
        return Look(self.view, (side, side), self.options, self.tilted, self.wrong)


def tiles(count: int, side: int = 512, **others: Any) -> Look:
    return Look("tiles", (side, side), dict(count=count), **others)


def slices(count: int, side: int) -> Look:
    """`count` × `count` overlapping squares of the picture, for which no lens is needed."""
    return Look("raw", options=dict(count=count, side=side))


def ring(count: int, theta_deg: float, fov_deg: float, **others: Any) -> Look:
    """Tiles around the axis of a camera that looks down, without one in the middle."""
    theta, turn = math.radians(theta_deg), 2 * math.pi / count
    around = [
        (
            math.sin(theta) * math.cos(k * turn),
            math.sin(theta) * math.sin(k * turn),
            math.cos(theta),
        )
        for k in range(count)
    ]
    return Look("tiles", options=dict(directions=around, tile_fov=math.radians(fov_deg)), **others)


RAW, MERCATOR = Look("raw"), Look("mercator")
# Methods by their name in the tables. Each look of 512² costs about one run of CenterNet.
ONE_RUN = {
    "raw": (RAW,),
    "rectified, 120°": (Look("perspective", options=dict(fov=math.radians(120))),),
    "rectified, 160°": (Look("perspective", options=dict(fov=math.radians(160))),),
    "concentric square": (Look("square"),),
    "stereographic": (Look("stereographic"),),
    "cylindrical": (Look("cylindrical"),),
    "equirectangular": (Look("equirectangular"),),
    "mercator": (MERCATOR,),
}
SMALL_TILES = {"tiles: 4 of 256²": (tiles(4, 256),), "tiles: 5 of 224²": (tiles(5, 224),)}
LARGE = {f"{name}, 1024²": (ONE_RUN[name][0].resized(1024),)
         for name in ("raw", "stereographic", "equirectangular", "mercator")}  # fmt: skip
TILES = {f"tiles: {count}": (tiles(count),) for count in (4, 5, 6, 8, 9)}
MIXED = {
    "raw, and mercator": (RAW, MERCATOR),
    "tiles: 4, and mercator": (tiles(4), MERCATOR),
    "tiles: 5, and mercator": (tiles(5), MERCATOR),
    "tiles: 9, and mercator": (tiles(9), MERCATOR),
}
CONTROLS = {
    "mercator, wrong lens": (Look("mercator", wrong=True),),
    "tiles: 5, wrong lens": (tiles(5, wrong=True),),
}
# A camera that looks down; 288 × 896 pixels are as many as 512².
DOWN_METHODS = {
    "raw": (RAW,),
    "raw, 1024²": (RAW.resized(1024),),
    "stereographic": (Look("stereographic"),),
    "equirectangular, in the camera's frame": (Look("equirectangular", tilted=True),),
    "panorama": (Look("panorama", (288, 896)),),
    "panorama, 576 × 1792": (Look("panorama", (576, 1792)),),
    "tiles: 5": (tiles(5),),
    "ring of 6 tiles": (ring(6, 52, 85),),
    "ring of 6 tiles, level with the picture": (ring(6, 52, 85, tilted=True),),
    "ring of 8 tiles": (ring(8, 52, 80),),
}
LEVEL_METHODS = ONE_RUN | SMALL_TILES | LARGE | TILES | MIXED | CONTROLS
FEW = ("raw", "concentric square", "equirectangular", "stereographic", "mercator")
SMALL_METHODS = {name: LEVEL_METHODS[name] for name in (
    *FEW, "raw, 1024²", "mercator, 1024²", "tiles: 4", "tiles: 5", "tiles: 9",
    "tiles: 5, wrong lens",
)}  # fmt: skip
SECOND_METHODS = {name: LEVEL_METHODS[name] for name in (
    *FEW, "cylindrical", "tiles: 4", "tiles: 5", "tiles: 9", "tiles: 5, wrong lens",
)}  # fmt: skip
CONTROL_METHODS = {name: ONE_RUN[name] for name in (
    "raw", "concentric square", "equirectangular", "mercator", "stereographic",
)}  # fmt: skip
# The methods of each table, by network and split.
STUDIED: dict[tuple[str, str], dict[str, tuple[Look, ...]]] = {
    ("CenterNet", "level"): LEVEL_METHODS,
    ("CenterNet", "small"): SMALL_METHODS,
    ("CenterNet", "down"): DOWN_METHODS,
    ("CenterNet", "perspective"): CONTROL_METHODS,
    ("NanoDet", "level"): SECOND_METHODS,
}

# Slices of 576² overlap by 22 %, those of 512² by half, and those of 410² by a quarter. The last
# show every third of the picture larger than it is. sahi adds the whole picture unless told not to.
SLICES = {
    "slices: 4": (slices(2, 576),),
    "slices: 4, and raw": (slices(2, 576), RAW),
    "slices: 9": (slices(3, 512),),
    "slices: 9, and raw": (slices(3, 512), RAW),
    "slices: 9 of 410²": (slices(3, 410),),
}
BESIDE = {name: LEVEL_METHODS[name] for name in (
    "raw", "raw, 1024²", "mercator", "tiles: 4", "tiles: 5", "tiles: 9", "tiles: 4, and mercator",
    "tiles: 9, and mercator", "tiles: 5, wrong lens",
)}  # fmt: skip
# Slices of CenterNet, and what they are compared with, by split.
SLICED: dict[str, dict[str, tuple[Look, ...]]] = {
    "level": SLICES | BESIDE,
    "small": SLICES | BESIDE,
    "down": SLICES
    | {name: DOWN_METHODS[name] for name in ("raw", "raw, 1024²", "panorama", "tiles: 5")}
    | {
        "ring of 6 tiles": DOWN_METHODS["ring of 6 tiles"],
        "tiles: 5, wrong lens": CONTROLS["tiles: 5, wrong lens"],
        "ring of 6 tiles, wrong lens": (ring(6, 52, 85, wrong=True),),
    },
}


class Found(NamedTuple):
    """Detections in the pixels of the camera's picture."""

    boxes: np.ndarray  # (K, 4)
    scores: np.ndarray  # (K,)
    labels: np.ndarray  # (K,), numbers of COCO's classes
    visible: np.ndarray  # (K,), the share of the box that the picture shows
    cut: np.ndarray  # (K,), bool: it ends at the border of a tile or a slice
    view: np.ndarray  # (K,), the number of the tile or slice


class Detector:
    """A detector as an ONNX file for each size of its images, run by ONNX Runtime on one thread."""

    def __init__(self, files: Files, name: str) -> None:
        self.files, self.name = files, name
        self.kind = DETECTORS[name]
        self.mean, self.std, self.side = self.kind.mean, self.kind.std, self.kind.side
        self._sessions: dict[tuple[int, int], Any] = {}

    def session(self, size: tuple[int, int]) -> Any:
        if size not in self._sessions:
            file = self.files.folder.parent / "onnx" / f"{self.name}-{size[0]}-{size[1]}.onnx"
            if not file.exists():
                export(self.kind(self.files(MODELS)), size, file)
            options = onnxruntime.SessionOptions()
            options.intra_op_num_threads = options.inter_op_num_threads = 1
            self._sessions[size] = onnxruntime.InferenceSession(str(file), options)
        return self._sessions[size]

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Boxes (K, 4), scores (K,) and labels (K,) of a normalised image (3, H, W)."""
        session = self.session(image.shape[1:])
        found = [of[0] for of in session.run(None, {"images": image[None]})]
        kept = found[1] >= LEAST
        return tuple(of[kept] for of in found)

    def normalised(self, image: np.ndarray) -> np.ndarray:
        """An image (H, W, 3) uint8 as the network takes it."""
        image = (image.astype(np.float32) / 255 - self.mean) / self.std
        return np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)

    def fitted(self, look: Look) -> Look:
        """The look at the network's own size, if the look has the usual one."""
        return look.resized(self.side) if look.size == (512, 512) else look


def told_lens(name: str, wrong: bool) -> Lens:
    return spherical(*WRONG[name]) if wrong else LENSES[name]()


@lru_cache(2)  # plans of many pixels take much memory
def _sampler(
    view: str, size: tuple[int, int], options: str, lens: str, wrong: bool,
    mean: tuple[float, ...], std: tuple[float, ...],
) -> frames.Sampler:  # fmt: skip
    seen = make_view(view, size, **json.loads(options))
    plan = camera.plan(
        seen, told_lens(lens, wrong), (SIZE, SIZE), output="image", mean=mean, std=std
    )
    return frames.Sampler(plan)


def sampler_of(look: Look, scene: Shot, detector: Detector) -> frames.Sampler:
    """What reads the pictures of a scene's lens for a look."""
    options = dict(look.options)
    if look.view != "square":
        options["up"] = PICTURE_TOP if look.tilted else tuple(scene.up)
    text = json.dumps(options)
    where = scene.lens_name, look.wrong, detector.mean, detector.std
    return _sampler(look.view, look.size, text, *where)


def detect(look: Look, scene: Shot, picture: np.ndarray, detector: Detector) -> Found:
    """The detections of a look, in the picture's pixels."""
    parts = []
    if look.view == "raw":
        for k, (x, y, side) in enumerate(squares(look)):
            image = picture[y : y + side, x : x + side]
            how = cv2.INTER_AREA if side > look.size[0] else cv2.INTER_LINEAR
            image = cv2.resize(image, look.size[::-1], interpolation=how)
            found, scores, labels = detector(detector.normalised(image))
            seen = Instances(found).through(lambda xy: xy, look.size, cut=look.size)
            cut = seen.more["cut"] & (side < SIZE)
            found = found * (side / look.size[0]) + np.array([x, y, x, y], found.dtype)
            ones = np.ones(len(scores))
            parts.append(Found(found, scores, labels, ones, cut, k * ones))
        return joined(parts)
    sampler = sampler_of(look, scene, detector)
    seen = sampler(picture)
    for tile, image in enumerate(seen if seen.ndim == 4 else seen[None]):
        points_map = partial(sampler.plan.points, tile=tile)
        found = Instances(*detector(image)).through(points_map, (SIZE, SIZE), cut=look.size)
        parts.append(columns_of(found.with_columns(view=np.full(len(found), tile))))
    found = joined(parts)
    return Found(*(of[found.visible > 0] for of in found))


def columns_of(found: Instances) -> Found:
    more = (found.more[name] for name in ("visible", "cut", "view"))
    return Found(found.boxes, found.scores, found.labels, *more)


def squares(look: Look) -> list[tuple[int, int, int]]:
    """The squares of the picture that a look without a lens shows: x, y and side."""
    count, side = look.options.get("count", 1), look.options.get("side", SIZE)
    starts = np.linspace(0, SIZE - side, count).round().astype(int).tolist()
    return [(x, y, side) for y in starts for x in starts]


def runs_of(method: tuple[Look, ...]) -> int:
    """The pictures that the network sees."""
    return sum(
        len(squares(of)) if of.view == "raw"
        else of.options.get("count") or len(of.options["directions"]) if of.view == "tiles"
        else 1
        for of in method
    )  # fmt: skip


def joined(parts: list[Found]) -> Found:
    return Found(*(np.concatenate(of) for of in zip(*parts, strict=True)))


def merged(parts: list[Found]) -> Found:
    """The detections of several views, each thing once."""
    found = joined([of._replace(view=of.view + 100 * k) for k, of in enumerate(parts)])
    more = dict(visible=found.visible, cut=found.cut, view=found.view)
    return columns_of(Instances(*found[:3], more=more).merged())


def look_file(folder: Path, look: Look, detector: Detector) -> Path:
    """The file that keeps the detections of a look of a scene."""
    told = [detector.name, asdict(look), Found._fields]
    if look.view == "tiles":  # what "count" means may change
        parts = make_view("tiles", look.size, **look.options).tiles
        told += [[tile.direction, tile.fov] for tile in parts]
    text = json.dumps(told, sort_keys=True)
    return folder / f"{look.view}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.npz"


def found_by(
    method: tuple[Look, ...], scene: Shot, picture: np.ndarray, detector: Detector, folder: Path
) -> Found:
    """The detections of a method, which are found once and then read from `folder`."""
    parts = []
    for look in map(detector.fitted, method):
        file = look_file(folder, look, detector)
        if not file.exists():
            folder.mkdir(parents=True, exist_ok=True)
            partial = file.with_suffix(".part.npz")
            np.savez(partial, **detect(look, scene, picture, detector)._asdict())
            partial.replace(file)
        with np.load(file) as stored:
            parts.append(Found(*(stored[name] for name in Found._fields)))
    return merged(parts) if runs_of(method) > 1 else parts[0]
