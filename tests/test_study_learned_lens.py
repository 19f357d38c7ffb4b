"""The code that learns lenses, on digits: seconds of `make learned-lens`."""

import json
import math
from pathlib import Path

import learned_lens
import learned_tables
import pytest
import torch

from darswin import create_model
from darswin.models.saving import ModelCard, save_model

SMALL = dict(
    IMAGES=dict(xi=(4, 8), place=(8,), all=(8,)), STEPS=dict(xi=2, place=2, all=2), BATCH=4,
    TESTED=5, SEARCHED=6, USUAL=8, GRID=[0.0, 0.5, 1.0],
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def small():
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SMALL.items():
            patch.setattr(learned_lens, name, value)
        patch.setattr(learned_tables, "IMAGES", SMALL["IMAGES"])
        patch.setattr(learned_tables, "GRID", SMALL["GRID"])
        yield


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """What pretraining leaves, but for a model that was not trained."""
    out = tmp_path_factory.mktemp("learned-lens")
    torch.manual_seed(0)
    options = dict(num_classes=10, in_chans=1)
    model = create_model("darswin_a_nano", **options).eval()
    card = ModelCard("darswin_a_nano", options)
    save_model(out / "model" / "checkpoints" / "last.safetensors", model.state_dict(), card)
    torch.save(list(learned_lens.usual_map(model, "digits")), out / "usual.pt")
    return out


def test_the_distance_of_two_lenses():
    lens, moved = (learned_lens.lens_of(learned_lens.KNOWN | dict(x=x)) for x in (15.5, 18.5))
    assert learned_lens.distance(lens, lens) == 0
    assert learned_lens.distance(moved, lens) == pytest.approx(3, abs=1e-4)


@pytest.mark.slow
def test_a_camera_is_searched_for_in_every_way_and_tables_are_made(out, tmp_path):
    cameras = [learned_lens.run_camera(name, 0, out, "digits") for name in learned_lens.PROBLEMS]
    for camera in cameras:
        problem = camera["problem"]
        assert camera["true"]["distance"] == 0 and camera["true"]["focal"] == 0
        kinds = {(t["loss"], t["images"]) for t in camera["trials"]}
        counts = SMALL["IMAGES"][problem]
        assert kinds == {(loss, n) for loss in learned_lens.LOSSES for n in counts}
        assert len(camera["trials"]) == len(kinds) * learned_lens.STARTS
        for trial in camera["trials"]:
            found, start = trial["found"]["values"], trial["start"]["values"]
            assert all(found[name] != start[name] for name in learned_lens.PROBLEMS[problem])
            assert math.isfinite(trial["least"])
            for name in found.keys() & learned_lens.BOUNDS:
                low, high = learned_lens.BOUNDS[name]
                assert low <= found[name] <= high
    # What was found is read, not found again.
    assert learned_lens.run_camera("xi", 0, out, "nowhere") == cameras[0]
    learned_tables.collect(cameras, tmp_path)
    assert (tmp_path / "learned_lens.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "learned_lens.json").read_text())["cameras"] == cameras
    made = learned_tables.tables(cameras)
    rows = made["learned-lens"].splitlines()
    assert len(rows) == 2 + 3 * len(learned_lens.LOSSES) and "of 2 |" in rows[2]
    assert len(made["learned-xi"].splitlines()) == 2 + len(learned_lens.LOSSES)
