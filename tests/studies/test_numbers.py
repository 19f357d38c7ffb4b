"""Numbers of the records: scores, errors and intervals. Their tables are held by those of the
pages: see docs/test_claims.py."""

import calibrate_real
import numpy as np
import pytest
import rigs
import sizes_scene
import torch
from calibrate_peers import Found
from calibrate_rays import ray_errors
from calibrate_real import SQUARE, left_out, miss
from cells import ablations, augmented, headline
from dense_cells import CONTROLLED, STUDIED, STUDIED_MODELS, all_cells
from learned_lens import KNOWN, distance, lens_of
from pretrained_methods import Found as Detected
from pretrained_scenes import COCO, Thing
from pretrained_scores import average_precision, match, rows_of, scores
from rigs import rig, turn

from darswin import create_model
from darswin.calibrate import Board, calibrate


def test_cells_have_folders_of_their_own_and_make_models():
    cells = headline(3) + ablations(3) + augmented(3)
    assert len({cell.key for cell in cells}) == len({cell.identity for cell in cells}) == len(cells)
    for cell in ablations(1):
        create_model(f"{cell.family}_nano", num_classes=10, in_chans=1, **cell.options)
    dense = all_cells(3)
    expected = len(STUDIED) * (len(STUDIED_MODELS) * 3 + len(CONTROLLED))
    assert len({cell.key for cell in dense}) == len(dense) == expected


# -- detections ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_average_precision_is_the_area_under_the_interpolated_curve():
    rng = np.random.default_rng(7)
    for _ in range(20):
        hits = rng.random(30) < 0.4
        things = hits.sum() + rng.integers(1, 5)
        curve = [(hits[: k + 1].sum() / things, hits[: k + 1].mean()) for k in range(30)]
        steps = np.linspace(0, 1, 20_001)[1:]
        area = np.mean([max((p for r, p in curve if r >= step), default=0) for step in steps])
        assert average_precision(hits, np.ones(30), things) == pytest.approx(area, abs=1e-3)
    assert average_precision(np.zeros(0, bool), np.zeros(0), 3) == 0


def scene_of(rng, label: str) -> tuple[Detected, list[Thing]]:
    """Random things, detections near some of them, and some elsewhere."""
    corners = rng.uniform(0, 900, (4, 2))
    truth = np.concatenate((corners, corners + rng.uniform(40, 100, (4, 2))), 1)
    things = [Thing(label, "", np.array([0, 0, 1.0]), 0.3, box) for box in truth]
    found = np.concatenate((truth + rng.normal(0, 12, truth.shape), truth[::-1] + 300))
    labels = np.full(len(found), COCO.index(label))
    labels[rng.integers(len(found))] = 0
    ones = np.ones(len(found))
    return Detected(
        found, rng.uniform(0.1, 1, len(found)), labels, ones, 0 * ones, 0 * ones
    ), things


def test_scenes_that_count_twice_are_two_scenes():
    """Intervals resample scenes by such weights."""
    rng = np.random.default_rng(8)
    found, things = zip(*(scene_of(rng, of) for of in ("dog", "dog", "cat", "zebra")), strict=True)
    weights = np.array([2.0, 0, 1, 3])
    many = np.repeat(np.arange(4), weights.astype(int))
    whole = scores(rows_of(found, things), weights)
    again = scores(rows_of([found[k] for k in many], [things[k] for k in many]), np.ones(6))
    assert whole == pytest.approx(again)
    assert 0 < whole["map"] < 1 and 0 < whole["recall"] < 1 and whole["false"] > 0


def test_each_thing_is_hit_once_and_only_by_its_class():
    box, (dog, cat) = np.array([10.0, 10, 50, 50]), map(COCO.index, ("dog", "cat"))
    things = [Thing("dog", "", np.array([0, 0, 1.0]), 0.3, box)]
    found = Detected(
        np.stack([box] * 3), np.array([0.5, 0.9, 0.8]), np.array([dog, cat, dog]), 0, 0, 0
    )
    order, hits = match(found, things)
    assert order.tolist() == [1, 2, 0] and hits.tolist() == [-1, 0, -1]
    sure = rows_of([found._replace(scores=np.array([0.1, 0.2, 0.25]))], [things])
    assert sure.hit.sum() == 1 and not sure.thing_found.any()


# -- lenses -------------------------------------------------------------------------------------


def test_the_distance_of_two_lenses():
    lens, moved = (lens_of(KNOWN | dict(x=x)) for x in (15.5, 18.5))
    assert distance(lens, lens) == 0 and distance(moved, lens) == pytest.approx(3, abs=1e-4)


def test_errors_do_not_depend_on_the_frame_nor_on_a_few_wrong_rays():
    true = torch.nn.functional.normalize(torch.randn(100, 3, dtype=torch.float64), dim=1).numpy()
    turned = true @ turn(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)).numpy()
    assert ray_errors(turned, true).max() < 1e-4
    turned[:10] = np.nan
    turned[10:20] = -turned[10:20]
    off = ray_errors(turned, true)
    assert (off[:20] > 179.9).all() and off[20:].max() < 1e-4
    assert (ray_errors(np.full((100, 3), np.nan), true) == 180).all()
    assert ray_errors(true * [1, 1, -1], true).max() > 10  # a mirrored camera is wrong


def test_a_picture_left_out_is_missed_by_a_wrong_lens_or_a_flat_board(monkeypatch):
    monkeypatch.setattr(calibrate_real, "FOLDS", 2)
    true = rigs.true_lens("KannalaBrandt", 190, seed=1)
    board = Board.chessboard(9, 6, SQUARE)
    flat = torch.as_tensor(board.points, dtype=torch.float64)
    seen = rig(true, 3, flat, noise=0.0, least=len(flat))
    whole = calibrate(seen.corners, board, seen.size, "KannalaBrandt")
    middle = (flat - flat.mean(0))[:, 0]
    bent = torch.cat((flat, 0.5 * middle.square()[:, None]), 1)
    corners = true.project_points(bent @ seen.rotations.mT + seen.translations[:, None])
    corners = torch.where(seen.corners.isnan(), torch.nan, corners).numpy()
    corners[0, 3] = np.nan
    pictures = []

    def off(lens, solid):
        def method(given):
            pictures.append(len(given.corners))
            rays = lens.with_theta_max(None).unproject_points(torch.from_numpy(given.pixels))
            return Found(rays.numpy(), solid, "model")

        return left_out(method, corners, board, seen.size, whole)

    right = off(true, bent.numpy())
    assert right["error"] < 1e-3 and right["failed"] == 0 and right["models"] == ["model"]
    assert pictures == [1, 2]
    wrong = off(true.replace(radial=true.radial + torch.tensor([0.03, 0, 0, 0])), bent.numpy())
    assert min(wrong["error"], off(true, None)["error"]) > 0.05
    assert miss(true, bent.numpy(), np.full((54, 3), np.nan), np.ones(54, bool)) is None


def test_wrong_lenses_scale_the_angle_of_each_pixel():
    lens = sizes_scene.lenses_of(sizes_scene.OWN, 3)
    radii = torch.linspace(0, sizes_scene.SIZE / 2, 20)[None, :-1]
    for factor in (0.8, 1.25):
        found = sizes_scene.with_angles_scaled(lens, factor).unproject(radii)
        torch.testing.assert_close(found, factor * lens.unproject(radii), atol=2e-4, rtol=1e-3)
