"""The dense study's own code, on a few small pictures: a minute's version of `make study-dense`."""

import json
import shutil
from pathlib import Path

import dense
import dense_data
import dense_tables
import numpy as np
import pytest
import torch
from dense_bounds import BOUNDS, bounds
from dense_cells import MODELS, STUDIED_MODELS, all_cells
from dense_trivial import trivial
from helpers import in_this_process
from worlds import wad
from worlds.lenses import draw_lens

from darswin import create_model
from darswin.data import open_scenes
from darswin.lens.pixels import pixel_rays

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (wad.FOLDER / "freedoom1.wad").exists(), reason="the game's files are not installed"
    ),
]

QUICK = """
    --pixels 32 --data.size 32 --pictures 4 1 2 --data.batch_size 2 --trainer.max_epochs 1
    --processes 2 --seeds 1
""".split()  # noqa: SIM905


@pytest.mark.parametrize("label", [label for label in STUDIED_MODELS if ", " in label])
def test_maps_show_all_of_the_pictures(label):
    family, (_, options) = MODELS[label]
    model = create_model(f"{family}_nano", task="distance", **json.loads(options))
    height, width = model.view.size
    assert abs(height * width / dense_data.SIZE**2 - 1) < 0.02
    for name in ("wide", "0", "0.2..0.35", "1"):
        lens = draw_lens(name, dense_data.SIZE, dense_data.FOV, np.random.default_rng(0))
        ones = torch.ones(1, 1, height, width)
        prepared = model.prepare(lens, (dense_data.SIZE,) * 2)
        rays = pixel_rays(lens, (dense_data.SIZE,) * 2)[0]
        seen = ~rays.isnan()
        shown = model.view.back(ones, prepared.view)[0][seen] > 0.5
        assert shown.float().mean() > 0.999 and seen.float().mean() > 0.7


@pytest.fixture(scope="module")
def quick(tmp_path_factory) -> Path:
    """A Swin-Unet and an adapted one, in the processes that `make study-dense` uses."""
    folder = tmp_path_factory.mktemp("dense")
    where = ["--out", str(folder / "out"), "--results", str(folder)]
    dense.main([*where, "--cell", "swin-unet-low", *QUICK])
    return folder


def found(folder: Path) -> dict[str, dict]:
    cells = folder.glob("out/nano/*/cell.json")
    return {path.parent.name: json.loads(path.read_text()) for path in cells}


def test_test_sets_show_the_same_scenes_and_controls_lie(quick):
    data = quick / "out" / "data"
    sets = {name: open_scenes(str(data / "test" / name), "test", "labels")
            for name in dense_data.test_sets()}  # fmt: skip
    stems = {name: [Path(s.file(k)).stem for k in range(len(s))] for name, s in sets.items()}
    assert len({tuple(names) for names in stems.values()}) == 1 and len(stems["xi-0"]) == 2
    true, told = sets["xi-1"][0], sets["wrong-1"][0]
    assert (true.image == told.image).all()
    assert true.lens.xi.item() == 1 and told.lens.xi.item() == pytest.approx(0.275)
    one, other = (sets[f"{kind}band-low"] for kind in ("", "shuffled-"))
    xi = [[scenes[k].lens.xi.item() for k in range(2)] for scenes in (one, other)]
    assert xi[0] == xi[1][::-1] and xi[0][0] != xi[0][1]


@pytest.fixture
def here(monkeypatch, threads):
    """Jobs run one after the other in this process, as `make study-dense` runs them in others."""
    threads(1)
    for program in (dense, dense_data):
        monkeypatch.setattr(program, "run_all", in_this_process)


