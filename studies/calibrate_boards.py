"""Pictures of calibration boards through any lens, with the corners' true places.

Each pixel is the mean of several rays. A ray is followed to the plane of the board, also beyond 90°
from the axis, and what it meets is computed, not looked up in a picture of the board.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from darswin.calibrate.boards import Board, pixels_per_unit
from darswin.lens import KannalaBrandt, Lens, save

LEAST = {"chessboard": 5.0, "charuco": 14.0, "april": 14.0}  # px, a square of a useful pose
PAPER, INK = 0.9, 0.06  # of the light


class Pose(NamedTuple):
    """Where a board is: its point (x, y, 0) is at rotation @ (x, y, 0) + translation."""

    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)


class Renderer:
    """Takes pictures through a lens with an image size.

    Args:
        samples: rays per pixel and axis. blur: σ of a Gaussian, px. vignette: the share of light
            that the rim lacks. noise: σ, in levels of 255.
    """

    def __init__(
        self, lens: Lens, samples: int = 3, blur: float = 0.7, vignette: float = 0.3,
        noise: float = 2.0,
    ):  # fmt: skip
        self.lens = lens.detach().to(torch.float64)
        self.blur, self.vignette, self.noise = blur, vignette, noise
        self.size = height, width = tuple(round(side) for side in lens.image_size[0].tolist())
        y, x = ((np.arange(side * samples) + 0.5) / samples - 0.5 for side in (height, width))
        pixels = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))
        rays = self.lens.unproject_points(pixels[None])[0].numpy()
        split = rays.reshape(height, samples, width, samples, 3).swapaxes(1, 2)
        self._rays = split.reshape(height, width, samples**2, 3).astype(np.float32)

    def picture(self, board: Board, pose: Pose, rng: np.random.Generator) -> np.ndarray:
        """(H, W) uint8; black where no ray of the lens lands."""
        ray = self._rays @ pose.rotation.astype(np.float32)  # in the board's frame
        eye = -pose.translation @ pose.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            away = -eye[2] / ray[..., 2]
            x, y = (eye[axis] + away * ray[..., axis] for axis in (0, 1))
            behind = ~(away > 0) | (eye[2] > 0)  # of the camera, or the board's back is seen
        there = reflectance(board, x, y)
        wall = 0.4 + 0.1 * np.sin(3 * self._rays[..., 0] + 5 * self._rays[..., 1])
        light = np.where(behind | np.isnan(there), wall, there)
        light = np.nan_to_num(light).mean(-1)
        if self.blur:
            light = cv2.GaussianBlur(light, (0, 0), self.blur)
        fade = 1 - self.vignette * np.nan_to_num(self._eccentricity()) ** 2
        levels = 255 * light * fade + rng.normal(0, self.noise, light.shape)
        return levels.round().clip(0, 255).astype(np.uint8)

    def _eccentricity(self) -> np.ndarray:
        """θ / θ_max of the pixels."""
        middle = self._rays[:, :, self._rays.shape[2] // 2, 2]
        return np.arccos(middle.clip(-1, 1)) / self.lens.theta_max.item()

    def corners(self, board: Board, pose: Pose) -> np.ndarray:
        """(K, 2) px: the true places of the corners, NaN where the picture does not show them."""
        return self._places(board.points, pose)

    def _places(self, points: np.ndarray, pose: Pose) -> np.ndarray:
        there = points @ pose.rotation[:, :2].T + pose.translation
        pixels = self.lens.project_points(torch.from_numpy(there)[None])[0].numpy()
        inside = (pixels >= 1) & (pixels <= np.array(self.size[::-1]) - 2)
        return np.where(inside.all(-1, keepdims=True), pixels, np.nan)

    def poses(
        self, board: Board, count: int, rng: np.random.Generator, whole: bool = True
    ) -> Iterator[Pose]:
        """Random useful poses: the directions of the boards' middles spread from the axis to the
        rim, their sizes and slants vary. whole: the picture shows all of the board."""
        low, high = board.points.min(0), board.points.max(0)
        middle, border = (low + high) / 2, board.square
        outline = np.array([low - border, high + border])
        edges = np.linspace(*outline, 9)
        outline = np.concatenate(
            [np.stack((edges[:, 0], np.full(9, y)), -1) for y in outline[:, 1]]
            + [np.stack((np.full(9, x), edges[:, 1]), -1) for x in outline[:, 0]]
        )
        reach, widest = np.linalg.norm(high - low) / 2, self.lens.theta_max.item()
        for k in range(count):
            for tries in range(3000):
                # A board that does not fit comes nearer to the axis with each try.
                theta = (k + rng.uniform()) / count * widest * 0.999**tries
                half = rng.uniform(0.2, 0.5) * min(widest, 1.4)
                pose = _pose(rng, theta, reach / math.tan(half), middle)
                if self._is_useful(board, pose, outline, whole):
                    yield pose
                    break
            else:
                raise ValueError("no useful pose of the board was found")

    def _is_useful(self, board: Board, pose: Pose, outline: np.ndarray, whole: bool) -> bool:
        places = self.corners(board, pose)
        seen = np.isfinite(places[:, 0]).mean()
        if seen < 0.3 or (whole and (seen < 1 or np.isnan(self._places(outline, pose)).any())):
            return False
        px = pixels_per_unit(places.reshape(board.rows, board.columns, 2), board)
        return np.nanmin(px) * board.square >= LEAST[board.kind]


def _pose(rng: np.random.Generator, theta: float, distance: float, middle: np.ndarray) -> Pose:
    """A board whose middle is at an angle θ, turned at random, and slanted by up to 50°."""
    azimuth, roll, towards = rng.uniform(-math.pi, math.pi, 3)
    slant = math.radians(50) * math.sqrt(rng.uniform())
    look = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    # `seen` looks along the ray to the board's middle; z of the board points away.
    axis = np.array([-look[1], look[0], 0.0])
    seen = _turn(theta * axis)
    rotation = (
        seen
        @ _turn(slant * np.array([math.cos(towards), math.sin(towards), 0.0]))
        @ _turn(np.array([0, 0, roll]))
    )
    return Pose(rotation, seen[:, 2] * distance - rotation[:, :2] @ middle)


def _turn(vector: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(np.asarray(vector, np.float64))[0]


def reflectance(board: Board, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The light from points of the board's plane; NaN beside the board and its white margin."""
    side = board.square
    with np.errstate(invalid="ignore"):
        if board.kind == "april":
            pitch = side + board.other
            i, j = np.floor(x / pitch), np.floor(y / pitch)
            u, v = x / side - i * pitch / side, y / side - j * pitch / side
            columns, rows = board.columns // 2, board.rows // 2
            dark = _bits(board, j * columns + i, u, v)
            ends = columns * pitch - board.other, rows * pitch - board.other
            margin = max(board.other, side / 4)
        else:
            i, j = np.floor(x / side) + 1, np.floor(y / side) + 1
            dark = (i + j) % 2 == 0
            columns, rows = board.columns + 1, board.rows + 1
            if board.kind == "charuco":
                u, v = (0.5 + (at - (k - 0.5) * side) / board.other for at, k in ((x, i), (y, j)))
                dark |= _bits(board, (j * columns + i) // 2, u, v) & ~dark
            x, y = x + side, y + side
            ends, margin = (columns * side, rows * side), side
        inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        paper = (x >= -margin) & (x < ends[0] + margin) & (y >= -margin) & (y < ends[1] + margin)
    return np.where(paper, np.where(dark & inside, INK, PAPER), np.nan)


def _bits(board: Board, number: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """True where the markers of these numbers are black; u, v: in 0..1 on a marker."""
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    side = markers.markerSize + 2
    count = len(markers.bytesList)
    drawn = np.array([cv2.aruco.generateImageMarker(markers, k, side) for k in range(count)])
    on = (u >= 0) & (u < 1) & (v >= 0) & (v < 1) & (number >= 0) & (number < count)
    number, row, column = (np.where(on, a, 0).astype(int) for a in (number, v * side, u * side))
    return on & (drawn[number, row, column] == 0)


def main(argv: list[str] | None = None) -> None:
    """Writes pictures of a chessboard through a lens of 200°, and the lens."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=16)
    arguments = parser.parse_args(argv)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    lens = KannalaBrandt(130.0, (0.02, -0.004), math.radians(100), image_size=(480, 480))
    camera, board = Renderer(lens), Board.chessboard(9, 6, 0.025)
    rng = np.random.default_rng(0)
    for k, pose in enumerate(camera.poses(board, arguments.count, rng)):
        cv2.imwrite(str(arguments.folder / f"{k:02}.png"), camera.picture(board, pose, rng))
    save(lens, arguments.folder.parent / "true.json")


if __name__ == "__main__":
    main()
