"""Writes the six faces of cubes at random poses, in folders as programs of simulators write them.

`darswin rig fisheye` reads a split: `colour/front/STEM.png`, `labels/front/STEM.png` and
`depth/front/STEM.png` for each face, and classes.json.
"""

import json
from pathlib import Path

import cv2
import numpy as np

from darswin import Rig
from darswin.utils.files import replace_file
from worlds.dataset import is_done
from worlds.geometry import CLASSES, COLORS
from worlds.poses import Pose, poses_of
from worlds.render import View, rays_of, render
from worlds.scene import Scene
from worlds.textures import Textures
from worlds.wad import load_map

DEPTH_UNIT = 1000  # steps a metre in the PNGs of 16 bits


def write_cubes(name: str, split: str, out: Path, side: int, count: int, seed: int) -> dict:
    """Writes the cubes of one map, whose faces are of `side` px, into `split` of a folder. A
    finished map is left as it is.

    Raises:
        ValueError: the map was made with other options.
    """
    folder, made = out / split, dict(cube=side, count=count, seed=seed)
    done = folder / "done" / f"{name}.json"
    if is_done(done, made):
        return {}
    wad, world = load_map(name)
    scene, faces = Scene(world, Textures(wad)), Rig.cube(side).cameras
    done.parent.mkdir(parents=True, exist_ok=True)
    for kind in ("colour", "labels", "depth"):
        for face in faces:
            (folder / kind / face).mkdir(parents=True, exist_ok=True)
    lens = faces["front"].lens
    rays = rays_of(lens.replace(image_size=lens.theta_max.new_tensor([[side, side]])))
    for k, pose in enumerate(poses_of(scene, name, count, seed)):
        for face, camera in faces.items():
            turned = Pose(pose.position, pose.rotation @ camera.pose[:3, :3])
            write_face(render(scene, turned, rays), folder, f"{face}/{name}-{k:03d}.png")
    classes = dict(names=CLASSES, colors=COLORS)
    replace_file(folder / "classes.json", json.dumps(classes) + "\n")
    replace_file(done, json.dumps(made) + "\n")
    return {}


def write_face(view: View, folder: Path, file: str) -> None:
    """Writes a face: its depth is z, in millimetres, and 0 if it is unknown or above 65 m."""
    side = len(view.labels)
    middle = (np.arange(side) + 0.5) / side * 2 - 1
    z = view.distance / np.sqrt(1 + middle**2 + middle[:, None] ** 2)
    steps = np.round(z * DEPTH_UNIT)
    depth = np.where(steps < 2**16, steps, 0).astype(np.uint16)
    for kind, picture in dict(
        colour=view.image[..., ::-1], labels=view.labels, depth=depth
    ).items():
        _, data = cv2.imencode(".png", picture)
        (folder / kind / file).write_bytes(data)
