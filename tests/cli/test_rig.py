"""`darswin rig`, on analytic scenes: a textured ground, and a box around a cube of six faces."""

import math
import re

import cv2
import numpy as np
import pytest
import torch
from helpers import ended
from PIL import Image

from darswin.cli.main import main
from darswin.data.scenes import open_scenes
from darswin.data.scenes.targets import TARGETS
from darswin.lens import Equidistant, KannalaBrandt, load, save
from darswin.lens.rig import CUBES, Rig
from darswin.utils.image import read_image

SIZE = (240, 320)
FISHEYE = KannalaBrandt(86.0, [0.01, -0.004, 0.001, 0.0], 1.66, image_size=SIZE)
# Yaw to the right and pitch up, degrees, and places (x ahead, y to the left, z up), m.
PLACES = {
    "front": (0, -20, (3.7, 0.0, 0.6)), "right": (90, -40, (2.0, -1.0, 1.0)),
    "back": (180, -20, (-1.0, 0.0, 0.9)), "left": (-90, -40, (2.0, 1.0, 1.0)),
}  # fmt: skip
TO = Equidistant(20.0, 1.65, image_size=(64, 72))


def pose(yaw, pitch, place):
    yaw, pitch, matrix = math.radians(yaw), math.radians(pitch), np.eye(4)
    level = np.array((math.cos(yaw), -math.sin(yaw), 0.0))
    ahead = math.cos(pitch) * level + (0, 0, math.sin(pitch))
    right = np.cross(level, (0, 0, 1))
    matrix[:3] = np.stack((right, np.cross(ahead, right), ahead, place), 1)
    return matrix


def car(lens=FISHEYE, **changed):
    """A rig of four cameras above the ground."""
    places = PLACES | changed
    return Rig({name: (lens, SIZE, pose(*place)) for name, place in places.items()})


def ground(x, y):
    """The colours of the ground at x ahead and y to the left, m."""
    turns = ((1.7, 0.6), (-0.9, 1.5), (0.5, -1.9))
    waves = ((a * x + b * y, b * x - a * y) for a, b in turns)
    planes = [60 * np.sin(2 * u) + 40 * np.sin(3.1 * v) for u, v in waves]
    return 128 + np.exp(-np.hypot(x, y) / 8)[..., None] * np.stack(planes, -1)


def of_ground(place, rays):
    with np.errstate(divide="ignore"):
        along = np.where(rays[..., 2] < -1e-3, -place[2] / rays[..., 2], 1e9)
    return ground(*(place[k] + along * rays[..., k] for k in (0, 1)))


def of_box(place, rays):
    """The distances of the sides of a box around the origin, its labels and its colours."""
    sides = np.where(rays > 0, (4.0, 2.0, 6.0), (5.0, 1.5, 3.0))
    along = np.min(sides / np.abs(rays).clip(1e-9), -1)
    hit = along[..., None] * rays
    labels = np.argmax(np.abs(rays) / sides, -1) * 2 + (np.take_along_axis(
        rays, np.argmax(np.abs(rays) / sides, -1)[..., None], -1)[..., 0] > 0)  # fmt: skip
    return along, labels, 128 + 90 * np.sin(1.5 * hit)


def rays_of(camera, fine=3):
    """Unit vectors in the rig's frame of `fine`² points of each pixel, NaN beyond θ_max."""
    y, x = ((np.arange(side * fine) + 0.5) / fine - 0.5 for side in camera.size)
    points = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))[None]
    rays = camera.lens.unproject_points(points, camera.size)[0].numpy() @ camera.pose[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def shoot(camera, scene=of_ground, fine=2):
    """The picture of a camera, black beyond θ_max."""
    (height, width), rays = camera.size, rays_of(camera, fine)
    colours = np.nan_to_num(scene(camera.pose[:3, 3], rays))
    picture = colours.reshape(height, fine, width, fine, 3).mean((1, 3))
    return np.rint(picture).clip(0, 255).astype(np.uint8)


def run(command):
    main(["rig", *command.split()])


def write(path, picture):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)


@pytest.fixture(scope="module")
def pictures():
    return {name: shoot(camera) for name, camera in car().cameras.items()}


RIGS = {
    "car": car(),
    "yaw": car(left=(-88, -40, (2.0, 1.0, 1.0))),
    "height": car(front=(0, -20, (3.7, 0.0, 0.65))),
    "lens": car(Equidistant(86.0, 1.66, image_size=SIZE)),
}


