"""What users write to make a fisheye picture of a simulator's six faces: with OpenCV and NumPy, and
with py360convert, which knows cubes and panoramas, and no fisheye lens."""

from collections.abc import Sequence

import cv2
import numpy as np
from rigs_scene import NOTHING, Rays

ORDER = ("front", "right", "back", "left", "up", "down")
# x (right), y (down) and z (forward) of each face in the frame of the cube.
AXES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)), "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)), "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)), "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}  # fmt: skip


class Table:
    """The face, and the place on it, of samples × samples points of each pixel of a lens."""

    def __init__(self, rays: Rays, size: tuple[int, int], side: int, samples: int = 1):
        height, width = size
        y, x = np.mgrid[: height * samples, : width * samples]
        pixels = (np.stack((x, y), -1) + 0.5) / samples - 0.5
        self.rays = rays(pixels.reshape(-1, 2)).reshape(*pixels.shape[:2], 3)
        self.size, self.side, self.samples = size, side, samples
        self.seen = ~np.isnan(self.rays[..., 0])
        ahead = np.stack([self.rays @ AXES[name][2] for name in ORDER])
        self.face = np.where(self.seen, np.nan_to_num(ahead, nan=-1).argmax(0), -1)
        self.place = np.full((*self.face.shape, 2), -1.0)
        for number, name in enumerate(ORDER):
            of = self.face == number
            right, down, forward = (self.rays[of] @ axis for axis in AXES[name])
            self.place[of] = np.stack((right, down), 1) / forward[:, None]
        self.place = ((self.place + 1) * side - 1) / 2
        self.place[self.seen] = self.place[self.seen].clip(0, side - 1)
        self.maps = self.place.astype(np.float32)
        self.masks = [(self.face == number).astype(np.uint8) for number in range(len(ORDER))]
        share = self.seen.astype(np.float32)
        share = cv2.resize(share, size[::-1], interpolation=cv2.INTER_AREA)[..., None]
        self.whole = np.divide(1, share, out=np.zeros_like(share), where=share > 0)

    def mean(self, fine: np.ndarray) -> np.ndarray:
        """The mean of the points of each pixel that the lens sees."""
        if self.samples == 1:
            return fine
        total = cv2.resize(fine, self.size[::-1], interpolation=cv2.INTER_AREA)
        return total if self.seen.all() else np.rint(total * self.whole).astype(fine.dtype)


