"""The study of pretrained detectors: its scenes, and the whole with a made-up detector."""

import json
import math
import zlib
from pathlib import Path

import cv2
import numpy as np
import pretrained
import pretrained_crops
import pretrained_methods
import pretrained_people
import pretrained_scenes
import pretrained_scores
import pretrained_tables
import pytest
import torch
from helpers import in_this_process
from pretrained_files import CLASSIFIER, MODELS, PANORAMAS, STAMPS, VIDEO, Files
from pretrained_methods import slices
from pretrained_scenes import CLASSES, SPLITS, Scene
from torch import nn


@pytest.fixture(scope="module")
def made_up(tmp_path_factory) -> Path:
    """A folder with photographs, panoramas and a video of the study's names."""
    out, rng = tmp_path_factory.mktemp("pretrained"), np.random.default_rng(4)
    files = out / "files"
    for name in " ".join(CLASSES.values()).split():
        image = rng.integers(0, 256, (*rng.integers(20, 60, 2), 4), np.uint8)
        image[..., 3] = 255
        image[:2], image[:, :3] = 0, 0  # an empty margin
        (files / STAMPS / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(files / STAMPS / f"{name}.png"), image)
    for name in PANORAMAS:
        cv2.imwrite(str(files / f"{name}.png"), rng.integers(0, 256, (32, 64, 3), np.uint8))
    for name in (VIDEO, CLASSIFIER, f"{MODELS}/none"):
        (files / name).parent.mkdir(parents=True)
    torch.save({}, files / CLASSIFIER)
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(files / VIDEO), codec, 10, (96, 64))
    for _ in range(pretrained_people.STEP + 1):
        writer.write(rng.integers(0, 256, (64, 96, 3), np.uint8))
    writer.release()
    return out


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_scenes_are_the_same_again_with_exact_boxes(made_up, split, monkeypatch):
    monkeypatch.setattr(pretrained_scenes, "SIZE", 256)
    monkeypatch.setattr(pretrained_scenes, "_rays", {})
    files, kind = Files(made_up), SPLITS[split]
    for index in range(len(kind.lenses)):
        scene = Scene(files, split, index)
        picture = scene.render()
        assert (Scene(files, split, index).render() == picture).all()
        assert picture.shape == (256, 256, 3) and len(scene.things) == kind.things
        for thing in scene.things:
            board = scene.board(thing)
            assert kind.thetas[0] <= thing.theta_deg <= kind.thetas[1]
            assert abs(board.right @ scene.up) < 1e-12 and board.down @ scene.up < 0
            # Another way to its box: the border of the photograph through the lens.
            sides = np.linspace(-1, 1, 200)
            border = np.concatenate([np.stack((sides, np.full(200, end)), 1) for end in (-1, 1)])
            border = np.concatenate((border, border[:, ::-1])) * board.half
            rays = board.direction + border @ np.stack((board.right, board.down))
            points = scene.lens.project_points(torch.from_numpy(rays)[None], (256, 256))[0].numpy()
            if np.isnan(points).any() or points.min() < 0 or points.max() > 255:
                continue  # the lens cuts it
            box = np.concatenate((points.min(0), points.max(0))) + 0.5
            assert np.abs(box - thing.box).max() < 1.5
    flat, box = scene.flat(scene.things[0])
    assert flat.shape == (512, 512, 3) and np.abs((box[:2] + box[2:]) / 2 - 256).max() < 1.5
    longer = 2 * math.atan((box[2:] - box[:2]).max() / 512)
    assert longer == pytest.approx(scene.things[0].size, abs=0.02)


def somewhere(_, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Detections somewhere in an image, always the same ones."""
    rng = np.random.default_rng(zlib.crc32(image.tobytes()))
    corners = rng.uniform(0, image.shape[1] / 2, (40, 2))
    found = np.concatenate((corners, corners + rng.uniform(20, 99, (40, 2))), 1)
    return found, rng.uniform(0.1, 1, 40), rng.integers(80, size=40)


class Colour(nn.Module):
    """In place of the classifier of crops."""

    def __init__(self, weights: dict) -> None:
        super().__init__()

    def forward(self, images):
        return images.mean((2, 3))


@pytest.mark.slow
@pytest.mark.products
def test_the_study_runs_once_and_is_collected_again(made_up, tmp_path, monkeypatch):
    few = {name: pretrained_methods.LEVEL_METHODS[name] for name in ("raw", "mercator", "tiles: 5")}
    splits = "level", "small", "down", "perspective"
    raw = dict(raw=few["raw"])
    studied = {("CenterNet", split): few for split in splits}
    studied |= {("CenterNet", "perspective"): raw, ("NanoDet", "level"): raw}
    sliced = {"slices: 4, and raw": (slices(2, 576), few["raw"][0]), "tiles: 5": few["tiles: 5"]}
    for name, value in dict(
        STUDIED=studied, SLICED=dict.fromkeys(pretrained_methods.SLICED, sliced),
        PEOPLE_METHODS=few, LEVEL_METHODS=few, PEOPLE=1, REPEATS=1, run_all=in_this_process,
        SCENES={split: (0, 2 if split == "level" else 1) for split in splits},
    ).items():  # fmt: skip
        monkeypatch.setattr(pretrained, name, value)
    monkeypatch.setattr(pretrained_scores, "DRAWS", 50)
    monkeypatch.setattr(pretrained_crops, "Classifier", Colour)
    monkeypatch.setattr(pretrained_methods.Detector, "__call__", somewhere)
    with pytest.raises(FileNotFoundError, match=r"run `python studies/pretrained_files\.py --out"):
        pretrained.main(["--out", str(tmp_path)])
    where = ["--out", str(made_up), "--results", str(tmp_path)]
    pretrained.main(where)
    record = json.loads((tmp_path / "pretrained.json").read_text())
    level = record["tables"]["CenterNet, level"]
    assert level["scenes"] == 2 and level["things"] == 12
    assert [of["runs"] for of in level["methods"].values()] == [1, 1, 5]
    for table in record["tables"].values():
        for of in table["methods"].values():
            low, high = of["map_interval"]
            assert 0 <= low <= high <= 1 and 0 <= of["recall"] <= 1
    of_slices = record["slices"]["level"]
    assert [of["runs"] for of in of_slices["methods"].values()] == [5, 5]
    assert of_slices["methods"]["tiles: 5"]["map"] == level["methods"]["tiles: 5"]["map"]
    # What is there is collected again, without any network on scenes.
    monkeypatch.setattr(pretrained_methods, "detect", lambda *_: pytest.fail("they were there"))
    pretrained.main([*where, "--collect"])
    again = json.loads((tmp_path / "pretrained.json").read_text())
    assert all(again[name] == record[name] for name in ("tables", "pairs", "slices"))
    pretrained.main([*where, "--speed"])
    timed = json.loads((tmp_path / "pretrained.json").read_text())
    assert timed["tables"] == record["tables"] and timed["speed"].keys() == few.keys()
    made = pretrained_tables.tables(timed)
    assert "| mercator | 1 |" in made["pretrained level"]
    assert "mercator − raw" in made["pretrained level pairs"]
    assert "tiles: 5 − slices: 4, and raw" in made["pretrained slices level pairs"]
    missing = pretrained_tables.tables(None)
    assert missing == dict.fromkeys(made, pretrained_tables.NOT_RUN)
