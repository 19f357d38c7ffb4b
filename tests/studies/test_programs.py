"""Each study as a whole, on a few small pictures: it runs once, keeps what it found, and its tables
show it. The pretrained study is beside this file."""

import json
import math
import sys
from pathlib import Path

import calibrate
import calibrate_tables
import dense
import dense_data
import dense_tables
import estimate
import estimate_tables
import learned_lens
import learned_tables
import numpy as np
import pytest
import quantized
import sizes
import sizes_tables
import study
import tables
import torch
from calibrate_peers import METHODS
from calibrate_rays import Set, make
from cells import LEVELS, POLYNOMIAL, SWEEP, ablations, augmented, headline
from helpers import in_this_process, refused
from sizes_scene import LENSES, OWN
from worlds import wad
from worlds.render import rays_of

from darswin import create_model
from darswin.data import open_scenes
from darswin.models.saving import ModelCard, save_model

pytestmark = pytest.mark.slow
FIT = ["--data.batch_size", "8", "--trainer.max_epochs", "1"]
DIGITS = ["--data.path", "digits", "--data.limit", "96", "--data.render", "32", *FIT]


def read(file: Path) -> dict:
    return json.loads(file.read_text())


def test_classification_and_its_8_bits(tmp_path, monkeypatch):
    """One cell of two models and one with lens augmentation, in processes of their own."""
    cells = [c for c in headline(1) if c.level == "low" and c.label in ("DarSwin-A", "DAT")]
    monkeypatch.setattr(study, "headline", lambda seeds: cells)
    monkeypatch.setattr(study, "ablations", lambda seeds: [])
    monkeypatch.setattr(study, "augmented", lambda seeds: augmented(1)[-1:])
    where = ["--out", str(tmp_path / "out"), "--results", str(tmp_path), "--test-images", "20"]
    study.main([*where, *DIGITS])
    record = tmp_path / "study--nano.json"
    found = read(record)["cells"]
    assert len(found) == 3 and (tmp_path / "study--nano.png").exists()
    for cell in found:
        assert cell["accuracy"].keys() == {*SWEEP, POLYNOMIAL, *LEVELS}
        assert all(0 <= value <= 100 for value in cell["accuracy"].values())
    made = tables.tables(found)
    assert "| Swin | not run (33.9) |" in made["xi-0.4"] and "(87.9)" in made["xi-0.4"]
    assert made["ablations"].count("not run") == 4 * len(ablations(1))
    # A study that goes on runs nothing again, and mixes nothing.
    for module in (study, quantized):
        monkeypatch.setattr(module, "run_all", in_this_process)
    with monkeypatch.context() as patch:
        patch.setattr(study, "darswin", lambda _: pytest.fail("it was run"))
        study.main([*where, *DIGITS])
        study.main([*where, *DIGITS, "--known", str(record)])
        assert read(record)["cells"] == found
        for other, message in (("--data.limit=9", "was made with"), ("--size=tiny", "not tiny")):
            refused(message, study.main, [*where, *DIGITS, other, "--known", str(record)])
    # 8 bits are tested on the same pictures through the same lenses.
    quantized.main([*where, "--cell", "dat", "--seeds", "1", "--pictures", "8", *DIGITS])
    (cell,) = read(tmp_path / "int8.json")["cells"]
    (trained,) = (of for of in found if of["label"] == "DAT")
    assert cell["accuracy"]["float32"] == {xi: trained["accuracy"][xi] for xi in SWEEP}
    assert cell["layers"][0] >= 8 and cell["changed"].keys() == {*SWEEP}


