"""The estimate study: its lenses, its digits, and a run on drawn rooms in place of the game."""

import json
import math
import sys
from pathlib import Path

import estimate as study
import estimate_tables
import numpy as np
import pytest
from helpers import in_this_process
from worlds.render import rays_of

from darswin.calibrate import lines

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "examples"))

from rooms import Room  # noqa: E402

ROOMS = "Stereographic"


def draw_rooms(name, count):
    """Pictures of rooms in place of the game's worlds; the last one is black."""
    rays = rays_of(study.lens_of(name), 2).astype(np.float32)
    rooms = [Room(np.random.default_rng(seed)) for seed in range(count - 1)]
    pictures = [np.mean([room.colors(rays[:, :, j]) for j in range(4)], 0) for room in rooms]
    return [picture.astype(np.uint8) for picture in [*pictures, np.zeros((*study.SIZE, 3))]]


@pytest.mark.slow
@pytest.mark.parametrize("name", study.LENSES)
def test_true_lenses_have_the_field_of_view_of_the_study(name):
    _, _, fov, circle = study.LENSES[name]
    lens = study.lens_of(name)
    radius = study.CIRCLE if circle else study.SIZE[1] / 2
    assert study.angle(lens, radius) == pytest.approx(math.radians(fov / 2))
    assert (lens.theta_max.item() < math.radians(101)) == circle or name == "Spherical, ξ = 0.3"
    off = np.abs(lens.center[0].numpy() - study.MIDDLE)
    assert 0 < off.max() < study.SHIFT and lens.image_size.tolist() == [[*study.SIZE]]


@pytest.mark.slow
def test_digits_need_the_true_lens():
    true = study.lens_of("Spherical, ξ = 0.8")
    digits = study.Digits(true)
    wrong = {name: digits.accuracy(lens) for name, lens in study.wrong_lenses(true).items()}
    assert digits.accuracy(true) > 92
    assert wrong["perspective"] < 80 and wrong["equidistant, 180°"] < 94


@pytest.mark.slow
def test_a_search_runs_once_for_some_curves_and_is_forgotten(monkeypatch):
    ran, search = [], lines._search

    def counted(of):
        ran.append(of)
        return search(of)

    monkeypatch.setattr(lines, "_search", counted)
    found = [study.curves(draw_rooms(ROOMS, 2)[0])]
    known = lines.from_curves(found, study.SIZE, "Division")
    with study.searching_once():
        results, lenses = study.estimates(found, None, study.lens_of(ROOMS))
    assert len(ran) == 2 and lenses.keys() == set(study.MODELS)
    assert results["Division"]["rim"] == pytest.approx(math.degrees(known.rim), rel=1e-9)
    assert [results["Division"]["low"], results["Division"]["high"]] == pytest.approx(
        np.degrees(known.interval)
    )
    assert lines._search is counted


@pytest.mark.slow
def test_a_study_of_one_lens(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "pictures_of", draw_rooms)
    monkeypatch.setattr(study, "run_all", in_this_process)
    study.main(["--lens", ROOMS, "--pictures", "2", "--results", str(tmp_path)])
    record = json.loads((tmp_path / "estimate.json").read_text())
    (of,) = record["lenses"]
    assert of["name"] == ROOMS and record["real"] == []
    assert abs(of["all"]["KannalaBrandt"]["error"]) < 5
    seen, black = of["single"]["Spherical"]
    assert "lines" in black["refused"] and seen["holds"] == (
        seen["low"] <= seen["true"] <= seen["high"]
    )
    assert of["digits"]["single"][1] is None and of["long"][0] > of["long"][1] == 0
    assert of["digits"]["estimated"]["KannalaBrandt"] > of["digits"]["wrong"]["perspective"]
    made = estimate_tables.tables(record)
    assert made["estimate single"].splitlines()[-1].startswith("| all |")
    assert made["estimate single"].splitlines()[-1].endswith("| 1 |")  # refused
    assert estimate_tables.tables(None) == dict.fromkeys(made, estimate_tables.NOT_RUN)


def test_tables_count_what_the_record_holds():
    def result(error, holds=True, doubts=()):
        return dict(true=50.0, rim=50.0, error=error, low=40.0, high=60.0, holds=holds,
                    doubts=list(doubts))  # fmt: skip

    good, bad, refused = result(-2.9), result(5.1, False, ["guess"]), dict(refused="too few")
    lens = dict(
        name="a lens", all=dict.fromkeys(estimate_tables.MODELS, good),
        single={model: [good, bad, refused] for model in estimate_tables.MODELS},
        long=[10, 9, 30],
        digits=dict(
            true=95.0, estimated=dict(Spherical=93.1, KannalaBrandt=92.9, Division=90.0),
            single=[94.0, 92.0, None], wrong=dict(guess=60.0),
        ),
    )  # fmt: skip
    all_bad = dict(Spherical=refused, KannalaBrandt=bad, Division=bad)
    record = dict(lenses=[lens], real=[dict(camera="left", pictures=3, all=all_bad)])
    made = estimate_tables.tables(record)
    assert made["estimate rims"].splitlines()[2:] == [
        "| a lens | 50.0 | -2.9 | -2.9 | -2.9 | 40.0–60.0 |"
    ]
    assert made["estimate single"].splitlines()[2:] == [
        f"| {name} | 4.0 | 4.0 | 4.0 | 1/3 | 1/1 | 1/2 | 1 |" for name in ("a lens", "all")
    ]
    assert made["estimate digits"].splitlines()[2:] == [
        "| a lens | 95.0 | 93.1 | 92.9 | 90.0 | 93.0 (92.0) | 60.0 |"
    ]
    assert made["estimate real"].splitlines()[2:] == [
        "| left | 3 | 50.0 | refused | +5.1 | +5.1 | 40.0–60.0 (no) | guess |"
    ]
    reached = [line.split(" | ")[-1] for line in made["estimate targets"].splitlines()[2:]]
    assert reached == ["1/1 |", "1/2 |", "1/1 |", "1/1 |", "1/2 |", "0/1 |"]
