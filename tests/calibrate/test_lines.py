"""Lenses from straight curves: simulated lines through known lenses, and drawn rooms."""

import json
import math

import numpy as np
import pytest
import torch
from helpers import refused, slow, slow_but

from darswin import lens as lenses
from darswin.calibrate import CalibrationError, estimate, lines
from darswin.calibrate.lines import from_curves

SIZE = (480, 640)
F64 = {"image_size": SIZE}


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


LENSES = {
    "spherical 0.3": lenses.Spherical(f64(0.3), f64(300.0), **F64),
    "spherical 0.8": lenses.Spherical(f64(0.8), f64(300.0), **F64),
    "kannala 150": lenses.KannalaBrandt(f64(255.0), f64(-0.02, -0.005)[None], **F64),
    "kannala 200": lenses.KannalaBrandt(f64(140.0), f64(0.01, -0.006)[None], **F64),
    "equidistant": lenses.Equidistant(f64(200.0), **F64),
    "equisolid": lenses.Equisolid(f64(180.0), **F64),
    "stereographic": lenses.Stereographic(f64(190.0), **F64),
    "division": lenses.OCam(f64(-260.0, 0.0, 1.6e-3), **F64),
    "field of view": lenses.FieldOfView(f64(1.0), f64(280.0), **F64),
    "perspective": lenses.Perspective(f64(400.0), **F64),
}