@pytest.mark.skipif(
    not (wad.FOLDER / "freedoom1.wad").exists(), reason="the game's files are not installed"
)
def test_dense(tmp_path, monkeypatch, threads):
    threads(1)
    for module in (dense, dense_data):
        monkeypatch.setattr(module, "run_all", in_this_process)
    where = ["--out", str(tmp_path / "out"), "--results", str(tmp_path), "--seeds", "1", *FIT]
    where += ["--pixels", "32", "--data.size", "32", "--pictures", "8", "1", "2"]
    dense.main([*where, "--cell", "swin-unet-low"])
    data, names = tmp_path / "out" / "data" / "test", dense_data.test_sets()
    sets = {name: open_scenes(str(data / name), "test", "labels") for name in names}
    stems = {tuple(Path(s.file(k)).stem for k in range(len(s))) for s in sets.values()}
    assert len(stems) == 1 and len(sets["xi-0"]) == 2  # the same scenes
    true, told = sets["xi-1"][0], sets["wrong-1"][0]  # the control has another lens
    assert (true.image == told.image).all()
    assert true.lens.xi.item() == 1 and told.lens.xi.item() == pytest.approx(0.275)
    dense.main([*where, "--collect"])
    record = read(tmp_path / "dense.json")
    assert len(record["cells"]) == 4
    for cell in record["cells"]:
        scores = [row[dense_tables.SCORE[cell["task"]]] for row in cell["sets"].values()]
        assert cell["sets"].keys() == {*names} and all(0 <= score <= 1 for score in scores)
    # With the true heights, the floors and ceilings of most rooms are exact.
    of_set = {name: of["xi-0"]["delta1"] for name, of in record["bounds"].items()}
    blind = record["trivial"]["distance"]["direction"]["xi-0"]["delta1"]
    assert of_set["heights"] > max(blind, of_set["gravity"], of_set["labels"])


def test_sizes(tmp_path, monkeypatch):
    monkeypatch.setattr(sizes, "run_all", in_this_process)
    where = ["--out", str(tmp_path / "out"), "--results", str(tmp_path), "--pictures", "4", "2"]
    for label in ("raw-0", "darswin-unet-ra-absolute"):
        sizes.main([*where, "--seeds", "1", "--cell", label])
    sizes.main([*where, "--collect"])
    record = read(tmp_path / "sizes.json")
    assert len(record["cells"]) == 2 and (tmp_path / "sizes_pictures.png").exists()
    for cell in record["cells"]:
        assert cell["sets"].keys() == {OWN, *LENSES, *sizes_tables.WRONG, sizes_tables.SHUFFLED}
        assert all(0 <= found["delta1"] <= 1 for found in cell["sets"].values())
        if cell["label"] == "raw":  # a wrong lens costs nothing without lens knowledge
            assert all(cell["sets"][name] == cell["sets"][OWN] for name in sizes_tables.WRONG)
    made = sizes_tables.tables(record)
    assert len(made["sizes losses"].splitlines()) == 2 + 2
    assert sizes_tables.tables(None) == dict.fromkeys(made, sizes_tables.NOT_RUN)
    with pytest.raises(ValueError, match="other settings"):
        sizes.main([*where, "--pictures", "5", "2", "--known", str(tmp_path / "sizes.json")])


ROOMS = "Stereographic"


def draw_rooms(name, count):
    """Pictures of rooms in place of the game's worlds; the last one is black."""
    sys.path.append(str(Path(__file__).parents[2] / "examples"))
    from rooms import Room

    rays = rays_of(estimate.lens_of(name), 2).astype(np.float32)
    rooms = [Room(np.random.default_rng(seed)) for seed in range(count - 1)]
    pictures = [np.mean([room.colors(rays[:, :, j]) for j in range(4)], 0) for room in rooms]
    return [picture.astype(np.uint8) for picture in [*pictures, np.zeros((*estimate.SIZE, 3))]]


def test_estimates(tmp_path, monkeypatch):
    monkeypatch.setattr(estimate, "pictures_of", draw_rooms)
    monkeypatch.setattr(estimate, "run_all", in_this_process)
    for name, (_, _, fov, circle) in estimate.LENSES.items():
        lens, radius = estimate.lens_of(name), estimate.CIRCLE if circle else estimate.SIZE[1] / 2
        assert estimate.angle(lens, radius) == pytest.approx(math.radians(fov / 2))
    estimate.main(["--lens", ROOMS, "--pictures", "2", "--results", str(tmp_path)])
    record = read(tmp_path / "estimate.json")
    (of,) = record["lenses"]
    assert of["name"] == ROOMS and record["real"] == []
    assert abs(of["all"]["KannalaBrandt"]["error"]) < 5
    seen, black = of["single"]["Spherical"]
    holds = seen["low"] <= seen["true"] <= seen["high"]
    assert "straight" in black["refused"] and seen["holds"] == holds
    assert of["digits"]["single"][1] is None and of["long"][0] > of["long"][1] == 0
    digits = of["digits"]
    assert digits["true"] > 92
    assert digits["estimated"]["KannalaBrandt"] > digits["wrong"]["perspective"]
    made = estimate_tables.tables(record)
    assert made["estimate single"].splitlines()[-1].endswith("| 1 |")  # refused
    assert estimate_tables.tables(None) == dict.fromkeys(made, estimate_tables.NOT_RUN)


