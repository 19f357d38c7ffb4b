"""The scenes and scores of the study of rigs."""

import math

import cv2
import numpy as np
import pytest
import rigs_cameras
import rigs_faces
from rigs_peers import Careful, Usual
from rigs_scene import AHEAD, NOTHING, Ball, Box, Cylinder, Paint, Scene, picture, rays_of, room

PAINT = Paint(0.2, (200, 150, 100), (50, 60, 70))


def test_things_are_at_their_distances():
    origin = np.array([0.3, -0.2, 0.1])
    ways = np.random.default_rng(3).normal(size=(2000, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    ball = Ball((2.0, 0.5, 0.4), 0.7, PAINT, 3)
    away = np.array(ball.center) - origin
    along, miss = ways @ away, away @ away - (ways @ away) ** 2
    hit = (along > 0) & (miss < ball.radius**2)
    expected = np.where(hit, along - np.sqrt(np.maximum(ball.radius**2 - miss, 0)), np.inf)
    np.testing.assert_allclose(Scene([ball], (0, 0, 0)).cast(origin, ways).distance, expected)
    assert 30 < hit.sum() < 300
    # In small steps along rays, the first one inside.
    box, steps = Box((-1.5, 0.4, 0.0), (0.8, 0.5, 1.0), PAINT, 5, yaw=0.6), np.linspace(0, 4, 4000)
    for thing in (Cylinder((1.0, 1.0, 0.0), 0.3, 1.5, PAINT, 4), box):
        far, way = thing.cut(origin, ways[:400]), origin + steps[:, None] * ways[:400, None]
        x, y, z = np.moveaxis((way - thing.center) @ getattr(thing, "_turn", np.eye(3)), -1, 0)
        inside = (np.hypot(x, y) < 0.3) & (np.abs(z) < 0.75)
        if thing is box:
            inside = (np.abs(x) < 0.4) & (np.abs(y) < 0.25) & (np.abs(z) < 0.5)
        met = inside.any(1)
        assert met.sum() > 5 and (np.isfinite(far) >= met).all()
        np.testing.assert_allclose(far[met], steps[inside[met].argmax(1)], atol=2e-3)


def test_culled_tiles_show_what_every_thing_gives():
    scene, size = room(), (24, 24)
    lens = rigs_faces.fisheye(size, 12)
    seen = picture(scene, rays_of(lens, size), size, 2)
    y, x = np.argwhere(seen.label != NOTHING).T
    ways = rays_of(lens, size)(np.stack((x, y), 1).astype(float)) @ AHEAD.T
    nearest = np.min([thing.cut(np.zeros(3), ways) for thing in scene.things], 0)
    np.testing.assert_allclose(seen.distance[y, x], nearest)
    assert np.isnan(seen.distance[0, 0]) and (seen.colour[0, 0] == 0).all()


def test_faces_make_the_fisheye_by_every_way(tmp_path):
    size, side = (48, 64), 96
    scene, lens = room(), rigs_faces.fisheye((48, 64), 32)
    true = picture(scene, rays_of(lens, size), size, 8, keep=True)
    seen = rigs_faces.cube(tmp_path, scene, "room", side, 2)
    faces = [rigs_faces.as_frame(of.colour) for of in seen]
    for way in (
        rigs_faces.Ours(lens, size, side), Usual(rays_of(lens, size), size, side, 2),
        Careful(rays_of(lens, size), size, side, 2),
    ):  # fmt: skip
        assert rigs_faces.psnr(way.colour(faces), true.colour, true.label != NOTHING) > 24
        labels = rigs_faces.label_scores(way.label([of.label for of in seen]), true)
        assert labels["plain"] == 1 and labels["all"] > 0.97 and labels["invented"] == 0
        found = rigs_faces.distance_scores(way.distance([of.distance for of in seen]), true)
        assert found["phantoms"] < 3e-3 and found["mean"] < 1e-3 and found["missing"] == 0
    rim = rigs_faces.parts_of(lens, size)
    assert rim["all"].sum() == (true.label != NOTHING).sum() and rim["seams"].sum() > 50
    blurred = cv2.blur(true.distance, (3, 3))  # grows phantoms
    assert rigs_faces.distance_scores(blurred, true)["phantoms"] > 0.02


def test_a_wrong_rig_shifts_the_ground():
    lens = rigs_faces.fisheye(rigs_cameras.CAR, rigs_cameras.CAR[1] / 2, rigs_cameras.CAR_FOV)
    pixels = np.random.default_rng(0).uniform(0, 800, (300, 2))
    places = rigs_cameras.ground_at(pixels)
    view = rigs_cameras.GroundView((800, 800), span=12.0, center=(1.4, 0))
    right, turned = (rigs_cameras.car(lens, yaw) for yaw in (0.0, 2.0))
    assert np.nanmax(rigs_cameras.shifts(view.at(right), right, places, pixels)) < 1e-9
    remap = view.at(turned)
    off, source = rigs_cameras.shifts(remap, right, places, pixels), remap.to_image(pixels)[0]
    far = np.linalg.norm(places[:, :2] - right["front"].pose[:2, 3], axis=1)
    chord = 2 * math.sin(math.radians(1)) * far
    assert off[source == 0] == pytest.approx(chord[source == 0])
