"""A fisheye picture from the six faces of a simulator, against direct rendering."""

import math
import statistics
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import torch
from rigs_peers import Careful, Panorama, Table, Usual, read
from rigs_scene import AHEAD, NOTHING, Picture, Scene, picture, rays_of, room

from darswin import Rig
from darswin.lens import KannalaBrandt, Lens
from darswin.views import CameraView

FOV, RIM = math.radians(190), math.radians(80)
SIZE, TRUTH = (256, 256), 16  # px; rays along each side of a pixel
SIDES, ENGINE = (512, 1024, 2048), (1, 4)  # px; an engine's rays along each side of a pixel
DIRECT = (1, 2, 4)
PHANTOM = 0.01  # of the distance
TIMED, FRAMES, SIDE = (480, 640), 30, 512


def fisheye(size: tuple[int, int], radius: float, fov: float = FOV, *, curved: bool = True) -> Lens:
    """A Kannala–Brandt lens whose field of view fills a circle around the picture's middle, or an
    equidistant one."""
    radial = [[-0.035, 0.001, 0, 0]] if curved else [[0.0] * 4]
    middle = torch.tensor([[(size[1] - 1) / 2, (size[0] - 1) / 2]], dtype=torch.float64)
    lens = KannalaBrandt(
        focal=torch.ones(1, dtype=torch.float64), center=middle, image_size=size,
        radial=torch.tensor(radial, dtype=torch.float64),
    )  # fmt: skip
    scale = radius / lens.with_theta_max(None).project(fov / 2)
    return lens.replace(focal=scale).with_theta_max(fov / 2)


def kept(out: Path, name: str, make: Callable[[], Picture]) -> Picture:
    """A picture that is rendered once."""
    file = out / f"{name}.npz"
    if not file.exists():
        made = make()._asdict()
        out.mkdir(parents=True, exist_ok=True)
        np.savez(file, **{key: value for key, value in made.items() if value is not None})
    with np.load(file) as data:
        return Picture(**data)


def posed(pose: np.ndarray) -> np.ndarray:
    """The pose in a scene of a camera of a rig whose frame looks ahead there."""
    whole = np.eye(4)
    whole[:3, :3] = AHEAD
    return whole @ pose


def cube(out: Path, scene: Scene, name: str, side: int, samples: int) -> list[Picture]:
    """The six faces. Their distances are z, as simulators write them."""
    faces = []
    for face, camera in Rig.cube(side).cameras.items():
        rays = rays_of(camera.lens, camera.size)
        of = kept(out, f"{name}-{face}-{side}-{samples}", lambda camera=camera, rays=rays: picture(
            scene, rays, camera.size, samples, pose=posed(camera.pose)))  # fmt: skip
        middle = (np.arange(side) + 0.5) / side * 2 - 1
        length = np.sqrt(1 + middle**2 + middle[:, None] ** 2)
        faces.append(of._replace(distance=(of.distance / length).astype(np.float32)))
    return faces


def as_frame(colour: np.ndarray) -> np.ndarray:
    return colour.round().astype(np.uint8)


# -- scores -----------------------------------------------------------------------------------


def psnr(found: np.ndarray, true: np.ndarray, where: np.ndarray) -> float:
    """Of the pixels (H, W) where it is True, dB."""
    off = found[where].astype(np.float64) - true[where]
    return float(10 * np.log10(255**2 / np.mean(off**2)))


