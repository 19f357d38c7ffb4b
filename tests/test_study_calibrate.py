"""The calibration study: its sets, its measure of errors, and each method on exact corners."""

import json

import calibrate
import calibrate_tables
import numpy as np
import pytest
import rigs
import torch
from calibrate_peers import METHODS, NEEDS, OURS, FailedError, Found, versions
from calibrate_rays import FOVS, QUICK, Set, all_sets, fovs, make, ray_errors
from calibrate_real import SQUARE, Boards, files_of, left_out, miss
from calibrate_tables import AUTO
from helpers import in_this_process
from rigs import rig, turn

from darswin.calibrate import Board
from darswin.calibrate import calibrate as found_by
from darswin.lens import MODELS

# A method, and a lens that its model describes exactly.
EXACT = {
    "ours, KannalaBrandt": Set("KannalaBrandt", 220, 6, noise=0.0),
    "cv2.calibrateCamera": Set("BrownConrady", 60, 6, noise=0.0),
    "cv2.calibrateCamera, rational": Set("BrownConrady", 60, 6, noise=0.0),
    "cv2.fisheye, flags": Set("KannalaBrandt", 100, 6, noise=0.0),
    "cv2.fisheye, flags and check": Set("KannalaBrandt", 100, 6, noise=0.0),
    "cv2.fisheye, flags and guess": Set("KannalaBrandt", 150, 6, noise=0.0),
    "cv2.omnidir": Set("Mei", 150, 8, noise=0.0),
    "mrcal, OPENCV8": Set("Perspective", 60, 6, noise=0.0),
    "mrcal, splined": Set("Stereographic", 100, 6, noise=0.0),
}


@pytest.mark.slow
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


def test_every_model_has_sets_with_all_numbers_of_pictures():
    sets = all_sets()
    assert len(set(sets)) == len(sets)
    for model in MODELS:
        own = [of for of in sets if of.model == model]
        assert {of.pictures for of in own} == {5, 8, 20, 30}
        assert {of.fov for of in own} <= set(fovs(model)) <= set(FOVS)
    assert fovs("Perspective") == [60, 100, 150] and fovs("KannalaBrandt") == [*FOVS]


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
def test_a_method_finds_a_lens_of_its_model(name):
    if NEEDS.get(name, "opencv") not in versions():
        pytest.skip("the tool is not installed")
    given, true = make(EXACT[name], 3)
    assert given.corners.shape == (EXACT[name].pictures, 54, 2) and np.isfinite(given.corners).all()
    assert len(true) == len(given.pixels) and given.angles.max() <= EXACT[name].fov / 2
    # mrcal's regularization moves its solutions a little, and omnidir stops early.
    limit = 2e-3 if NEEDS.get(name) is None else 0.1
    assert np.median(ray_errors(METHODS[name](given).rays, true)) < limit


def test_a_picture_left_out_is_missed_by_a_wrong_lens_or_a_flat_board():
    true = rigs.true_lens("KannalaBrandt", 190, seed=1)
    board = Board.chessboard(9, 6, SQUARE)
    flat = torch.as_tensor(board.points, dtype=torch.float64)
    seen = rig(true, 8, flat, noise=0.0, least=len(flat))
    whole = found_by(seen.corners, board, seen.size, "KannalaBrandt")
    middle = (flat - flat.mean(0))[:, 0]
    bent = torch.cat((flat, 0.5 * middle.square()[:, None]), 1)
    corners = true.project_points(bent @ seen.rotations.mT + seen.translations[:, None])
    corners = torch.where(seen.corners.isnan(), torch.nan, corners).numpy()
    corners[0, 3] = np.nan
    given = []

    def method(lens, solid):
        def found(one):
            given.append(len(one.corners))
            rays = lens.with_theta_max(None).unproject_points(torch.from_numpy(one.pixels))
            return Found(rays.numpy(), solid, "model")

        return found

    def off(lens, solid):
        return left_out(method(lens, solid), corners, board, seen.size, whole)

    right = off(true, bent.numpy())
    assert right["error"] < 1e-3 and right["failed"] == 0 and right["models"] == ["model"]
    assert given == [6, 6, 6, 7, 7]
    wrong = off(true.replace(radial=true.radial + torch.tensor([0.03, 0, 0, 0])), bent.numpy())
    assert min(wrong["error"], off(true, None)["error"]) > 0.05
    blind = off(true.with_theta_max(0.01), bent.numpy())
    assert blind["failed"] == 0  # the limit is not the lens's own
    unseen = miss(true, bent.numpy(), np.full((54, 3), np.nan), np.ones(54, bool))
    assert unseen is None


