"""Data sets of scenes on disk, small, in the form of each reader."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from darswin.lens import Lens, load, save
from darswin.lens.pixels import pixel_rays

CALIBRATIONS = Path(__file__).parent / "lens" / "files"
WOODSCAPE = CALIBRATIONS / "woodscape.json"
CLASSES = {"names": ["sky", "ground", "wall"], "colors": [[0, 0, 255], [0, 128, 0], [200, 0, 0]]}


def labels_of(theta: np.ndarray, azimuth: np.ndarray, classes: int = 3) -> np.ndarray:
    """Labels as a function of the ray: sectors of azimuth that change with every 0.4 rad of θ."""
    sector = np.floor(np.nan_to_num(azimuth) / (2 * np.pi) * 6 + 6)
    return ((sector + np.floor(np.nan_to_num(theta) / 0.4)) % classes).astype(np.uint8)


def distance_of(theta: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Metres as a function of the ray: smooth, from 2 to 10."""
    theta, azimuth = np.nan_to_num(theta), np.nan_to_num(azimuth)
    return (6 + 2 * np.cos(3 * theta) + 2 * np.sin(theta) * np.cos(azimuth)).astype(np.float32)


def rays_of(lens: Lens, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """θ, NaN where nothing is seen, and azimuth of each pixel, (H, W)."""
    theta, direction = pixel_rays(lens.to(torch.float64), size)
    azimuth = torch.atan2(direction[..., 1], direction[..., 0])
    return theta[0].numpy(), azimuth[0].numpy()


def picture_of(
    theta: np.ndarray, azimuth: np.ndarray, colors: Sequence[Sequence[int]], seed: int
) -> np.ndarray:
    """(H, W, 3) uint8: the labels' colours, with noise; black where nothing is seen."""
    noise = np.random.default_rng(seed).integers(0, 40, size=(*theta.shape, 3))
    image = np.asarray(colors)[labels_of(theta, azimuth, len(colors))] * 0.8 + noise
    return np.where(np.isnan(theta)[..., None], 0, image).astype(np.uint8)


def write_plain(
    folder: Path,
    count: int = 4,
    *,
    lens: str | Path | Lens = WOODSCAPE,
    size: tuple[int, int] = (121, 160),
    targets: Sequence[str] = ("labels", "distance"),
    split: str | None = None,
    own_lenses: bool = False,
    classes: dict | list | None = CLASSES,
    name: Callable[[int], str] = "{:03d}".format,
) -> Path:
    """`count` scenes in the plain form, which a lens sees: labels and distances of the ray.

    Args:
        split: a folder of a split in `folder`, or None. own_lenses: a file a picture.
    """
    place = folder if split is None else folder / split
    seen = (lens if isinstance(lens, Lens) else load(lens)).in_picture(size)
    if seen.image_size is None:
        seen = seen.replace(image_size=torch.tensor([size], dtype=torch.float32))
    theta, azimuth = rays_of(seen, size)
    for part in ("images", *targets):
        (place / part).mkdir(parents=True, exist_ok=True)
    for k in range(count):
        turned = azimuth + 0.3 * k
        colors = CLASSES["colors"]
        write(place / "images" / f"{name(k)}.png", picture_of(theta, turned, colors, k)[..., ::-1])
        if "labels" in targets:
            write(place / "labels" / f"{name(k)}.png", labels_of(theta, turned))
        if "distance" in targets:
            metres = np.round(distance_of(theta, turned) * 256).astype(np.uint16)
            write(place / "distance" / f"{name(k)}.png", metres)
        if own_lenses:
            (place / "lenses").mkdir(exist_ok=True)
            save(seen, place / "lenses" / f"{name(k)}.json")
    if not own_lenses:
        save(seen, place / "lens.json")
    if classes is not None:
        (folder / "classes.json").write_text(json.dumps(classes))
    return folder


def write(file: Path, array: np.ndarray) -> Path:
    """An array as PNG, BGR where it has colours; makes its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), array)
    return file
