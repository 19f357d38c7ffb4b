"""Rigs: what each camera sees, the cube's faces, and errors that name the camera."""

import math

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from lens_examples import poses

from darswin import Rig
from darswin.lens import Equidistant, KannalaBrandt, Perspective, cat
from darswin.lens.rig import CUBES, ahead_of

SIZE = (400, 600)
LENS = KannalaBrandt(180.0, radial=[0.02, -0.003], theta_max=1.7, center=(300, 190))
# Of the OpenGL specification, "Cube map texture selection": sc, tc and ma of each face.
FACES = {
    "+x": lambda x, y, z: (-z, -y, x), "-x": lambda x, y, z: (z, -y, -x),
    "+y": lambda x, y, z: (x, z, y), "-y": lambda x, y, z: (x, -z, -y),
    "+z": lambda x, y, z: (x, -y, z), "-z": lambda x, y, z: (-x, -y, -z),
}  # fmt: skip
PLACES = {"+x": "right", "-x": "left", "+y": "up", "-y": "down", "+z": "front", "-z": "back"}


@pytest.mark.parametrize("faces", CUBES)
def test_a_cube_has_the_pixels_of_the_opengl_specification(faces):
    rig, side = Rig.cube(64, faces), 64
    points = np.random.default_rng(0).normal(size=(500, 3))
    pixels, shown = rig.project(points)
    assert rig.names == CUBES[faces] and len(rig) == 6 and (shown.sum(0) == 1).all()
    for face, formula in FACES.items():
        sc, tc, ma = formula(*(points * (1, -1, 1)).T)  # its y axis points up
        here = ma == abs(points).max(1)
        camera = rig.names.index(face if faces == "opengl" else PLACES[face])
        expected = np.stack(((sc / ma + 1) / 2 * side, (tc / ma + 1) / 2 * side), 1) - 0.5
        assert here.sum() > 30 and (shown[camera] == here).all()
        assert pixels[camera, here] == pytest.approx(expected[here], abs=1e-9)


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_each_camera_sees_points_from_its_own_place(seed, count):
    given_poses = poses(seed, count)
    rig = Rig({f"c{i}": (LENS, SIZE, pose) for i, pose in enumerate(given_poses)}, up=(1, 2, 3))
    local = np.random.default_rng(seed).normal(size=(7, 3))
    exact = LENS.to(torch.float64)
    expected = exact.project_points(torch.from_numpy(local)[None], SIZE)[0].numpy()
    for i, pose in enumerate(given_poses):
        points = (pose @ np.column_stack((local, np.ones(7))).T)[:3].T
        pixels, shown = rig.project(points.reshape(1, 7, 3))
        assert pixels.shape == (count, 1, 7, 2) and shown.shape == (count, 1, 7)
        assert pixels[i, 0] == pytest.approx(expected, abs=1e-6, nan_ok=True)
        inside = (abs(expected - (299.5, 199.5)) <= (300, 200)).all(1)
        near = (abs(abs(expected - (299.5, 199.5)) - (300, 200)) < 0.01).any(1)
        assert (shown[i, 0] == inside)[~near].all()
    assert rig.level.T @ rig.level == pytest.approx(np.eye(3), abs=1e-12)
    assert rig.level[:, 1] == pytest.approx(-np.array(rig.up))
    assert np.linalg.det(rig.level) == pytest.approx(1)
    places = np.array(given_poses)[:, :3, 3]
    assert rig.middle == pytest.approx(places.mean(0))
    assert rig.spread == pytest.approx(np.linalg.norm(places - places.mean(0), axis=1).max())


def test_single_and_raised_put_the_origin_on_the_ground():
    up = (0.1, -0.8, -0.6)
    rig = Rig.single(LENS, SIZE, up=up, height=2.5)
    assert rig.names == ("camera",) and rig["camera"].size == SIZE
    assert rig["camera"].pose[:3, 3] == pytest.approx(2.5 * np.array(rig.up))
    assert rig.up == pytest.approx(np.array(up) / np.linalg.norm(up)) and rig.forward == (0, 0, 1)
    ground = np.cross(rig.up, (1, 2, 3))  # at the height of the origin
    local = torch.from_numpy(ground - 2.5 * np.array(rig.up))[None, None]
    seen = LENS.to(torch.float64).project_points(local, SIZE)[0, 0]
    assert rig.project(ground)[0][0] == pytest.approx(seen.numpy())
    assert rig.raised(-2.5)["camera"].pose == pytest.approx(np.eye(4))
    assert ahead_of((0, 0, -1)) == Rig.single(LENS, SIZE, up=(0, 0, -1)).forward == (0, -1, 0)
    assert Rig({"a": (LENS, SIZE, np.eye(4))}).forward == (1, 0, 0)
    assert "camera: " in repr(rig) and "up=" in repr(rig)


def test_a_rounded_rotation_becomes_the_nearest_one_and_others_are_refused():
    for pose in poses(3, 40):
        rig = Rig({"a": (LENS, SIZE, pose.round(4)[:3])})
        found = rig["a"].pose
        assert found[:3, :3] @ found[:3, :3].T == pytest.approx(np.eye(3), abs=1e-14)
        assert found == pytest.approx(pose, abs=1.1e-4)
        assert (Rig({"a": (LENS, SIZE, pose)})["a"].pose == pose).all()
        refused("holds no rotation", Rig, {"a": (LENS, SIZE, pose.round(2))})


def test_errors_of_rigs_name_the_camera():
    eye, sized = np.eye(4), LENS.replace(image_size=torch.tensor([SIZE]))
    for said, camera in (
        ("camera b: a camera has one lens, got 2", (cat([LENS, LENS]), SIZE, eye)),
        (
            "camera b: its lens belongs to pictures of .*400, 600.*, got .*4, 4",
            (sized, (4, 4), eye),
        ),
        ("camera b: .*has a size of its pictures", (LENS, None, eye)),
        ("camera b: .*at least 2 × 2 px, got", (LENS, (1, 9), eye)),
        ("camera b: .*at least 2 × 2 px, got", (LENS, (9,), eye)),
        ("camera b: a pose is", (LENS, SIZE, np.eye(3))),
        ("camera b: a pose is", (LENS, SIZE, eye * np.nan)),
        ("camera b: its pose holds no rotation", (LENS, SIZE, np.diag((1, 1, -1, 1)))),
        ("camera b: its pose holds no rotation", (LENS, SIZE, np.diag((2, 1, 1, 1)))),
        ("camera b: its pose holds no rotation", (LENS, SIZE, eye * 1e308)),
        ("camera b: its pose holds no rotation", (LENS, SIZE, eye + np.eye(4)[[3, 0, 1, 2]])),
    ):
        refused(said, Rig, {"a": (sized, None, eye), "b": camera})
    refused("camera a: lens must be", Rig, {"a": ("lens", SIZE, eye)}, error=TypeError)
    refused("1 to 255 cameras, got 0", Rig, {})
    refused("got 256", Rig, {str(i): (LENS, SIZE, eye) for i in range(256)})
    good = {"a": (Equidistant(100.0), SIZE, eye), "b": (Perspective(100.0), SIZE, eye)}
    refused("up must be three", Rig, good, up=(0, 0, 0))
    refused("forward must not be along up", Rig, good, up=(0, 1, 0), forward=(0, -2, 0))
    refused("faces must be one of carla, habitat, opengl", Rig.cube, 64, "unity")
    refused("side must be at least 2", Rig.cube, 1)
    refused("height must be a finite", Rig(good).raised, math.inf)
    refused("there is no camera 'c', only a, b", Rig(good).__getitem__, "c", error=KeyError)