def curves_of(
    lens, seed, straight=30, *, noise=0.15, askew=6, bent=6, axes=3, first=0, center=(0.0, 0.0),
    rotation=None,
):  # fmt: skip
    """Curves of a camera in a world of lines along `axes` orthogonal directions, the rows of
    `rotation`, with lines askew and curves that are not straight."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rotation is None else rotation
    curves = []
    while len(curves) < straight + askew + bent:
        k = len(curves)
        way = rotation[first + k % axes] if k < straight else rng.normal(size=3)
        way = way / np.linalg.norm(way)
        along = np.linspace(-6, 6, 3000)[:, None] * way
        if k >= straight + askew:  # an arc of a circle
            turn = np.linspace(0, 1.5, 3000)[:, None]
            side = np.cross(way, rng.normal(size=3))
            along = 1.5 * (np.cos(turn) * way + np.sin(turn) * side / np.linalg.norm(side))
        points = torch.from_numpy(rng.normal(size=3) * 2 + along)
        pixels = lens.project_points(points[None])[0].numpy()
        seen = ((pixels > -0.5) & (pixels < np.array(SIZE[::-1]) - 0.5)).all(1)
        ends = np.flatnonzero(np.diff(np.r_[False, seen, False]))
        pixels = pixels[slice(*max(ends.reshape(-1, 2), key=np.ptp, default=(0,)))]
        if len(pixels) < 2:
            continue
        steps = np.r_[0, np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))]
        places = np.arange(int(min(steps[-1], rng.uniform(80, 300))))
        if len(places) < 60:
            continue
        even = np.stack([np.interp(places, steps, pixels[:, j]) for j in (0, 1)], 1)
        curves.append(even + rng.normal(0, noise, even.shape) + center)
    return sorted(curves, key=len, reverse=True)


def board_of(lens, seed):
    """The edges of the squares of a board, and edges in other directions, around it."""
    rng, curves = np.random.default_rng(seed), []
    turn = np.linalg.qr(np.eye(3) + 0.4 * rng.normal(size=(3, 3)))
    rotation = turn[0] * np.sign(np.diag(turn[1]))
    for k in range(200):
        i, j = divmod(k % 100, 10)
        edge = np.linspace((i, j), (i + 1, j) if k < 100 else (i, j + 1), 200)
        curves.append((np.pad(edge, ((0, 0), (0, 1))) - (5, 5, 0)) @ rotation.T + (0, 0, 14))
    along = np.linspace(0, 0.6, 300)[:, None]
    curves += [
        rng.uniform((-9, -6, 14), (9, 6, 18)) + along * rng.normal(size=3) for _ in range(30)
    ]
    pixels = [lens.project_points(torch.from_numpy(c)[None])[0].numpy() for c in curves]
    seen = [p for p in pixels if (p > 0).all() and (p < np.array(SIZE[::-1]) - 1).all()]
    lengths = [np.linalg.norm(p[-1] - p[0]) for p in seen]
    short = [p[:: max(1, int(len(p) / n))] for p, n in zip(seen, lengths, strict=True) if n > 28]
    return [p + rng.normal(0, 0.15, p.shape) for p in sorted(short, key=len, reverse=True)]


def assert_same(found, expected):
    """But for roundings: NumPy may add in another order for arrays at other addresses."""
    assert (found.curves, found.doubts) == (expected.curves, expected.doubts)
    numbers = [(one.rim, one.covered, *one.interval) for one in (found, expected)]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-3)


def rim_of(lens, radius=240.0):
    return lens.with_theta_max(None).unproject(radius).item()


@pytest.mark.parametrize(("name", "model"), slow_but(
    [*((name, "Spherical") for name in LENSES), ("kannala 150", "KannalaBrandt"),
     ("kannala 200", "KannalaBrandt"), ("division", "Division"), ("division", "OCam")],
    ("division", "Division"),
))  # fmt: skip
def test_a_lens_is_found_from_lines_in_three_directions(name, model):
    is_division, pictures = model in ("Division", "OCam"), 1 if model == "Division" else 2
    found = from_curves([curves_of(LENSES[name], 1 + k) for k in range(pictures)], SIZE, model)
    assert type(found.lens).__name__ == ("OCam" if is_division else model)
    assert found.lens.theta_max.dtype == torch.float64
    assert found.rim == pytest.approx(rim_of(LENSES[name]), rel=0.02 if is_division else 0.03)
    assert found.interval[0] <= found.rim <= found.interval[1] < 1.2 * found.rim
    assert 20 * pictures <= found.curves <= 40 * pictures and 0.8 < found.covered <= 1
    if is_division:
        assert "direction" not in " ".join(found.doubts)
        assert found.lens.coefficients.shape == (1, 3) and found.lens.coefficients[0, 1] == 0
    said = found.to_dict()
    assert json.loads(json.dumps(said))["lens"] == lenses.to_dict(found.lens)
    assert f"{math.degrees(found.rim):.1f}° at the rim" in said["verdict"]


@slow
def test_straightness_alone_does_not_tell_the_focal_length():
    """Lines of one direction: a lens is refused, unless the field of view is known."""
    lens = LENSES["stereographic"]
    curves = [curves_of(lens, seed, axes=1, askew=0) for seed in (1, 2, 3)]
    refused("do not tell the focal length", from_curves, curves, SIZE, error=CalibrationError)
    found = from_curves(curves, SIZE, circle=(319.5, 239.5, 240.0), fov=2 * rim_of(lens))
    assert found.rim == pytest.approx(rim_of(lens), rel=2e-3)
    at = np.linspace(20, 220, 11)
    theta = found.lens.unproject(torch.from_numpy(at)[None]), lens.unproject(torch.from_numpy(at))
    torch.testing.assert_close(theta[0][0], theta[1], rtol=0.02, atol=0)
    assert "the given field of view" in found.verdict


@slow
def test_the_centre_is_found_if_there_are_many_curves():
    lens = LENSES["equidistant"]
    curves = [curves_of(lens, s, 80, bent=0, askew=0, center=(6.0, -4.0)) for s in range(4)]
    found = from_curves(curves, SIZE, "Equidistant")
    torch.testing.assert_close(found.lens.center[0], f64(325.5, 235.5), atol=1.0, rtol=0)
    fixed = from_curves(curves[:2], SIZE, "Equidistant", center=(325.5, 235.5))
    torch.testing.assert_close(fixed.lens.center[0], f64(325.5, 235.5), atol=0.1, rtol=0)


@slow
def test_edges_of_a_black_frame_are_no_lines():
    lens, along, down = LENSES["spherical 0.3"], np.arange(630.0), np.arange(470.0)
    curves = [curves_of(lens, seed, 15, bent=0) for seed in range(2)]
    frame = [(along, 0 * along + 2), (along, 0 * along + 476), (0 * down + 4, down)]
    framed = [[np.stack(side, 1) for side in frame] + of for of in curves]
    assert_same(from_curves(framed, SIZE), from_curves(curves, SIZE))


@slow
def test_larger_pictures_of_the_same_sharpness_give_the_same_lens():
    curves = curves_of(LENSES["equidistant"], 1, 25)
    large = [np.repeat(4 * curve + 1.5, 4, 0) for curve in curves]
    found, same = from_curves([curves], SIZE), from_curves([large], (4 * SIZE[0], 4 * SIZE[1]))
    assert same.rim == pytest.approx(found.rim, rel=0.01) and same.curves == found.curves
    assert same.lens.focal.item() == pytest.approx(4 * found.lens.focal.item(), rel=0.02)


@slow
def test_short_edges_of_a_board_in_many_poses_determine_a_narrow_lens():
    """All lines of a picture are in one plane, and some edges behind it are in any direction."""
    lens = lenses.BrownConrady(f64(540.0), radial=f64(-0.27, 0.04)[None], **F64)
    found = from_curves([board_of(lens, seed) for seed in range(4)], SIZE, "KannalaBrandt")
    assert found.rim == pytest.approx(rim_of(lens), rel=0.03) and found.doubts == ()


@slow
def test_an_interval_holds_the_truth_also_if_pixels_are_oblong():
    misses = []
    for seed, lens in enumerate(list(LENSES.values())[:9]):
        center, ratio = np.random.default_rng(seed).uniform(-3, 3, 2), (1, 1, 0.95)[seed % 3]
        curves = [
            c * (1, ratio) + (0, 239.5 * (1 - ratio))
            for c in curves_of(lens, seed, noise=0.1, center=center)
        ]
        low, high = from_curves([curves], SIZE).interval
        misses.append(abs(2 * rim_of(lens, 240 / ratio**0.5) - low - high) / (high - low))
    assert sum(miss <= 1 for miss in misses) >= 8 and max(misses) < 2


@pytest.mark.parametrize("pitch", [0.5, pytest.param(0.9, marks=slow)])
def test_a_pair_that_is_orthogonal_at_every_scale_sets_none(pitch):
    """The marks on a floor below a camera: across it, and ahead of it."""
    marks = np.array([[1, 0, 0], [0, -math.sin(pitch), math.cos(pitch)]])
    curves = curves_of(LENSES["equisolid"], 1, 40, askew=0, axes=2, rotation=marks)
    found = from_curves([curves], SIZE, "KannalaBrandt")
    assert not found.is_sure and "do not set the scale" in found.doubts[0]
    assert "hardly set the scale" in found.verdict
    low, high = found.interval
    assert abs(2 * rim_of(LENSES["equisolid"]) - low - high) < 2 * (high - low)


@pytest.mark.parametrize(("of_second", "askew", "doubt"), [
    (4, 0, "only 4 lines of a picture have a second direction"),
    pytest.param(15, 6, "", marks=slow),
    pytest.param(12, 80, "of the lines agree with orthogonal directions", marks=slow),
])  # fmt: skip
def test_few_orthogonal_lines_are_a_doubt(of_second, askew, doubt):
    lens = LENSES["equidistant"]
    curves = curves_of(lens, 3, 15, axes=1, bent=0, askew=askew)
    other = curves_of(lens, 3, of_second, axes=1, bent=0, askew=0, first=1)
    said = " ".join(from_curves([curves + other], SIZE).doubts)
    assert doubt in said and ("direction" in said) == bool(doubt)


def test_too_little_evidence_is_refused_in_one_sentence():
    for curves in ([], [[]], [curves_of(LENSES["equidistant"], 1, 5, askew=0, bent=2)]):
        said = "may be straight, but"
        assert "\n" not in refused(said, from_curves, curves, SIZE, error=CalibrationError)


@slow
def test_nothing_of_an_estimate_is_random_and_no_lens_at_all_is_no_answer(monkeypatch):
    curves = [curves_of(LENSES["equisolid"], 1)]
    found = from_curves(curves, SIZE)
    assert_same(found, from_curves(curves, SIZE))
    monkeypatch.setattr(lines, "NARROWEST", found.rim + 0.1)
    refused("do not determine a lens", from_curves, curves, SIZE, error=CalibrationError)


def test_an_interval_has_only_angles_of_lenses(monkeypatch):
    monkeypatch.setattr(lines, "_allowed", lambda best: (best, np.full(20, 9.0)))
    found = from_curves([curves_of(LENSES["equisolid"], 1)], SIZE)
    assert found.interval == (0.0, math.pi) and "very different lenses" in found.doubts[0]
    assert not found.is_sure


@slow
@pytest.mark.parametrize("model", ["Spherical", "KannalaBrandt", "Equidistant"])
def test_the_spread_is_of_the_whole_curve_and_of_the_model(model):
    """A model that does not suit the lens is off by no more than three deviations anywhere."""
    lens, radii = LENSES["stereographic"], torch.linspace(12, 240, 39, dtype=torch.float64)
    found = from_curves([curves_of(lens, seed) for seed in (1, 2)], SIZE, model)
    theta, true = (of.with_theta_max(None).unproject(radii[None])[0] for of in (found.lens, lens))
    off, of_rim = (theta / true - 1).abs(), (found.interval[1] - found.rim) / found.rim
    assert off.max() < 3 * found.spread and off[-1] < 3 * of_rim <= 3 * found.spread
    assert found.spread > (0.05 if model == "Equidistant" else 0.004)
    assert f"within {found.spread:.1%}" in found.verdict


NOISE = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.uint8)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"pictures": []}, "one size, got no pictures"),
    ({"pictures": [np.zeros((20, 30), np.uint8), np.zeros((30, 20), np.uint8)]},
     "got 20 × 30 px .*, 30 × 20 px"),
    ({"model": "Sphere"}, "unknown lens model 'Sphere'"),
    ({"fov": 7.0}, "`fov` must be above 0 and below 2π, got 7"),
    ({"fov": 2.0}, "no image circle is visible"),
    ({}, "only 0 curves may be straight, but"),
    *(({"pictures": [NOISE[:height, :width]]}, "pictures must have at least 16 × 16 px")
      for height, width in ((0, 0), (0, 20), (1, 1), (15, 40))),
    *(({"pictures": [NOISE[:height, :width]]}, "curves may be straight, but")
      for height, width in ((16, 16), (17, 40), (64, 64))),
])  # fmt: skip
def test_wrong_arguments(arguments, message):
    refused(message, estimate, **{"pictures": [np.full((60, 80, 3), 90, np.uint8)]} | arguments)
