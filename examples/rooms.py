"""Renders pictures of rooms through a calibrated camera, with a label and a distance for each
pixel, as a plain folder of `darswin.data.open_scenes`.

    python examples/rooms.py rooms --count 60

The rooms have a floor, walls, a ceiling and boxes of random sizes and colours. The camera is that
of examples/room.json, at a quarter of its size.
"""

import argparse
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from darswin import lens
from darswin.lens.pixels import pixel_rays

CALIBRATION = Path(__file__).with_name("room.json")
SIZE = (242, 320)
CLASSES = {
    "names": ["floor", "wall", "ceiling", "box"],
    "colors": [[128, 90, 50], [90, 140, 200], [235, 235, 225], [220, 90, 40]],
}
FLOOR, WALL, CEILING, BOX = range(4)
NO_LABEL = 255
FINER = 2  # rays along each side of a pixel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=60)
    write_rooms(**vars(parser.parse_args()))


def write_rooms(folder: Path, count: int) -> None:
    """Writes pictures, labels and distances (metres × 256) with their lens and classes."""
    for name in ("images", "labels", "distance"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    shutil.copy(CALIBRATION, folder / "lens.json")
    (folder / "classes.json").write_text(json.dumps(CLASSES))
    fine, rays = camera_rays(FINER), camera_rays(1)
    for k in tqdm(range(count), desc="rooms"):
        room = Room(np.random.default_rng(k))
        image = cv2.resize(room.colors(fine), SIZE[::-1], interpolation=cv2.INTER_AREA)
        labels, distance = room.trace(rays)[:2]
        labels[np.isnan(rays[..., 0])], distance[np.isnan(rays[..., 0])] = NO_LABEL, 0
        cv2.imwrite(f"{folder}/images/{k:03}.png", image)
        cv2.imwrite(f"{folder}/labels/{k:03}.png", labels)
        cv2.imwrite(f"{folder}/distance/{k:03}.png", (distance * 256).round().astype(np.uint16))


def camera_rays(finer: int) -> np.ndarray:
    """The unit rays (H, W, 3) of pixels, x to the right, y down; NaN beyond the lens."""
    size = (finer * SIZE[0], finer * SIZE[1])
    theta, direction = (
        t[0].numpy() for t in pixel_rays(lens.load(CALIBRATION).resized(size), size)
    )
    return np.concatenate((np.sin(theta)[..., None] * direction, np.cos(theta)[..., None]), -1)


class Room:
    """A room around the camera, which looks along z. It consists of boxes, given by their low and
    high corners; the first box is the room. Each box has a colour for each axis of its sides."""

    def __init__(self, rng: np.random.Generator):
        self.rng, turn = rng, rng.uniform(0, 2 * np.pi)
        self.turn = np.array(
            [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]],
            np.float32,
        )
        height, eye = rng.uniform(2.2, 3.5), rng.uniform(1.0, 1.7)
        far = rng.uniform(1.0, 5.0, 4)
        corners = [((-far[0], eye - height, -far[1]), (far[2], eye, far[3]))]
        for _ in range(rng.integers(2, 6)):
            x, z = rng.uniform(-far[0], far[2]), rng.uniform(-far[1], far[3])
            side, top = rng.uniform(0.2, 0.7, 2)
            if max(abs(x), abs(z)) > side + 0.3:  # no box contains the camera
                corners.append(((x - side, eye - 2 * top, z - side), (x + side, eye, z + side)))
        self.low, self.high = np.array(corners, np.float32).swapaxes(0, 1)
        # Floors are dark, ceilings bright, boxes of pure colours; floors and walls are checkered.
        self.paint = rng.uniform(60, 200, (len(corners), 3, 3))
        self.paint[1:] = rng.permuted(np.tile([30, 130, 250], (len(corners) - 1, 3, 1)), axis=-1)
        self.floor, self.ceiling = rng.uniform(30, 110, 3), rng.uniform(190, 250, 3)
        self.square = rng.uniform(0.3, 0.8)

    def trace(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Label, distance and box of the point that each ray hits, and the axis of the side."""
        rays = np.nan_to_num(rays, nan=1.0) @ self.turn.T
        slopes = 1 / np.where(np.abs(rays) < 1e-6, np.float32(1e-6), rays)
        ahead = np.maximum(self.high[0] * slopes, self.low[0] * slopes)
        axis, distance = ahead.argmin(-1), ahead.min(-1)
        which = np.zeros(axis.shape, int)
        for k, (low, high) in enumerate(zip(self.low[1:], self.high[1:], strict=True), 1):
            near, far = low * slopes, high * slopes
            enter, leave = np.minimum(near, far), np.maximum(near, far).min(-1)
            first = enter.max(-1)
            hit = (first < leave) & (first > 0) & (first < distance)
            distance[hit], axis[hit], which[hit] = first[hit], enter.argmax(-1)[hit], k
        labels = np.where(axis == 1, np.where(rays[..., 1] > 0, FLOOR, CEILING), WALL)
        return np.where(which > 0, BOX, labels).astype(np.uint8), distance, which, axis

    def colors(self, rays: np.ndarray) -> np.ndarray:
        """The picture of the camera, (H, W, 3) uint8: checkered sides, darker far away."""
        labels, distance, which, axis = self.trace(rays)
        paint = self.paint[which, axis]
        paint[labels == FLOOR], paint[labels == CEILING] = self.floor, self.ceiling
        places = np.floor(rays @ self.turn.T * distance[..., None] / self.square)
        along = np.arange(3) != axis[..., None]
        dark = np.nansum(places * along, -1) % 2 * (labels < CEILING)
        light = (1 - 0.25 * dark) / (1 + 0.08 * distance)
        image = paint * light[..., None] + 4 * self.rng.standard_normal(rays.shape, np.float32)
        return np.where(np.isnan(rays), 0, image.clip(0, 255)).astype(np.uint8)


if __name__ == "__main__":
    main()
