"""The sizes study: its scenes, its views, and a few cells on a few pictures."""

import json
import math

import numpy as np
import pytest
import sizes
import sizes_tables
import torch
from helpers import in_this_process
from sizes_methods import METHODS, Measurer
from sizes_scene import (
    BALL,
    LEAST_PIXELS,
    LENSES,
    OWN,
    SIZE,
    lenses_of,
    pictures,
    rays_of,
    with_angles_scaled,
)

QUICK = ["--pictures", "4", "2", "--processes", "1", "--seeds", "1"]


@pytest.mark.slow
def test_a_ball_alone_has_the_angular_size_of_its_distance(monkeypatch):
    lens = LENSES["140°"]()
    monkeypatch.setattr("sizes_scene.DENSITY", 1e-9)  # one ball
    monkeypatch.setattr("sizes_scene.DISTANCES", (2.0, 2.0))
    for index in range(4):
        (image,), (distance,) = pictures("140°", 9, index, index + 1)
        known = distance > 0
        rays = rays_of(lens)[1::3, 1::3][known]
        # The nearest point of the ball is in the direction of its centre.
        middle = rays[distance[known].argmin()]
        assert distance[known].min() == pytest.approx(2.0 - BALL, abs=0.03)
        off = np.arccos((rays @ middle).clip(-1, 1)).max()
        assert off == pytest.approx(math.asin(BALL / 2.0), abs=0.06)
        assert image[known].mean() > image[~known].mean()


@pytest.mark.slow
def test_pictures_are_the_same_again_and_small_balls_are_unknown():
    images, distances = pictures(OWN, 5, 2, 4)
    again, _ = pictures(OWN, 5, 3, 4)
    assert (images[1] == again[0]).all() and (images[0] != images[1]).any()
    assert images.shape == (2, SIZE, SIZE, 3) and images.dtype == np.uint8
    known = distances > 0
    assert known.sum() >= LEAST_PIXELS and distances[known].min() > 0.6
    assert distances.max() < 6.0


def test_wrong_lenses_scale_the_angle_of_each_pixel():
    lens = lenses_of(OWN, 3)
    radii = torch.linspace(0, SIZE / 2, 20)[None, :-1]
    for factor in (0.8, 1.25):
        wrong = with_angles_scaled(lens, factor)
        torch.testing.assert_close(
            wrong.unproject(radii), factor * lens.unproject(radii), atol=2e-4, rtol=1e-3
        )


@pytest.mark.slow
def test_every_method_measures_through_every_lens():
    images = torch.from_numpy(pictures(OWN, 2, 0, 2)[0])
    for name, method in METHODS.items():
        model = Measurer(method).eval()
        results = []
        for lens in (lenses_of(OWN, 2), LENSES["perspective"](), LENSES["190°"]()):
            with torch.inference_mode():
                results.append(model(images, lens))
            assert results[-1].shape == (2, 1, SIZE, SIZE), name
            # Beyond the lens, an adapted model gives 0.
            assert results[-1].isfinite().all() and (results[-1] >= 0).all(), name
        assert torch.equal(results[0], results[1]) != method.uses_lens, name


@pytest.mark.slow
def test_cells_are_run_once_and_collected(tmp_path, monkeypatch):
    monkeypatch.setattr(sizes, "run_all", in_this_process)
    where = ["--out", str(tmp_path / "out"), "--results", str(tmp_path)]
    sizes.main([*where, *QUICK, "--cell", "raw-0"])
    (file,) = (tmp_path / "out" / "cells").iterdir()
    cell = json.loads(file.read_text())
    tested = {OWN, *LENSES, *sizes_tables.WRONG, sizes_tables.SHUFFLED}
    assert cell["label"] == "raw" and cell["sets"].keys() == tested
    assert all(0 <= found["delta1"] <= 1 for found in cell["sets"].values())
    # A wrong lens costs nothing without lens knowledge.
    assert all(cell["sets"][name] == cell["sets"][OWN] for name in sizes_tables.WRONG)
    sizes.main([*where, *QUICK, "--collect"])
    record = json.loads((tmp_path / "sizes.json").read_text())
    assert len(record["cells"]) == 1 and (tmp_path / "sizes_pictures.png").exists()
    made = sizes_tables.tables(record)
    assert [line.split(" | ")[0] for line in made["sizes losses"].splitlines()[2:]] == ["| raw"]
    assert sizes_tables.tables(None) == dict.fromkeys(made, sizes_tables.NOT_RUN)
    # Known cells are not run again; a record of other settings is refused.
    ran = []
    monkeypatch.setattr(sizes, "run_all", lambda work, jobs, *_: ran.extend(jobs) or [])
    known = ["--known", str(tmp_path / "sizes.json")]
    sizes.main([*where, *QUICK, *known])
    assert len([job for job in ran if isinstance(job[0], sizes.Cell)]) == len(METHODS) - 1
    with pytest.raises(ValueError, match="other settings"):
        sizes.main([*where, *QUICK[:1], "5", *QUICK[2:], *known])
    with pytest.raises(ValueError, match="other settings"):
        sizes.run_cell(sizes.Cell("raw"), tmp_path / "out", sizes.Settings(train=5, test=2))
