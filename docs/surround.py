"""Writes examples/surround, four pictures of the cameras of a car and their rig, from a checkout of
https://github.com/neozhaoliang/surround-view-system-introduction.

    python docs/surround.py FOLDER

That project holds a matrix for each camera, from its undistorted picture to a plan of the ground in
cm. It was found from four points. This program goes back to the points, prints them for
docs/tutorials/surround.md, and finds the poses with the code of that page. It also prints how far
corners of the pattern are from their places, and how much of the ground the project sees.
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from darswin import Rig, lens
from darswin.views import GroundView

ROOT = Path(__file__).parent.parent
SURROUND = ROOT / "examples" / "surround"
SIZE, SMALL = (640, 960), (480, 720)
THETA_MAX = math.radians(80)  # beyond, the four calibrations of one kind of lens differ
PLAN = (1200, 1600)  # cm
# The points in the plan of each camera, in cm, and how it lies in the plan of all.
POINTS = {
    "front": [(420, 300), (780, 300), (420, 460), (780, 460)],
    "back": [(420, 300), (780, 300), (420, 460), (780, 460)],
    "left": [(580, 300), (1140, 300), (580, 460), (1140, 460)],
    "right": [(460, 300), (1020, 300), (460, 460), (1020, 460)],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    SURROUND.mkdir(exist_ok=True)
    cameras, windows = {}, {}
    for name in POINTS:
        camera = camera_of(folder, name)
        places, pixels = clicked(folder, name, camera)
        small = camera.resized(SMALL)
        scaled = ((pixels + 0.5) * np.divide(SMALL, SIZE)[::-1] - 0.5).round(1)
        print(f"{name}: {scaled.tolist()} px at {places.tolist()} m")
        cameras[name] = small, SMALL, page_code("def pose_of")["pose_of"](small, scaled, places)
        picture = cv2.imread(str(folder / "images" / f"{name}.png"))
        picture = cv2.resize(picture, SMALL[::-1], interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(SURROUND / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        windows[name] = window(folder, name)
    rig = Rig(cameras)
    rig.save(SURROUND / "rig.json")
    for name, errors in corner_errors(rig).items():
        median, most = np.quantile(errors, (0.5, 0.9))
        print(f"{name}: {len(errors)} corners, median {median:.1f} cm, 90 % {most:.1f} cm")
    ours, theirs = seen_ground(rig, windows)
    print(f"ground seen by one camera or more, by two or more: {ours}, by the project's: {theirs}")


def page_code(part: str) -> dict:
    """What the block of the page with this text defines."""
    text = (ROOT / "docs" / "tutorials" / "surround.md").read_text()
    (block,) = (b.partition("\n```")[0] for b in text.split("```python\n")[1:] if part in b)
    scope: dict = {"cv2": cv2, "np": np}
    exec(compile(block, "<page>", "exec"), scope)
    return scope


def camera_of(folder: Path, name: str) -> lens.Lens:
    file = folder / "yaml" / f"{name}.yaml"
    return lens.load(
        file, coefficients="fisheye", image_size=SIZE, theta_max=THETA_MAX, dtype=torch.float64
    )


def matrices(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The camera matrix of the undistorted picture, and the matrix from it to the plan."""
    file = cv2.FileStorage(str(folder / "yaml" / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
    camera, plan, scale, shift = (
        file.getNode(key).mat()
        for key in ("camera_matrix", "project_matrix", "scale_xy", "shift_xy")
    )
    camera[[0, 1], [0, 1]] *= scale.ravel()
    camera[:2, 2] += shift.ravel()
    return camera, plan


def to_ground(name: str, plan: np.ndarray) -> np.ndarray:
    """Points (..., 2) of a camera's plan, cm → x ahead and y to the left of the middle, m."""
    (u, v), (width, height) = np.moveaxis(plan, -1, 0), PLAN
    x, y = {"front": (u, v), "back": (width - u, height - v), "left": (v, height - u),
            "right": (width - v, u)}[name]  # fmt: skip
    return np.stack((height / 2 - y, width / 2 - x), -1) / 100


def clicked(folder: Path, name: str, camera: lens.Lens) -> tuple[np.ndarray, np.ndarray]:
    """The points of a camera: on the ground, (4, 2) m, and in its picture, (4, 2) px."""
    flat, plan = matrices(folder, name)
    points = np.array(POINTS[name], np.float64)
    rays = np.pad(points, ((0, 0), (0, 1)), constant_values=1) @ np.linalg.inv(plan @ flat).T
    rays *= np.sign(rays[:, 2:])  # they are ahead of the camera
    return to_ground(name, points), camera.project_points(torch.from_numpy(rays)[None])[0].numpy()


def window(folder: Path, name: str) -> np.ndarray:
    """The corners of a camera's undistorted picture as rays (4, 3)."""
    flat, _ = matrices(folder, name)
    height, width = SIZE
    corners = np.array([(0, 0, 1), (width, 0, 1), (width, height, 1), (0, height, 1)]) - 0.5
    corners[:, 2] = 1
    return corners @ np.linalg.inv(flat).T


def seen_ground(rig: Rig, windows: dict[str, np.ndarray]) -> tuple[list[float], list[float]]:
    """The shares of the ground of 12 m × 12 m beside the car, seen by at least one camera and by
    two: by a rig, and by the parts of its pictures that the undistorted ones show."""
    steps = np.arange(-5.95, 6, 0.1)
    x, y = (values.ravel() for values in np.meshgrid(steps, steps))
    beside = (np.abs(y) > 1) | (x > 2.5) | (x < -2)
    points = np.stack((x, y, 0 * x), -1)[beside]
    _, seen = rig.project(points)
    left = seen.copy()
    for k, (name, camera) in enumerate(rig.cameras.items()):
        local = (points - camera.pose[:3, 3]) @ camera.pose[:3, :3]
        flat = local[:, :2] / local[:, 2:]
        low, high = windows[name][:, :2].min(0), windows[name][:, :2].max(0)
        left[k] &= (local[:, 2] > 0) & ((flat > low) & (flat < high)).all(1)
    return tuple(
        [round(float((of.sum(0) >= count).mean()), 3) for count in (1, 2)] for of in (seen, left)
    )


def corner_errors(rig: Rig) -> dict[str, np.ndarray]:
    """How far the corners of the pattern's squares are from their places, cm, by cameras."""
    found = {}
    for name in rig.names:
        picture = cv2.imread(str(SURROUND / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
        one = Rig({name: rig[name]})
        plan = GroundView((1100, 700), 7.0).at(one)([picture])  # 1 cm a pixel
        plan = cv2.GaussianBlur(plan, (0, 0), 1.0)
        errors = []
        for place in np.mgrid[-460:461:40, -260:261:40].reshape(2, -1).T:
            at = np.array([349.5, 549.5]) - place[::-1]
            x, y = at.round().astype(int)
            parts = [plan[y + i : y + i + 10, x + j : x + j + 10]
                     for i in (-14, 4) for j in (-14, 4)]  # fmt: skip
            means = [part.mean() for part in parts]
            if abs(means[0] - means[1]) < 50 or not alternate(means):
                continue
            corner = cv2.cornerSubPix(
                plan, at.astype(np.float32).reshape(1, 1, 2), (12, 12), (-1, -1), (3, 50, 0.01)
            )
            errors.append(np.linalg.norm(corner.ravel() - at))
        found[name] = np.array(errors)
    return found


def alternate(means: list[float]) -> bool:
    """Whether the squares around a corner are dark and bright by turns."""
    apart = min(means[0], means[3]) - max(means[1], means[2])
    return max(apart, min(means[1], means[2]) - max(means[0], means[3])) >= 50


if __name__ == "__main__":
    main()