def read(
    faces: Sequence[np.ndarray], table: Table, how: int, missing: float = 0,
    maps: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """What the points of a table show; `missing` beyond the lens."""
    picture = np.full((*table.face.shape, *faces[0].shape[2:]), missing, faces[0].dtype)
    maps = table.maps if maps is None else maps
    for face, mask in zip(faces, table.masks, strict=True):
        cv2.copyTo(cv2.remap(face, maps, None, how, None, cv2.BORDER_REPLICATE), mask, picture)
    return picture


class Usual:
    """For each face one cv2.remap of the whole picture, of which a mask is copied."""

    def __init__(self, rays: Rays, size: tuple[int, int], side: int, samples: int):
        self.fine, self.one = Table(rays, size, side, samples), Table(rays, size, side)
        self.corner = np.floor(self.one.place).astype(np.float32)
        self.cosine = np.full(size, np.nan, np.float32)
        for number, name in enumerate(ORDER):
            of = self.one.face == number
            self.cosine[of] = self.one.rays[of] @ AXES[name][2]

    def colour(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        return self.fine.mean(read(faces, self.fine, cv2.INTER_LINEAR))

    def label(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        return read(faces, self.one, cv2.INTER_NEAREST, NOTHING)

    def distance(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        """1/z of one surface is interpolated, of several the nearest counts."""
        inverse = [1 / z for z in faces]
        square = np.ones((2, 2), np.uint8)
        most = [cv2.dilate(of, square, anchor=(0, 0)) for of in inverse]
        least = [cv2.erode(of, square, anchor=(0, 0)) for of in inverse]
        high = read(most, self.one, cv2.INTER_NEAREST, np.nan, self.corner)
        low = read(least, self.one, cv2.INTER_NEAREST, np.nan, self.corner)
        mixed = read(inverse, self.one, cv2.INTER_LINEAR, np.nan)
        nearest = read(inverse, self.one, cv2.INTER_NEAREST, np.nan)
        return 1 / (np.where(high < 1.1 * low, mixed, nearest) * self.cosine)


class Careful:
    """The faces below each other in one picture, and one cv2.remap with maps in fixed point, or
    NumPy's `take` at places that are made once. Places end at the borders of the faces."""

    def __init__(self, rays: Rays, size: tuple[int, int], side: int, samples: int):
        usual = Usual(rays, size, side, samples)
        self.fine, self.one, self.side = usual.fine, usual.one, side
        self.maps = self._maps(self.fine)
        x, y = np.rint(self.one.place[self.one.seen]).astype(np.int64).T
        face = self.one.face[self.one.seen]
        self.nearest = (face * side + y) * side + x
        corner = np.floor(self.one.place[self.one.seen]).astype(np.int64).clip(0, side - 2)
        self.corner = (face * side + corner[:, 1]) * side + corner[:, 0]
        self.share = (self.one.place[self.one.seen] - corner).astype(np.float32).T
        self.cosine = usual.cosine[self.one.seen].astype(np.float32)

    def _maps(self, table: Table) -> tuple[np.ndarray, np.ndarray]:
        place = table.place.astype(np.float32)
        place[..., 1] += table.face * self.side
        place[~table.seen] = -10
        return cv2.convertMaps(place, None, cv2.CV_16SC2)

    def colour(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        return self.fine.mean(cv2.remap(cv2.vconcat(list(faces)), *self.maps, cv2.INTER_LINEAR))

    def label(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        picture = np.full(self.one.size, NOTHING, faces[0].dtype)
        picture[self.one.seen] = np.concatenate(faces).ravel().take(self.nearest)
        return picture

    def distance(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        z = np.concatenate(faces).ravel()
        four = [1 / z.take(self.corner + step) for step in (0, 1, self.side, self.side + 1)]
        right, lower = self.share
        upper, under = (four[k] + (four[k + 1] - four[k]) * right for k in (0, 2))
        mixed = upper + (under - upper) * lower
        high = np.maximum(np.maximum(*four[:2]), np.maximum(*four[2:]))
        low = np.minimum(np.minimum(*four[:2]), np.minimum(*four[2:]))
        inverse = np.where(high < 1.1 * low, mixed, 1 / z.take(self.nearest))
        picture = np.full(self.one.size, np.nan, np.float32)
        picture[self.one.seen] = 1 / (inverse * self.cosine)
        return picture


class Panorama:
    """py360convert's panorama of the cube, of as many pixels a degree as the faces, and cv2.remap.
    Distances are interpolated."""

    def __init__(self, rays: Rays, size: tuple[int, int], side: int, samples: int):
        import py360convert

        self.c2e, self.shape = py360convert.c2e, (2 * side, 4 * side)
        self.fine, self.one = Table(rays, size, side, samples), Table(rays, size, side)
        self.maps, self.map = (self._maps(of) for of in (self.fine, self.one))
        middle = (np.arange(side) + 0.5) / side * 2 - 1
        self.length = np.sqrt(1 + middle**2 + middle[:, None] ** 2).astype(np.float32)

    def _maps(self, table: Table) -> np.ndarray:
        x, y, z = np.moveaxis(table.rays, -1, 0)
        across = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * self.shape[1] - 0.5
        down = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * self.shape[0] - 0.5
        return np.nan_to_num(np.stack((across, down), -1), nan=-10).astype(np.float32)

    def _panorama(self, faces: Sequence[np.ndarray], mode: str) -> np.ndarray:
        cube = dict(zip("FRBLUD", faces, strict=True))
        return self.c2e(cube, *self.shape, mode=mode, cube_format="dict")

    def colour(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        seen = self._panorama(faces, "bilinear")
        return self.fine.mean(
            cv2.remap(seen, self.maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        )

    def label(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        seen = self._panorama(faces, "nearest")
        picture = cv2.remap(seen, self.map, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_WRAP)
        return np.where(self.one.seen, picture, NOTHING).astype(np.uint8)

    def distance(self, faces: Sequence[np.ndarray]) -> np.ndarray:
        seen = self._panorama([z * self.length for z in faces], "bilinear")
        picture = cv2.remap(seen, self.map, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.where(self.one.seen, picture, np.nan)