@pytest.fixture
def folder(tmp_path, monkeypatch, pictures):
    """The pictures of the car in `car/`, and files of its rigs."""
    monkeypatch.chdir(tmp_path)
    for name, rig in RIGS.items():
        rig.save(f"{name}.json")
    for name, picture in pictures.items():
        write(tmp_path / "car" / f"{name}.png", picture)
    return tmp_path


def test_show_lists_and_draws_the_cameras(folder, capsys):
    run("show car.json car --out car.png")
    said = capsys.readouterr().out.splitlines()
    place = "2.00 m ahead, 1.00 m to the left, 1.00 m up; yaw -90.0°, pitch -40.0°, roll 0.0°"
    assert f"left: KannalaBrandt, 240 × 320 px (H × W); {place}" in said
    y, x = np.mgrid[-6:6:100j, -6:6:100j]
    _, seen = RIGS["car"].project(np.stack((x + 1.675, y, 0 * x), -1))
    shares = re.findall(r"([\d.]+)%", said[4])
    counts = seen.sum(0)
    for share, found in zip(shares, (counts == 1, counts > 1, counts == 0), strict=True):
        assert abs(float(share) - 100 * found.mean()) < 0.6
    assert said[5] == "car.png" and Image.open("car.png").size[0] == 1200
    run("show cube:16 --out cube.pdf")
    said = capsys.readouterr().out
    assert "down: Perspective" in said and "yaw 0.0°, pitch -90.0°, roll 0.0°" in said
    assert "of the sphere, 100.0% are seen by one camera, 0.0% by more and 0.0% by none" in said


def test_stitch_shows_the_ground(folder, capsys):
    run("stitch car.json car --size 160,160 --span 8 --center 1.4,0.5 --out new.png")
    assert capsys.readouterr().out == "new.png: 1 picture, 160 × 160 px (H × W)\n"
    y, x = np.mgrid[:160, :160]
    truth, found = ground(5.4 - (y + 0.5) / 20, 4.5 - (x + 0.5) / 20), read_image("new.png")
    shown = found.any(-1)
    assert shown.mean() > 0.98 and np.abs(found - truth)[shown].mean() < 3
    words = " ".join(f"{name}=car/{name}.png" for name in ("left", "back", "front", "right"))
    run(f"stitch car.json {words} --size 160,160 --span 8 --center 1.4,0.5 --out b.png")
    assert np.array_equal(read_image("b.png"), found)


def test_stitch_takes_frames_and_views(folder, pictures):
    for name, picture in pictures.items():
        for k in range(2):
            write(folder / "drive" / name / f"{k}.png", picture[:, :: 1 - 2 * k, :1].squeeze())
    options = "--view=perspective --fov_deg=90 --yaw_deg=20 --size=40,60 --seam=wide --gain=true"
    run(f"stitch car.json drive --distance 9 {options} --out out")
    first, second = (np.array(Image.open(folder / "out" / f"{k}.png")) for k in range(2))
    assert first.shape == (40, 60) and first.any() and np.abs(first - second.astype(int)).max() > 50


def test_check_sees_what_is_wrong_and_says_what_would_help(folder, capsys):
    means, said = {}, {}
    for rig, options in (*((name, "") for name in RIGS), ("low", "--height=0.05")):
        run(f"check {rig if rig in RIGS else 'car'}.json car {options}")
        said[rig] = capsys.readouterr().out
        means[rig] = np.array([float(x) for x in re.findall(r"differ by ([\d.]+) of", said[rig])])
    assert all(mean[-1] >= 2 * means["car"][-1] for rig, mean in means.items() if rig != "car")
    for rig, better in {
        "car": "no small turn or move agrees clearly better",
        "yaw": "left: turned by 2° to the left, pictures agree better",
        "height": "front: 5 cm lower, pictures agree better",
        "low": "all cameras: 5 cm lower, pictures agree better",
    }.items():
        assert better in said[rig]


# -- fisheye pictures of a cube's faces -------------------------------------------------------


