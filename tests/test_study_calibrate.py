"""The calibration study: its sets, its measure of errors, and each method on exact corners."""

import json

import calibrate
import calibrate_tables
import numpy as np
import pytest
import torch
from calibrate import NEEDS
from calibrate_peers import METHODS, OURS, FailedError, versions
from calibrate_rays import FOVS, QUICK, Set, all_sets, fovs, make, ray_errors
from calibrate_real import AUTO, BOARD, left_out, miss
from helpers import in_this_process
from rigs import rig, turn

from darswin.lens import MODELS, BrownConrady

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
    assert np.median(ray_errors(METHODS[name](given), true)) < limit


@pytest.mark.slow
def test_a_picture_left_out_is_missed_only_by_a_wrong_lens():
    true = BrownConrady(
        500.0, (-0.2, 0.05, 0.0), tangential=(1e-3, -1e-3), center=(310.0, 250.0),
        image_size=(480, 640), theta_max=0.6,
    ).to(torch.float64)  # fmt: skip
    points = torch.as_tensor(BOARD.points, dtype=torch.float64)
    corners = rig(true, 4, points, noise=0.0, least=len(points)).corners.numpy()
    assert np.abs(miss(true, corners[0])).max() < 1e-3
    wrong = true.replace(radial=true.radial + torch.tensor([0.1, 0.0, 0.0]))
    assert max(np.abs(miss(wrong, one)).max() for one in corners) > 0.1
    fits = []

    def method(others, size):
        fits.append((len(others), size))
        return true

    found = left_out(method, corners, (480, 640))
    assert max(found) < 1e-3 and fits == [(3, (480, 640))] * 4


@pytest.mark.slow
def test_a_run_is_recorded_and_its_tables_are_made(tmp_path, monkeypatch):
    def fails(_):
        raise FailedError("too few pictures")

    given, true = make(QUICK[0], 0)
    exact, _ = make(QUICK[0]._replace(noise=0.0), 0)
    assert (given.corners - exact.corners).std() == pytest.approx(0.2, rel=0.1)
    with pytest.raises(FailedError, match="pictures lie within 5°"):
        given.within(5)
    ways = dict.fromkeys(OURS, lambda _: true) | {"cv2.fisheye, flags": fails}
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


@pytest.mark.slow
def test_the_table_of_real_pictures_names_what_fails():
    one = dict(model="OCam", left_out=[3.0, 4.0], median=0.1, most=0.2)
    results = {AUTO: one, "other": one | dict(left_out=[3.0, None])}
    made = calibrate_tables.real(dict(real=[dict(camera="left", results=results)]))
    assert made.splitlines()[2:] == [
        "| ours, auto: OCam | 3.5355 | 0.10° (0.20°) |",
        "| other | fails for 1 | 0.10° (0.20°) |",
    ]
