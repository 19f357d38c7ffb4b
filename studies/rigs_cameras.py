"""Two lenses back to back as one panorama, and four cameras of a car as one plan of the ground."""

import math
from pathlib import Path

import numpy as np
import torch
from rigs_faces import TRUTH, as_frame, fisheye, kept, posed, psnr
from rigs_scene import AHEAD, CHUNK, Scene, picture, rays_of, room, sphere_rays, street

from darswin import Rig
from darswin.lens import Lens
from darswin.views import GroundView, make_view

SEAMS = ("hard", "narrow", "wide")
ENGINE = 4  # rays along each side of a pixel of the cameras

DUAL, DUAL_FOV, PANORAMA = (768, 768), math.radians(200), (512, 1024)
GAIN = 0.9  # of the front lens over the back one
APART, YAW = 0.025, 1.0  # m between the centres; degrees
NEAR_SEAM = math.radians(5)  # of the plane between the lenses
HELP = 2.0  # m, a `distance=` for centres that are apart

CAR, CAR_FOV = (966, 1280), math.radians(190)
GROUND, SPAN, CENTER = (800, 800), 12.0, (1.4, 0.0)  # px, m, m
# Of each camera: x, y, z (m), yaw and pitch downwards (degrees).
MOUNTS = {
    "front": (3.7, 0.0, 0.65, 0, 25), "left": (2.0, 0.95, 1.0, 90, 45),
    "rear": (-1.0, 0.0, 0.9, 180, 35), "right": (2.0, -0.95, 1.0, -90, 45),
}  # fmt: skip
WRONG_YAWS, WRONG_HEIGHT = (0.5, 2.0), 0.05  # degrees of the front camera; m of all cameras


