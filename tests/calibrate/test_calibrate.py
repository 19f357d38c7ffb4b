"""Calibration against rigs whose lens and poses are known."""

import dataclasses
import json
import math
import re
import types

import numpy as np
import pytest
import torch
from helpers import slow_but
from mishaps import flat, not_square, seen, shown
from rigs import WIDEST, board, f64, ray_errors, rig, true_lens, turn
from torch.testing import assert_close

from darswin.calibrate import calibrate
from darswin.calibrate.doubts import doubts
from darswin.calibrate.refine import Free, State, Views, refine
from darswin.calibrate.steady import Steadiness, places
from darswin.lens import MODELS, Equidistant, from_dict, load, save
from darswin.lens.solve import direction_of, vector_of

FOVS = (60, 120, 180, 220, 250)
NARROW = ("DoubleSphere", "KannalaBrandt", "Perspective", "Tabulated")
WIDE = [(model, WIDEST.get(model, 250)) for model in sorted(MODELS)]
ALL = [(model, fov) for model, widest in WIDE for fov in FOVS if fov <= widest]


def of(found, model="KannalaBrandt", **options):
    return calibrate(found.corners, found.board, found.size, model, **options)


@pytest.fixture(scope="module")
def usual():
    return rig(true_lens("KannalaBrandt", 190), 12)


@pytest.fixture(scope="module")
def calibrated(usual):
    """The calibration of the usual rig, and what it said meanwhile."""
    said = []
    return of(usual, progress=said.append), said


@pytest.fixture(scope="module")
def best(usual):
    """The calibration of the usual rig with the best of all models."""
    return of(usual, "auto")


@pytest.fixture(scope="module")
def few():
    """A rig with few pictures, and its calibration."""
    seen = rig(true_lens("Equidistant", 150), 3)
    return seen, of(seen, "Equidistant")


@pytest.mark.parametrize(("model", "fov"), slow_but(
    WIDE + [(model, 60) for model in NARROW],
    ("Equisolid", 250), ("Tabulated", 250),
))  # fmt: skip
def test_twenty_pictures_give_every_model(model, fov):
    lens = true_lens(model, fov)
    found = of(rig(lens, 20), model)
    assert type(found.lens) is MODELS[model] and found.lens.theta_max.dtype == f64
    # The poses absorb a common rotation, which narrow pictures do not tell from the center.
    assert ray_errors(found.lens, lens, best=True).median() < 0.035
    assert 0.17 < found.sigma < 0.23 and found.used.all()
    assert not [doubt for doubt in found.doubts if "axis" not in doubt]
    assert 0.95 * lens.theta_max < found.supported <= lens.theta_max * 1.01


FEW = [("BrownConrady", 60, 2, 3), ("OCam", 120, 4, 3), ("Tabulated", 60, 2, 3)]


@pytest.mark.parametrize(("model", "fov", "seed", "pictures"), slow_but(
    [*FEW, *[(*of, (2, 4)[k % 2], 8) for k, of in enumerate(ALL)][::3]],
    *FEW,
))  # fmt: skip
def test_few_pictures_give_every_model(model, fov, seed, pictures):
    lens = true_lens(model, fov, seed=seed)
    found = of(rig(lens, pictures, board(7, 5) if seed == 4 else None, seed=seed), model)
    assert ray_errors(found.lens, lens, best=True).median() < 0.3
    assert 0.15 < found.sigma < 0.25 and found.used.all()


@pytest.mark.slow
@pytest.mark.parametrize("fov", FOVS[::2])
def test_errors_are_small_in_the_median_of_rigs(fov):
    lens = true_lens("KannalaBrandt", fov)
    found = (of(rig(lens, 20, seed=seed)).lens for seed in range(8))
    errors = [ray_errors(each, lens, best=True).median() for each in found]
    assert torch.stack(errors).median() < 0.02