def test_the_pictures_of_a_set_are_found_by_pattern(tmp_path):
    for name in ("left1.jpg", "left2.jpg", "right1.jpg"):
        (tmp_path / "imgs").mkdir(exist_ok=True)
        (tmp_path / "imgs" / name).touch()
    found = files_of(Boards("imgs/left*.jpg", 9, 6), tmp_path)
    assert [file.name for file in found] == ["left1.jpg", "left2.jpg"]
    assert files_of(Boards("none/*.jpg", 9, 6), tmp_path) == []


@pytest.mark.slow
def test_a_run_is_recorded_and_its_tables_are_made(tmp_path, monkeypatch):
    def fails(_):
        raise FailedError("too few pictures")

    given, true = make(QUICK[0], 0)
    exact, _ = make(QUICK[0]._replace(noise=0.0), 0)
    assert (given.corners - exact.corners).std() == pytest.approx(0.2, rel=0.1)
    with pytest.raises(FailedError, match="pictures lie within 5°"):
        given.within(5)
    ways = dict.fromkeys(OURS, lambda _: Found(true)) | {"cv2.fisheye, flags": fails}
    monkeypatch.setattr(calibrate, "METHODS", ways)
    monkeypatch.setattr(calibrate, "QUICK", [Set("KannalaBrandt", 150, 20)])
    monkeypatch.setattr(calibrate, "make", lambda *_: (given, true))
    monkeypatch.setattr(calibrate, "run_all", in_this_process)
    where = ["--data", str(tmp_path / "none"), "--out", str(tmp_path)]
    calibrate.main(["--quick", *where])
    record = json.loads((tmp_path / "quick" / "calibrate.json").read_text())
    assert (tmp_path / "quick" / "calibrate.png").exists()
    (of,) = record["sets"]
    assert of["results"]["cv2.fisheye, flags"]["failed"] == "FailedError: too few pictures"
    made = calibrate_tables.tables(record)
    cells = [line.split(" | ")[:3] for line in made["calibrate success"].splitlines()[2:]]
    assert cells == [
        *([f"| {name}", "1/1", "–"] for name in OURS), ["| cv2.fisheye, flags", "0/1", "–"],
    ]  # fmt: skip
    # A set that is known is not run again.
    monkeypatch.setattr(calibrate, "run_set", fails)
    calibrate.main(["--quick", "--collect", *where])
    assert json.loads((tmp_path / "quick" / "calibrate.json").read_text()) == record
    assert calibrate_tables.tables(None) == dict.fromkeys(made, calibrate_tables.NOT_RUN)


def test_the_table_of_real_pictures_names_what_fails():
    one = dict(models=["OCam", "Mei"], failed=0, error=3.0, median=2.0)
    results = {AUTO: one, "cv2.omnidir": one | dict(failed=2, models=[])}
    made = calibrate_tables.real(dict(real=[dict(set="left", pictures=9, of=10, results=results)]))
    cells = made.splitlines()[2].strip("| ").split(" | ")
    assert cells[:3] == ["left", "9 of 10", "3.000 (2.000)"] and cells[-1] == "OCam / Mei"
    assert cells.count("–") == len(calibrate_tables.REAL) - 2 and "fails for 2" in cells
