"""Arrays that a view turned round, and strided, big-endian and read-only ones, count as their
copies do, wherever an array is taken."""

import functools
import warnings

import numpy as np
import pytest
import rigs
import torch
from scipy.spatial.transform import Rotation

from darswin import boxes, frames, views
from darswin.calibrate import calibrate
from darswin.calibrate.inputs import checked
from darswin.data import FullSize, fitted
from darswin.deploy import camera
from darswin.lens import Equidistant, KannalaBrandt, Polynomial

COLORS = [(k, 2 * k, 255 - k) for k in range(9)]
RNG = np.random.default_rng(0)
SIZE = (48, 64)
CAMERA = Equidistant(20.0, theta_max=1.2, image_size=SIZE)
ROOM = views.PerspectiveView((24, 32))
PICTURE = RNG.integers(0, 256, (*SIZE, 3), np.uint8)
VALUES = RNG.uniform(1, 9, (48, 48)).astype(np.float32)
PLACES = RNG.uniform(10, 40, (6, 2))
BOXES = np.concatenate((PLACES, PLACES + 8), 1)
FULL = FullSize(fitted(SIZE, 48, "crop").at(CAMERA, SIZE))
MOVED = views.CropView((4, 4, 40, 40), (30, 30), views.Turn(0.3)).at(CAMERA, SIZE)
REMAP = ROOM.at(CAMERA, SIZE)
MERCATOR = views.MercatorView((48, 64)).at(CAMERA, SIZE)
TURNED = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
PLAN = camera.plan(ROOM, CAMERA, SIZE)


@functools.cache
def rig():
    return rigs.rig(rigs.true_lens("KannalaBrandt", 120, seed=1), 6)


def corners():
    return rig().corners.numpy()


@functools.cache
def calibrated():
    return calibrate(corners(), rig().board, rig().size, "KannalaBrandt")


def _array(found):
    return found.numpy() if isinstance(found, torch.Tensor) else np.asarray(found)


def _rays(points):
    return CAMERA.unproject_points(points).numpy()


def _polar(picture):
    from matplotlib.figure import Figure  # which takes long

    from darswin.viz.plot import draw_polar

    axes = Figure().subplots()
    draw_polar(picture, CAMERA, views.PolarView(4, 8), axes=axes)
    return axes.images[0].get_array()


def _drawn(name, *arguments):
    from darswin.viz import pixels

    return getattr(pixels, name)(*arguments)


CASES = {
    "coefficients": (lambda a: Polynomial(a).coefficients, np.array([300.0, -4, 2, 0.1])),
    "center": (lambda a: KannalaBrandt(300.0, radial=np.zeros(4), center=a).center, PLACES[0]),
    "affine": (lambda a: Equidistant(3.0, affine=a).affine, np.array([[1.01, 0.02], [0.03, 1]])),
    "image_size": (lambda a: Equidistant(3.0, image_size=a).image_size, np.array([480, 640])),
    "resized": (lambda a: CAMERA.resized(a).image_size, np.array([24, 32])),
    "project": (CAMERA.project, np.linspace(0.1, 1, 6)),
    "project_points": (CAMERA.project_points, RNG.uniform(1, 2, (6, 3))),
    "unproject_points": (CAMERA.unproject_points, PLACES),
    "with_theta_max": (lambda a: CAMERA.with_theta_max(a).theta_max, np.array([1.0])),
    "up": (lambda a: views.MercatorView((24, 48), up=a).up, np.array([0.1, -1, 0.2])),
    "up_of": (lambda a: views.up_of(extrinsics=a), TURNED),
    "to_view": (REMAP.to_view, PLACES),
    "to_image": (REMAP.to_image, PLACES / 2),
    "corners": (lambda a: checked(a, rig().board, rig().size)[0].corners, corners),
    "list of corners": (lambda a: checked([*a], rig().board, rig().size)[0].corners, corners),
    "board": (lambda a: checked(corners(), a, rig().size)[1], lambda: rig().board.numpy()),
    "uncertainty": (lambda a: calibrated().uncertainty(a), 10 * PLACES),
    "of theta": (lambda a: calibrated().uncertainty_of_theta(a), np.linspace(0.1, 1, 6)),
    "carry": (lambda a: boxes.carry(a, MOVED.to_view)[0], BOXES),
    "carry_points": (lambda a: boxes.carry_points(a, MOVED.to_view), PLACES),
    "carry_polygon": (lambda a: boxes.carry_polygon(a, MOVED.to_view), PLACES),
    "carry_mask": (lambda a: boxes.carry_mask(a, lambda p: p + 1.0, SIZE), VALUES > 5),
    "iou": (lambda a: boxes.iou(a, BOXES), BOXES + 1),
    "merge": (lambda a: boxes.merge(a, np.linspace(1, 0, 6), np.zeros(6, int)), BOXES),
    "turned boxes": (boxes.turned, BOXES),
    "corners of boxes": (boxes.corners, BOXES),
    "floor": (lambda a: MERCATOR.floor(a, 2.0, (0, -1, 0)), BOXES),
    "encode_rle": (lambda a: boxes.decode_rle(boxes.encode_rle(a)), VALUES > 5),
    "spherical": (lambda a: boxes.spherical(a, _rays).ray, BOXES),
    "plan": (PLAN.points, PLACES / 2),
    "sampler": (frames.Sampler(PLAN), PICTURE),
    "turned": (MOVED, PICTURE),
    "picture": (REMAP, RNG.random(SIZE, np.float32)),
    "target": (MOVED.target, RNG.uniform(1, 9, SIZE).astype(np.float32)),
    "resized picture": (fitted(SIZE, 32, "whole").at(CAMERA, SIZE), PICTURE),
    "labels": (FULL.labels, RNG.normal(size=(3, 48, 48)).astype(np.float32)),
    "distance": (FULL.distance, VALUES),
    "label_image": (lambda a: _drawn("label_image", a, COLORS), VALUES.astype(int)),
    "distance_image": (lambda a: _drawn("distance_image", a, 1, 9), VALUES),
    "overlay": (lambda a: _drawn("overlay", a, PICTURE[::-1]), PICTURE),
    "draw_boxes": (lambda a: _drawn("draw_boxes", PICTURE, a, ["a"] * 6, COLORS[:6]), BOXES),
    "draw_polar": (_polar, PICTURE),
}
FORMS = {
    "reversed": lambda a: a[::-1].copy()[::-1],
    "last reversed": lambda a: a[..., ::-1].copy()[..., ::-1],
    "strided": lambda a: np.repeat(a, 2, 0)[::2],
    "columns": np.asfortranarray,
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "read-only": lambda a: [b := a.copy(), b.setflags(write=False)][0],
}


@pytest.mark.parametrize("case", CASES)
def test_a_view_counts_as_its_copy(case):
    function, value = CASES[case]
    value = value() if callable(value) else value
    expected = _array(function(value))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, form in FORMS.items():
            found = _array(function(form(value)))
            assert found.dtype == expected.dtype, name
            np.testing.assert_allclose(found, expected, 1e-6, err_msg=name)