def test_cells_are_trained_and_tested_once(quick, here, capsys):
    cells = found(quick)
    tasks = ("segmentation", "distance")
    models = ("swin-unet", "lensadapter-swin-unet")
    assert cells.keys() == {f"{name}-low-{task}-0" for name in models for task in tasks}
    for cell in cells.values():
        assert cell["sets"].keys() == set(dense_data.test_sets())
        scores = [row[dense_tables.SCORE[cell["task"]]] for row in cell["sets"].values()]
        assert all(0 <= score <= 1 for score in scores)
    # A study that was stopped reads what it has; a cell that is run again finds the same.
    shutil.rmtree(quick / "out" / "nano" / "swin-unet-low-segmentation-0")
    capsys.readouterr()
    where = ["--out", str(quick / "out"), "--results", str(quick)]
    dense.main([*where, "--cell", "swin-unet-low-seg", *QUICK])
    results = json.loads(capsys.readouterr().out.split("cells after", 1)[1].split("\n", 1)[1])
    before = {(cell["label"], cell["task"]): cell["sets"] for cell in cells.values()}
    assert len(results) == 2
    assert all(cell["sets"] == before[cell["label"], cell["task"]] for cell in results)
    # With other options it says so, and mixes nothing.
    with pytest.raises(ValueError, match=r"was made with other settings \(arguments\)"):
        dense.main([*where, "--cell", "swin-unet-low-seg", *QUICK, "--data.flip", "false"])


def test_tables_and_pictures(quick):
    cells = list(found(quick).values())
    blind, oracle = trivial(quick / "out"), bounds(quick / "out")
    record = dense_tables.collect(cells, blind, oracle, dense.CONFIG.read_text(), "nano")
    dense_tables.publish(record, quick / "out", quick)
    for name in ("dense.png", "dense_segmentation.png", "dense_distance.png"):
        assert (quick / name).read_bytes().startswith(b"\x89PNG")
    record = json.loads((quick / "dense.json").read_text())
    made = dense_tables.tables(record, quick)
    lines = made["dense segmentation low"].splitlines()
    assert any(line.startswith("| Swin-Unet |") and "not run" not in line for line in lines)
    assert any(line.startswith("| by direction alone |") for line in lines)
    assert "dense segmentation wide" not in made
    # With the true heights, the floors and ceilings of most rooms are exact.
    of_set = {name: record["bounds"][name]["xi-0"]["delta1"] for name in BOUNDS}
    others = [blind["distance"]["direction"]["xi-0"]["delta1"], of_set["gravity"], of_set["labels"]]
    assert of_set["heights"] > max(others)
    assert "| gravity, known exactly |" in made["dense distance low"]
    assert made["dense curves"].startswith("![")
    assert "60° to the rim" in made["dense distance low zones"]
    missing = dense_tables.tables(record, quick / "none")
    assert missing["dense curves"] == dense_tables.NOT_RUN


def test_cells_of_a_record_are_not_run_again(quick, here, tmp_path):
    cells = list(found(quick).values())
    blind, oracle = trivial(quick / "out"), bounds(quick / "out")
    record = dense_tables.collect(cells[:3], blind, oracle, dense.CONFIG.read_text(), "nano")
    (tmp_path / "known.json").write_text(json.dumps(record))
    ran = []
    where = ["--out", str(quick / "out"), "--results", str(tmp_path)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dense, "run_all", lambda work, jobs, *rest: ran.extend(jobs) or [])
        dense.main([*where, "--known", str(tmp_path / "known.json"), *QUICK])
    assert len(ran) == len(all_cells(1)) - 3
    assert len(json.loads((tmp_path / "dense.json").read_text())["cells"]) == 3
    # What is there is collected, and nothing is run.
    dense.main([*where, "--collect", *QUICK])
    assert len(json.loads((tmp_path / "dense.json").read_text())["cells"]) == 4
    for other, message in (
        (dict(config="max_epochs: 9"), "was made with another configuration"),
        (dict(cameras=["another"]), r"must have the cameras .*, got \['another'\]"),
    ):
        (tmp_path / "known.json").write_text(json.dumps(record | other))
        with pytest.raises(ValueError, match=message):
            dense.main([*where, "--known", str(tmp_path / "known.json"), *QUICK])