def test_exact_corners_give_the_exact_lens_and_poses():
    true = rig(true_lens("KannalaBrandt", 200), 3, noise=0.0)
    found = of(true)
    assert ray_errors(found.lens, true.lens).max() < 1e-4
    assert_close(found.rotations, true.rotations, rtol=0, atol=1e-5)
    assert_close(found.translations, true.translations, rtol=0, atol=1e-5)
    seen = ~true.corners.isnan().any(-1)
    assert found.residuals[seen].abs().max() < 1e-3 and found.residuals[~seen].isnan().all()
    angles, _ = true.lens.unproject_pixels(true.corners)
    assert_close(found.theta[seen], angles[seen], rtol=0, atol=1e-5)


def test_a_part_of_a_mirrored_board_is_enough():
    usual = rig(true_lens("KannalaBrandt", 190), 3, noise=0.05, least=54)
    corners = usual.corners.reshape(3, 6, 9, 2).flip(2).reshape(3, 54, 2)
    corners[::2, :27] = math.nan
    corners[1::2, ::3] = math.nan
    found = of(usual._replace(corners=corners))
    assert ray_errors(found.lens, usual.lens, best=True).median() < 0.03 and found.used.all()
    assert [text for text in found.doubts if "mirrored" in text and "in 3" in text]


def test_what_does_not_fit_is_named_and_does_no_harm(usual):
    """A corner, a picture whose corners are exchanged, and two with too few corners."""
    corners, exchanged = usual.corners.clone(), torch.randperm(54)
    k = int((~corners[3, :, 0].isnan()).nonzero()[4])
    corners[3, k] += torch.tensor([12.0, -16.0], dtype=f64) * (1 if corners[3, k, 0] < 500 else -1)
    corners[5] = corners[5, exchanged]
    corners[2] = math.nan
    corners[4, 5:] = math.nan
    found = of(usual._replace(corners=corners), names=[f"{k}.png" for k in range(12)])
    fits = torch.tensor([k not in (2, 4, 5) for k in range(12)])
    assert torch.equal(found.used, fits) and found.rotations[2].isnan().all()
    assert found.weights[3, k] < 0.01 and not found.weights[5].any()
    said = [re.match(r"corner \d+ of \S+|\d\.png (does not fit: |shows)", x) for x in found.doubts]
    assert [words[0] for words in said if words] == [
        f"corner {k + 1} of 3.png", "2.png shows", "4.png shows", "5.png does not fit: ",
    ]  # fmt: skip
    without = of(usual._replace(corners=usual.corners[fits]))
    assert ray_errors(found.lens, without.lens, best=True).median() < 0.01
    assert ray_errors(found.lens, without.lens).max() < 0.01


def test_few_pictures_inputs_of_other_kinds_and_terms(few):
    seen, found = few
    other_board = types.SimpleNamespace(points=seen.board.numpy())
    other = calibrate(seen.corners.numpy(), other_board, (960, 1000), Equidistant)
    assert_close(other._vector, found._vector, rtol=1e-9, atol=1e-9)
    assert math.isnan(found.left_out) and found.to_dict()["left_out"] is None
    for terms in (1, 5):
        assert of(seen, terms=terms).lens.radial.shape == (1, terms)


@pytest.mark.slow
def test_neither_order_nor_unit_of_length_matters(usual, best):
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    other = calibrate(usual.corners[order], 1000 * usual.board, usual.size)
    assert other.models[0][0] == best.models[0][0]
    assert ray_errors(best.lens, other.lens).max() < 1e-3
    assert_close(other.translations, 1000 * best.translations[order], rtol=1e-3, atol=0.1)


def test_it_is_saved_and_described(usual, calibrated, tmp_path):
    found, said = calibrated
    steps = "Finding a start from 12 pictures", "Refining the lens: ", "Leaving out pictures: "
    assert said == [steps[0], *(step + "KannalaBrandt" for step in steps[1:])]
    # θ_max is the sensor's, or where the curve ends.
    assert found.lens.theta_max == min(found.lens.side_angles().max(), found.lens.theta_limit)
    described = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    theta_max = pytest.approx(found.lens.theta_max.item())
    assert from_dict(described["lens"]).theta_max.item() == theta_max
    assert np.shape(described["residuals"]) == (12, 54, 2) and described["sigma"] == found.sigma
    corners = np.array(described["corners"], float)  # None where not seen
    np.testing.assert_array_equal(corners, usual.corners)
    save(found.lens, tmp_path / "camera.json")
    assert load(tmp_path / "camera.json", dtype=f64).theta_max.shape == (1,)