def about(axis: int, degrees: float) -> np.ndarray:
    """The rotation (3, 3) about an axis."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    a, b = (k for k in range(3) if k != axis)
    turn = np.eye(3)
    turn[a, a] = turn[b, b] = cos
    turn[a, b], turn[b, a] = (sin, -sin) if axis == 1 else (-sin, sin)
    return turn


# -- two lenses -------------------------------------------------------------------------------


def dual(apart: float = 0.0, yaw: float = 0.0) -> Rig:
    """Two lenses back to back. apart: of their centres, m; yaw: by which the back one is off, °."""
    lens, front, back = fisheye(DUAL, DUAL[0] / 2, DUAL_FOV), np.eye(4), np.eye(4)
    back[:3, :3] = about(1, 180 + yaw)
    front[2, 3], back[2, 3] = apart / 2, -apart / 2
    cameras = {"front": (lens, DUAL, front), "back": (lens, DUAL, back)}
    return Rig(cameras, up=(0, -1, 0))


def frames_of(out: Path, name: str, scene: Scene, rig: Rig, turn: bool) -> list[np.ndarray]:
    """The pictures of a rig's cameras. turn: the rig's frame is that of a camera."""
    frames = []
    for of, camera in rig.cameras.items():
        pose, rays = posed(camera.pose) if turn else camera.pose, rays_of(camera.lens, camera.size)
        frames.append(as_frame(kept(out, f"{name}-{of}", lambda camera=camera, rays=rays, pose=pose:
            picture(scene, rays, camera.size, ENGINE, pose=pose)).colour))  # fmt: skip
    return frames


def two_lenses(out: Path) -> dict:
    """PSNR of the panorama, of all of it and near the seam; differences are of 255."""
    scene, view = room(), make_view("equirectangular", PANORAMA)
    rays = sphere_rays(PANORAMA)
    true = kept(out, "panorama", lambda: picture(scene, rays, PANORAMA, TRUTH)).colour
    pixels = np.stack(np.meshgrid(*map(np.arange, PANORAMA[::-1])), -1).reshape(-1, 2)
    ahead = rays(pixels)[:, 2].reshape(PANORAMA)
    where = dict(all=np.ones(PANORAMA, bool), seam=np.abs(ahead) < math.sin(NEAR_SEAM))
    # The columns beside the plane between the lenses: all around, in equal steps of the angle.
    quarter = PANORAMA[1] // 4
    line = np.s_[:, [quarter - 1, quarter, 3 * quarter - 1, 3 * quarter]]

    def scores(image: np.ndarray) -> dict:
        return {part: psnr(image, true, of) for part, of in where.items()}

    def case(frames: list[np.ndarray], rig: Rig, **options: object) -> dict:
        alone = [
            view.at(Rig({of: rig[of]}, up=rig.up))([frame]).astype(float)
            for of, frame in zip(rig.names, frames, strict=True)
        ]
        seams = {seam: view.at(rig, seam=seam, **options) for seam in SEAMS}
        wide = seams["wide"]
        found = {} if options else dict(apart=np.abs(alone[0] - alone[1])[line].mean())
        return found | dict(
            seams={seam: scores(remap(frames)) for seam, remap in seams.items()},
            gains=wide.gains(frames).tolist(),
            disagreement=wide.disagreement(frames)[0]["front", "back"],
        )  # fmt: skip

    right, wrong = dual(), dual(yaw=YAW)
    frames = frames_of(out, "dual", scene, right, True)
    # The product of both factors is 1, so that the mean brightness is that of the truth.
    pair = [as_frame(frames[0] * math.sqrt(GAIN)), as_frame(frames[1] / math.sqrt(GAIN))]
    parallax = dual(APART)
    shifted = frames_of(out, "dual-apart", scene, parallax, True)
    return dict(
        size=DUAL, panorama=PANORAMA, fov=math.degrees(DUAL_FOV), gain=GAIN, yaw=YAW,
        apart=APART, help=HELP, cases={
            "one centre": case(frames, right),
            "one centre, `gain=True`": case(frames, right, gain=True),
            "a gain of 0.9": case(pair, right),
            "a gain of 0.9, `gain=True`": case(pair, right, gain=True),
            "2.5 cm apart": case(shifted, parallax),
            "2.5 cm apart, `distance=2`": case(shifted, parallax, distance=HELP),
            "yaw wrong by 1°": case(frames, wrong),
        },
    )  # fmt: skip


# -- a car ------------------------------------------------------------------------------------


def car(lens: Lens, yaw: float = 0.0, height: float = 0.0) -> Rig:
    """Four cameras. yaw: by which the front one is off, °; height: by which all are too high, m."""
    cameras = {}
    for name, (x, y, z, azimuth, down) in MOUNTS.items():
        pose = np.eye(4)
        off = yaw if name == "front" else 0
        pose[:3, :3] = about(2, azimuth + off) @ AHEAD @ about(0, -down)
        pose[:3, 3] = x, y, z + height
        cameras[name] = (lens, CAR, pose)
    return Rig(cameras)


def ground_at(pixels: np.ndarray) -> np.ndarray:
    """The places x, y, z on the ground (N, 3) of pixels (N, 2) of the plan, m."""
    step = SPAN / GROUND[1]
    ahead = CENTER[0] + ((GROUND[0] - 1) / 2 - pixels[:, 1]) * step
    left = CENTER[1] + ((GROUND[1] - 1) / 2 - pixels[:, 0]) * step
    return np.stack((ahead, left, np.zeros(len(pixels))), 1)


def true_ground(scene: Scene, samples: int) -> np.ndarray:
    """The plan of the ground as if nothing stood on it, (H, W, 3)."""
    part, rows = (np.arange(samples) + 0.5) / samples - 0.5, []
    for row in range(GROUND[0]):
        x = (np.arange(GROUND[1])[:, None] + part).ravel()
        pixels = np.stack(np.meshgrid(x, row + part), -1).reshape(-1, 2)
        colours = scene.things[0].colours(ground_at(pixels)[:, :2])
        rows.append(colours.reshape(samples, GROUND[1], samples, 3).mean((0, 2)))
    return np.stack(rows)


def unhidden(scene: Scene, rig: Rig, places: np.ndarray) -> np.ndarray:
    """True for the places on the ground (N, 3) that nothing hides from a camera which looks there;
    False for those at which none looks."""
    _, shown = rig.project(places)
    free = shown.any(0)
    for camera, of in zip(rig.cameras.values(), shown, strict=True):
        origin = camera.pose[:3, 3]
        for part in np.array_split(np.flatnonzero(of), 1 + of.sum() // CHUNK):
            way = places[part] - origin
            far = np.linalg.norm(way, axis=1)
            hits = scene.cast(origin, way / far[:, None])
            free[part] &= np.abs(hits.distance - far) < 1e-6
    return free


def shifts(remap: object, right: Rig, places: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """How far from where it should be each pixel of the plan shows the ground, m; NaN for none."""
    source, at = remap.to_image(pixels)
    found = np.full(len(pixels), np.nan)
    for number, camera in enumerate(right.cameras.values()):
        of = source == number
        rays = camera.lens.unproject_points(torch.from_numpy(at[of])[None], camera.size)[0].numpy()
        way = rays @ camera.pose[:3, :3].T
        origin = camera.pose[:3, 3]
        with np.errstate(divide="ignore"):
            along = np.where(way[:, 2] < 0, -origin[2] / way[:, 2], np.nan)
        found[of] = np.linalg.norm(origin + along[:, None] * way - places[of], axis=1)
    return found


def four_cameras(out: Path) -> dict:
    """PSNR of the plan where nothing hides the ground, and what a wrong rig costs."""
    scene, lens = street(), fisheye(CAR, CAR[1] / 2, CAR_FOV)
    right, view = car(lens), GroundView(GROUND, span=SPAN, center=CENTER)
    frames = frames_of(out, "car", scene, right, False)
    true = true_ground(scene, TRUTH // 2)
    pixels = np.stack(np.meshgrid(*map(np.arange, GROUND[::-1])), -1).reshape(-1, 2).astype(float)
    places = ground_at(pixels)
    free = unhidden(scene, right, places).reshape(GROUND)
    seams = {seam: view.at(right, seam=seam) for seam in SEAMS}
    found = {seam: remap(frames) for seam, remap in seams.items()}
    rigs = {"right": right} | {
        f"yaw of one camera wrong by {yaw:g}°": car(lens, yaw=yaw) for yaw in WRONG_YAWS
    }  # fmt: skip
    rigs["all cameras taken 5 cm too high"] = car(lens, height=WRONG_HEIGHT)
    rigs["lenses taken as equidistant"] = car(fisheye(CAR, CAR[1] / 2, CAR_FOV, curved=False))
    cases, before = {}, None
    for name, rig in rigs.items():
        remap = view.at(rig, seam="narrow")
        off = 100 * shifts(remap, right, places, pixels)
        pairs, apart = remap.disagreement(frames)
        before = before or pairs
        image = remap(frames)
        cases[name] = dict(
            psnr=psnr(image, true, free & remap.shown), median=np.nanmedian(off),
            most=np.nanquantile(off, 0.95), disagreement=float(np.nanmean(apart)),
            middle=float(np.nanmedian(apart)), bare=float(np.nanmean(apart[free])),
            ratio=max(value / before[pair] for pair, value in pairs.items()),
            pairs={" and ".join(pair): value for pair, value in pairs.items()},
        )  # fmt: skip
    return dict(
        size=CAR, fov=math.degrees(CAR_FOV), ground=GROUND, span=SPAN, free=free.mean(),
        shown=seams["hard"].shown.mean(),
        seams={seam: psnr(image, true, free) for seam, image in found.items()}, cases=cases,
        reads={seam: len(of.reads.pixels) / of.shown.sum() for seam, of in seams.items()},
    )  # fmt: skip