def around(values: np.ndarray, combine: Callable) -> np.ndarray:
    """Of each pixel (H, W) and its eight neighbours."""
    edge = np.pad(values, 1, mode="edge")
    height, width = values.shape
    parts = [edge[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return combine.reduce(parts)


def plain(true: Picture) -> np.ndarray:
    """The pixels that are farther than one pixel from an edge: all rays of them and of their
    neighbours have one label, or meet nothing."""
    labels = true.labels.astype(np.int16)
    lens = labels != NOTHING
    high = around(np.where(lens, labels, -1).max(2), np.maximum)
    low = around(np.where(lens, labels, 999).min(2), np.minimum)
    return (high == low) & (true.label != NOTHING)


def label_scores(found: np.ndarray, true: Picture) -> dict:
    seen, off_edges = true.label != NOTHING, plain(true)
    same = found == true.label
    invented = seen & ~np.isin(found, np.unique(true.labels))
    return dict(
        all=same[seen].mean(), plain=same[off_edges].mean(), plain_share=off_edges[seen].mean(),
        invented=int(invented.sum()),
    )  # fmt: skip


def distance_scores(found: np.ndarray, true: Picture) -> dict:
    """Errors off edges are shares of the distance; a phantom is at a distance at which nothing is
    within a pixel."""
    seen, off_edges = true.label != NOTHING, plain(true)
    off = np.abs(found / true.distance - 1)
    suspects = np.argwhere(seen & (off > PHANTOM))
    every = np.pad(true.distances, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    phantoms = 0
    for y, x in suspects:
        near = every[y : y + 3, x : x + 3].ravel()
        phantoms += not np.nanmin(np.abs(found[y, x] / near - 1)) <= PHANTOM
    return dict(
        phantoms=phantoms / seen.sum(), mean=off[off_edges].mean(),
        most=np.quantile(off[off_edges], 0.999), missing=int(np.isnan(found[seen]).sum()),
    )  # fmt: skip


def parts_of(lens: Lens, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The pixels of the picture, of its rim, and those that see two faces of a cube."""
    table, fine = Table(rays_of(lens, size), size, 2), Table(rays_of(lens, size), size, 2, TRUTH)
    seen = table.seen
    theta = np.arccos(np.clip(table.rays[..., 2], -1, 1))
    blocks = fine.face.reshape(size[0], TRUTH, size[1], TRUTH)
    low = np.where(blocks < 0, 99, blocks).min((1, 3))
    return dict(all=seen, rim=seen & (theta > RIM), seams=seen & (blocks.max((1, 3)) > low))


# -- the study --------------------------------------------------------------------------------


def study(out: Path, sides: tuple[int, ...] = SIDES, size: tuple[int, int] = SIZE) -> dict:
    """Colours, labels and distances from faces of several sizes."""
    scene, lens = room(), fisheye(size, size[0] / 2)
    rays, where = rays_of(lens, size), parts_of(lens, size)

    def direct(samples: int) -> Picture:
        name = f"fisheye-{size[0]}-{samples}"
        return kept(out, name, lambda: picture(scene, rays, size, samples, keep=samples == TRUTH))

    true, rows = direct(TRUTH), []

    def scores(image: np.ndarray) -> dict:
        return {part: psnr(image, true.colour, of) for part, of in where.items()}

    for side in sides:
        table, remap = Table(rays, size, side), CameraView(lens, size).at(Rig.cube(side))
        for samples in ENGINE:
            seen = cube(out, scene, "room", side, samples)
            frames = [as_frame(of.colour) for of in seen]
            rows.append(dict(
                side=side, engine=samples, ours=scores(remap(frames)),
                nearest=scores(read(frames, table, cv2.INTER_NEAREST)),
                bilinear=scores(read(frames, table, cv2.INTER_LINEAR)),
                reads=len(remap.reads.pixels) / where["all"].sum(),
            ))  # fmt: skip
        labels = remap.target([of.label for of in seen])
        depths = [of.distance for of in seen]
        distance = remap.depth(depths, to="distance")
        rows[-1] |= dict(
            labels=label_scores(labels, true), distances=distance_scores(distance, true),
            bilinear_distances=distance_scores(_interpolated(depths, table), true),
        )  # fmt: skip
    return dict(
        size=size, truth=TRUTH, fov=math.degrees(FOV), rows=rows, pixels={
            part: int(of.sum()) for part, of in where.items()
        }, direct={str(k): scores(as_frame(direct(k).colour)) for k in DIRECT},
    )  # fmt: skip


def _interpolated(faces: list[np.ndarray], table: Table) -> np.ndarray:
    """The distances that a bilinear read of those of the faces gives."""
    side = table.side
    middle = (np.arange(side) + 0.5) / side * 2 - 1
    length = np.sqrt(1 + middle**2 + middle[:, None] ** 2).astype(np.float32)
    found = read([z * length for z in faces], table, cv2.INTER_LINEAR)
    return np.where(table.seen, found, np.nan)


class Ours:
    """The same as the peers, with darswin."""

    def __init__(self, lens: Lens, size: tuple[int, int], side: int):
        self.remap = CameraView(lens, size).at(Rig.cube(side))
        self.sampler, self.label = self.remap.sampler(), self.remap.target

    def colour(self, faces: list[np.ndarray]) -> np.ndarray:
        return self.sampler(faces, threads=cv2.getNumThreads())

    def distance(self, faces: list[np.ndarray]) -> np.ndarray:
        return self.remap.depth(faces, to="distance")


KINDS = ("colour", "label", "distance")


def speed(out: Path, frames: int = FRAMES, size: tuple[int, int] = TIMED) -> dict:
    """The medians of the times of frames, in turns, and what the pictures are worth."""
    scene, lens = room(), fisheye(size, size[1] / 2)
    rays = rays_of(lens, size)
    seen = cube(out, scene, "room", SIDE, 4)
    faces = dict(
        colour=[as_frame(of.colour) for of in seen], label=[of.label for of in seen],
        distance=[of.distance for of in seen],
    )  # fmt: skip
    name = f"fisheye-{size[1]}-8"
    true = kept(out, name, lambda: picture(scene, rays, size, 8, keep=True))
    ways = {
        "darswin": lambda: Ours(lens, size, SIDE),
        "cv2, one remap, 2 × 2": lambda: Careful(rays, size, SIDE, 2),
        "cv2, one remap, 3 × 3": lambda: Careful(rays, size, SIDE, 3),
        "cv2, six remaps, 2 × 2": lambda: Usual(rays, size, SIDE, 2),
        "cv2, six remaps, 3 × 3": lambda: Usual(rays, size, SIDE, 3),
    }
    if find_spec("py360convert"):
        ways["py360convert, 2 × 2"] = lambda: Panorama(rays, size, SIDE, 2)
    made, results = {}, {}
    for way, make in ways.items():
        start = time.perf_counter()
        of = made[way] = make()
        image, labels, distance = (getattr(of, kind)(faces[kind]) for kind in KINDS)
        results[way] = dict(
            first=time.perf_counter() - start, psnr=psnr(image, true.colour, true.label != NOTHING),
            labels=label_scores(labels, true), distances=distance_scores(distance, true),
            times={},
        )  # fmt: skip
    for threads in (1, 2):
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        times: dict = {way: {kind: [] for kind in KINDS} for way in made}
        for _ in range(frames):
            for way, of in made.items():
                for kind in KINDS:
                    start = time.perf_counter()
                    getattr(of, kind)(faces[kind])
                    times[way][kind].append(time.perf_counter() - start)
        for way, of in times.items():
            medians = {kind: statistics.median(of[kind]) for kind in KINDS}
            results[way]["times"][str(threads)] = medians | dict(all=sum(map(sum, of.values())))
    return dict(size=size, side=SIDE, frames=frames, ways=results)