@pytest.mark.slow
def test_the_best_model_predicts_left_out_pictures(usual, best):
    table = {model: (left_out, reason) for model, left_out, _, reason in best.models}
    assert best.models[0][0] == type(best.lens).__name__
    assert best.left_out == best.models[0][1] <= 1.02 * table["KannalaBrandt"][0]
    assert table["Equisolid"][0] > 2 * best.left_out
    assert "the axis, but Perspective lenses end at 90°" in table["Perspective"][1]
    assert ray_errors(best.lens, usual.lens, best=True).median() < 0.04


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "seed", "best"), [("OCamInverse", 29, "Polynomial"), ("EnhancedUnified", 3, None)]
)
def test_many_models_find_a_lens_that_one_cannot_show(model, seed, best):
    true = rig(true_lens(model, 250, seed=seed), 20, noise=0.2, seed=seed, least=54)
    found = of(true, "auto")
    assert found.models[0][0] == (best or model)
    one, many = (ray_errors(f.lens, true.lens, best=True).median() for f in (of(true), found))
    assert many < 0.02 < 0.05 < one


@pytest.mark.parametrize(("model", "ratio", "words"), slow_but(
    [(model, *row) for model in ("KannalaBrandt", "Mei", "Perspective", "Fisheye624", "auto")
     for row in ((1.05, "5 % longer"), (0.99, "1 % shorter"), (1.0, None))],
    ("Fisheye624", 0.99, "1 % shorter"), ("Perspective", 1.05, "5 % longer"),
))  # fmt: skip
def test_the_ratio_of_a_pixels_sides_is_found_if_it_is_significant(model, ratio, words):
    lens = {"auto": "KannalaBrandt"}.get(model, model)
    true = rig(true_lens(lens, 100, seed=3), 12, noise=0.2, seed=3)
    corners = not_square(ratio)(true, None).corners
    found = of(true._replace(corners=shown(corners)), model)
    assert found.lens._affine()[0, 1, 1].item() == pytest.approx(ratio, abs=2e-3)
    said = [text for text in found.doubts if text.startswith("lengths along y are ")]
    assert len(said) == ("affine[3]" in found.parameters) == (words is not None)
    assert not said or re.match(rf"lengths along y are [\d.]+ % {words[4:]} than", said[0])


def test_the_ratio_of_a_pixels_sides_is_always_or_never_free():
    lens = true_lens("KannalaBrandt", 180)
    lens = lens.replace(affine=torch.tensor([[[1, 0], [0, 1.03]]], dtype=f64))
    seen = rig(lens, 15)
    found, square = (of(seen, square_pixels=held) for held in (False, True))
    assert abs(found.lens.affine[0, 1, 1] - 1.03) < 1e-3 and "affine[3]" in found.parameters
    assert ray_errors(found.lens, lens, best=True).median() < 0.03
    assert "affine[3]" not in square.parameters and square.left_out > 2 * found.left_out


@pytest.mark.parametrize(("ratio", "square"), slow_but(
    [(1.01, None), (0.99, False), (1.01, True)], (1.01, None)
))  # fmt: skip
def test_a_stretched_board_is_found(ratio, square):
    lens = true_lens("KannalaBrandt", 120, seed=1)
    seen = rig(lens, 12, board() * torch.tensor([1, ratio]), noise=0.05)
    found = calibrate(seen.corners, board(), seen.size, "KannalaBrandt", square_pixels=square)
    assert ray_errors(found.lens, lens, best=True).max() < 0.03 and "stretch" in found.parameters
    tall, wide = found.board[-1, :2] - found.board[0, :2], (board()[-1] - board()[0])
    assert ((tall / wide)[1] / (tall / wide)[0]).item() == pytest.approx(ratio, abs=5e-4)
    (said,) = [text for text in found.doubts if text.startswith("the board is ")]
    assert ("longer along its columns" if ratio > 1 else "shorter along its columns") in said