def write_faces(folder, side=96, order="carla", kinds=("",), frame="", of="z", depth="npy"):
    """The faces of the box: colours, or folders of `kinds`."""
    for name, camera in Rig.cube(side, order).cameras.items():
        distance, labels, _ = of_box(0, rays_of(camera, 1))
        z = distance * (rays_of(camera, 1) @ camera.pose[:3, 2])
        values = {
            "depth": (z if of == "z" else distance).astype(np.float32),
            "labels": labels.astype(np.uint8),
        }
        for kind in kinds:
            file = folder / kind / name / frame if frame else folder / kind / name
            file.parent.mkdir(parents=True, exist_ok=True)
            if kind != "depth":
                picture = values.get(kind)
                write(file.with_name(f"{file.name}.png"), shoot(camera, lambda *a: of_box(*a)[2], 4)
                      if picture is None else picture)  # fmt: skip
            elif depth == "npy":
                np.save(f"{file}.npy", values[kind])
            else:
                cv2.imwrite(f"{file}.png", np.rint(values[kind] * 1000).astype(np.uint16))


@pytest.fixture
def faces(tmp_path, monkeypatch):
    """A folder, with the calibration of a fisheye of 189°."""
    monkeypatch.chdir(tmp_path)
    save(TO, "fisheye.json")
    return tmp_path / "faces"


@pytest.mark.parametrize(
    ("frame", "of", "depth", "unit"),
    [("", "z", "npy", ""), ("0007", "distance", "png", "--depth_unit=0.001")],
)
def test_fisheye_is_what_the_lens_itself_would_see(faces, capsys, frame, of, depth, unit):
    write_faces(faces, kinds=("colour", "labels", "depth"), frame=frame, of=of, depth=depth)
    (faces / "classes.json").write_text('{"names": ["b", "f", "u", "d", "r", "l"]}')
    run(f"fisheye faces --to fisheye.json --out new --depth_of {of} {unit}")
    said = "new: images, labels, distance of 1 frame, 64 × 72 px (H × W); the lens is new/lens.json"
    assert capsys.readouterr().out == f"{said}\n"
    camera = Rig.single(TO).cameras["camera"]
    (distance, labels, _), rays = of_box(0, rays_of(camera, 1)), rays_of(camera, 1)
    shown = np.isfinite(rays).all(-1)
    name = frame or "0000"
    found, truth = read_image(f"new/images/{name}.png"), shoot(camera, lambda *a: of_box(*a)[2], 8)
    inside = cv2.erode(shown.astype(np.uint8), np.ones((3, 3))) > 0
    assert np.abs(found.astype(int) - truth)[inside].mean() < 1.5 and not found[~shown].any()
    for task, target, nothing in (("segmentation", labels, 255), ("distance", distance, 0)):
        _, read, lens = open_scenes("new", "train", TARGETS[task], holdout=0)[0]
        assert type(lens) is Equidistant
        assert (read[~shown] == nothing).all()
        apart = np.abs(read[shown].astype(float) - target[shown])
        assert np.quantile(apart, 0.97) < 0.006 and apart.max() < (0.2 if nothing == 0 else 6), task
    assert torch.equal(load("new/lens.json").image_size, TO.image_size)


def test_fisheye_takes_the_faces_of_opengl_and_another_size(faces, capsys):
    write_faces(faces, order="opengl", side=48)
    run("fisheye faces --to fisheye.json --out new --faces opengl --size 32,36")
    assert capsys.readouterr().out.startswith("new: images of 1 frame, 32 × 36 px (H × W);")
    camera = Rig.single(TO.resized((32, 36))).cameras["camera"]
    truth = shoot(camera, lambda *a: of_box(*a)[2], 8)[8:-8, 8:-8]
    assert np.abs(read_image("new/images/0000.png")[8:-8, 8:-8].astype(int) - truth).mean() < 2


def test_exr_is_read_if_opencv_can(faces, capsys, monkeypatch):
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
    write_faces(faces, side=16, kinds=("colour", "depth"))
    for name in CUBES["carla"]:
        file, depth = faces / "depth" / f"{name}.exr", np.load(faces / "depth" / f"{name}.npy")
        try:
            cv2.imwrite(str(file), depth)
        except cv2.error:
            file.write_bytes(b"v/1\x01")
        (faces / "depth" / f"{name}.npy").unlink()
    command = "fisheye faces --to fisheye.json --out new"
    if (faces / "depth" / "front.exr").stat().st_size > 4:
        run(command)
        assert np.median(cv2.imread("new/distance/0000.png", -1)) > 256
    else:
        assert "convert it to .npy" in ended(capsys, 2, run, command).err