def test_learned_lenses(tmp_path, monkeypatch):
    counts = dict(xi=(4, 8), place=(8,), all=(8,))
    for name, value in dict(
        IMAGES=counts, STEPS=dict(xi=2, place=2, all=2), BATCH=4, TESTED=5, SEARCHED=6, USUAL=8,
        GRID=[0.0, 0.5, 1.0], run_all=in_this_process,
    ).items():  # fmt: skip
        monkeypatch.setattr(learned_lens, name, value)
        monkeypatch.setattr(learned_tables, name, value, raising=False)
    options = dict(num_classes=10, in_chans=1)
    model, card = create_model("darswin_a_nano", **options), ModelCard("darswin_a_nano", options)
    weights = tmp_path / "model" / "checkpoints" / "last.safetensors"
    save_model(weights, model.state_dict(), card)  # of a model that was not trained
    torch.save(list(learned_lens.usual_map(model.eval(), "digits")), tmp_path / "usual.pt")
    where = ["--out", str(tmp_path), "--results", str(tmp_path), "--data", "digits"]
    learned_lens.main([*where, "--cameras", "1"])
    cameras = read(tmp_path / "learned_lens.json")["cameras"]
    assert len(cameras) == 3 and (tmp_path / "learned_lens.png").exists()
    for camera in cameras:
        problem, trials = camera["problem"], camera["trials"]
        assert camera["true"]["distance"] == 0 and camera["true"]["focal"] == 0
        kinds = len(counts[problem]) * len(learned_lens.LOSSES)
        assert len(trials) == kinds * learned_lens.STARTS
        for trial in trials:
            found, start = trial["found"]["values"], trial["start"]["values"]
            for name in learned_lens.PROBLEMS[problem]:
                low, high = learned_lens.BOUNDS[name]
                assert low <= found[name] <= high and found[name] != start[name]
    made = learned_tables.tables(cameras)
    rows = made["learned-lens"].splitlines()
    assert len(rows) == 2 + 3 * len(learned_lens.LOSSES) and "of 2 |" in rows[2]


# Methods whose model describes the true lens exactly, without noise.
EXACT = {
    "KannalaBrandt": (
        "ours, KannalaBrandt", "cv2.fisheye, flags", "cv2.fisheye, flags and check",
        "cv2.fisheye, flags and guess",
    ),
    "BrownConrady": ("ours, true model", "cv2.calibrateCamera", "cv2.calibrateCamera, rational"),
}  # fmt: skip


def test_calibrations(tmp_path, monkeypatch):
    sets = [Set("KannalaBrandt", 100, 6, noise=0.0), Set("BrownConrady", 60, 6, noise=0.0)]
    ways = {name: way for name, way in METHODS.items() if name in sum(EXACT.values(), ())}
    monkeypatch.setattr(calibrate, "METHODS", ways)
    monkeypatch.setattr(calibrate, "QUICK", sets)
    monkeypatch.setattr(calibrate, "run_all", in_this_process)
    where = ["--quick", "--data", str(tmp_path / "none"), "--out", str(tmp_path)]
    calibrate.main(where)
    record = read(tmp_path / "quick" / "calibrate.json")
    for of in record["sets"]:
        assert all(of["results"][name]["median"] < 2e-3 for name in EXACT[of["model"]])
    noisy, exact = (make(sets[0]._replace(noise=noise), 0)[0].corners for noise in (0.2, 0.0))
    assert (noisy - exact).std() == pytest.approx(0.2, rel=0.1)
    # What is known is not run again.
    monkeypatch.setattr(calibrate, "run_set", lambda *_: pytest.fail("it was run"))
    calibrate.main([*where, "--collect"])
    assert read(tmp_path / "quick" / "calibrate.json") == record
    made = calibrate_tables.tables(record)
    assert calibrate_tables.tables(None) == dict.fromkeys(made, calibrate_tables.NOT_RUN)