def test_a_bent_board_is_found():
    lens = true_lens("KannalaBrandt", 100, seed=1)
    true = rig(lens, 12, noise=0.0)
    across = (true.board - true.board.mean(0))[:, :1]
    sag = 2e-3 * (1 - (across / across.max()).square())
    solid = torch.cat((true.board, sag), 1)
    generator = torch.Generator().manual_seed(0)
    corners = seen(lens, solid, true.rotations, true.translations, 0.05, generator)
    found = calibrate(corners, true.board, true.size, "KannalaBrandt")
    assert ray_errors(found.lens, lens, best=True).quantile(0.95) < 0.03
    assert {"bend[0]", "bend[1]"} < {*found.parameters} and found.left_out < 0.08
    assert_close(found.board[:, 2:] - found.board[:1, 2:], sag - sag[0], rtol=0, atol=1e-4)
    # The poses are those of the bent board.
    places = found.board @ found.rotations.mT + found.translations[:, None]
    there = ~corners.isnan().any(-1)
    residuals = found.lens.with_theta_max(None).project_points(places) - corners
    assert_close(residuals[there], found.residuals[there], rtol=0, atol=1e-6)
    assert [text for text in found.doubts if text.startswith("the board is bent by 0.001")]


def test_boards_that_never_turn_cannot_tell_their_ratio_from_that_of_the_pixels():
    lens = true_lens("KannalaBrandt", 60, shift=0.0)
    generator = torch.Generator().manual_seed(0)
    u = torch.rand(8, 5, generator=generator, dtype=f64) - 0.5
    rotations = turn(flat(1.2 * u[:, :2] * torch.eye(2)[[0, 1] * 4]))
    middle = torch.stack((0.2 * u[:, 2], 0.2 * u[:, 3], 0.45 + 0.2 * u[:, 4]), -1)
    solid = flat(board() - board().mean(0)) * torch.tensor([1, 1.01, 1])
    corners = seen(lens, solid, rotations, middle, 0.05, generator)
    found = calibrate(corners, board(), (960, 1000), "KannalaBrandt")
    (said,) = [text for text in found.doubts if "along y" in text]
    assert "of the pixels or of the board" in said and "turn it by a quarter" in said
    assert "resized" not in said


@pytest.mark.slow
def test_left_out_is_the_error_of_pictures_that_were_left_out():
    true = rig(true_lens("KannalaBrandt", 180), 5, noise=0.5)
    found = of(true)
    total, count = 0.0, 0
    for k in range(5):
        rest = of(true._replace(corners=true.corners[[i for i in range(5) if i != k]]))
        # The lens without the picture, and the best pose of the picture in it.
        solid, middle = flat(true.board - true.board.mean(0)), flat(true.board.mean(0))
        unit = solid.norm(dim=1).max()
        there = ~true.corners[k : k + 1].isnan().any(-1)
        corners = true.corners[k : k + 1].nan_to_num()
        views = Views(corners, there, solid / unit, torch.zeros(1).long())
        shift = (found.translations[k : k + 1] + found.rotations[k : k + 1] @ middle) / unit
        lens = rest.lens.with_theta_max(None)
        state = State(rest._vector, lens, found.rotations[k : k + 1], shift)
        state, _ = refine(views, Free(lens), state, lens_moves=False)
        total += views.miss(state).square().sum().item()
        count += int(there.sum())
    assert found.left_out == pytest.approx(math.sqrt(total / count), rel=0.01)
    assert found.left_out > found.error


@pytest.mark.slow
def test_uncertainty_is_the_scatter_of_repeats():
    lens = true_lens("KannalaBrandt", 190)
    true = rig(lens, 10, noise=0.0)
    theta = lens.theta_max * torch.linspace(0.1, 0.9, 5, dtype=f64)
    direction = direction_of(torch.linspace(0, 5, 6, dtype=f64)[:, None])
    rays = vector_of(theta.expand(6, 5), direction.expand(6, 5, 2))
    places, radii, spreads, theta_spreads = [], [], [], []
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        noise = 0.3 * torch.randn(true.corners.shape, generator=generator, dtype=f64)
        found = calibrate(true.corners + noise, true.board, true.size, "KannalaBrandt")
        off = (found.rotations @ true.rotations.mT).mean(0)
        off = off - off.T
        mean = turn(torch.stack((off[2, 1], off[0, 2], off[1, 0])) / 2)
        places.append(found.lens.with_theta_max(None).project_points(rays @ mean.T))
        radii.append(found.lens.project(theta))
        spreads.append(found.uncertainty(lens.project_points(rays)))
        theta_spreads.append(found.uncertainty_of_theta(theta))
    apart = torch.stack(places)
    apart = (apart - apart.mean(0)).permute(1, 2, 3, 0)
    scatter = torch.linalg.eigvalsh(apart @ apart.mT / 59)[..., -1].sqrt()
    ratio = torch.stack(spreads).mean(0) / scatter
    assert (ratio.log().mean().exp() - 1).abs() < 0.15 and ((ratio < 1.4) & (ratio > 0.7)).all()
    ratio = torch.stack(theta_spreads).mean(0) / torch.stack(radii).std(0)
    assert (ratio < 1.3).all() and (ratio > 1 / 1.3).all()


def test_uncertainty_grows_where_no_corner_was_seen(usual, calibrated):
    corners = torch.where(usual.corners[..., :1] > 520, math.nan, usual.corners)
    narrow, found = of(usual._replace(corners=corners)), calibrated[0]
    left, right = narrow.uncertainty([[150.0, 480.0], [900.0, 480.0]])
    assert right > 1.3 * left and right > 1.3 * found.uncertainty([900.0, 480.0])
    assert found.uncertainty(torch.zeros(2, 3, 2)).shape == (2, 3)
    assert found.uncertainty_of_theta(0.5).shape == ()


@pytest.mark.slow
def test_a_wrong_model_makes_no_outlier_count(usual, calibrated):
    corners = usual.corners.clone()
    corners[3, 10] += 4.0
    found = of(usual._replace(corners=corners), "auto")
    assert found.left_out == pytest.approx(calibrated[0].left_out, rel=0.05)
    assert found.doubts[0].startswith("corner 11 of picture 4 is ")


@pytest.mark.slow
def test_the_best_model_that_is_accepted_is_taken(usual, best):
    table = [name for name, *_ in best.models]
    found = of(usual, "auto", accept=lambda lens: type(lens).__name__ == table[2])
    assert found.models[0][0] == type(found.lens).__name__ == table[2]
    assert {name for name, *_ in found.models} == {*table}
    assert type(of(usual, "auto", accept=lambda lens: False).lens).__name__ == table[0]


def left_out_doubts(found, corners):
    steady, seen = Steadiness(12, 0.0, 0.0, 0.0, 0.0), ~corners.isnan().any(-1)
    said = doubts(found, seen, corners.new_zeros(3), steady)
    return [text for text in said if "that were left out are missed" in text]


def test_left_out_pictures_that_are_missed_are_doubted(usual, calibrated):
    for times in (1.5, 5.0):
        found = dataclasses.replace(calibrated[0], left_out=times * calibrated[0].sigma)
        assert len(left_out_doubts(found, usual.corners)) == (times > 4)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "noise"), [("KannalaBrandt", 0.2), ("Fisheye624", 2.0)])
def test_too_many_numbers_for_few_pictures_miss_those_left_out(model, noise):
    seen = rig(true_lens("KannalaBrandt", 190).with_theta_max(0.8), 4, noise=noise, least=10)
    found = of(seen, model)
    assert (found.left_out > 2.5 * found.sigma) == (model == "Fisheye624")
    assert bool(left_out_doubts(found, seen.corners)) == (found.left_out > 4 * found.sigma)


def test_bursts_show_the_board_at_one_place(usual):
    burst = usual.corners[4:5] + 0.2 * torch.randn(5, 54, 2, dtype=f64)
    corners = torch.cat((usual.corners[:4], burst, usual.corners[5:8]))
    there = ~corners.isnan().any(-1)
    assert places(corners.nan_to_num(), there).tolist() == [0, 1, 2, 3, *[4] * 5, 9, 10, 11]
    few = of(usual._replace(corners=corners[2:9]))
    assert [t for t in few.doubts if t.startswith("7 pictures show the board at 3 places")]
    many = of(usual._replace(corners=corners))
    assert not [t for t in many.doubts if "places" in t]
    # Leaving out a part of a burst says nothing: it is left out whole.
    assert math.isnan(few.left_out) and many.left_out > many.error
