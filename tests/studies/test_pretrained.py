"""The study of pretrained detectors: what is decoded, its scenes, and the whole on made-up
photographs with a made-up detector."""

import json
import math
import zlib
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pretrained
import pretrained_crops
import pretrained_graphs
import pretrained_methods
import pretrained_people
import pretrained_scenes
import pretrained_scores
import pretrained_tables
import pytest
import torch
from helpers import in_this_process
from pretrained_files import CLASSIFIER, MODELS, PANORAMAS, STAMPS, VIDEO, Files
from pretrained_graphs import DETECTORS, FOUND, export
from pretrained_methods import Look, slices, tiles
from pretrained_scenes import CLASSES, SIZE, SPLITS, Scene
from torch import nn

from darswin import boxes


class Outputs(nn.Module):
    """In place of a graph: what it gives for any image of 64 × 96 pixels."""

    def __init__(self, outputs: list[torch.Tensor]) -> None:
        super().__init__()
        self.outputs = outputs

    def forward(self, image):
        return [of + 0 * image.sum() for of in self.outputs]


def one_thing(name: str) -> tuple[list[torch.Tensor], list[float]]:
    """The outputs of a network that finds a thing of the class 7 in two cells, of which the second
    is worse; and the box of the first, 3 cells to the right."""
    if name == "CenterNet":
        heat, sides = torch.zeros(1, 16, 24, 80), torch.zeros(1, 16, 24, 4)
        heat[0, 2, 3, 7], heat[0, 3, 4, 7] = 0.9, 0.8
        sides[0, 2, 3] = torch.tensor([5.0, 6, 7, 8])
        return [heat, sides], [12 - 5, 8 - 6, 12 + 7, 8 + 8]
    scores, spreads = (
        [torch.zeros(1, count, 64 // stride, 96 // stride) for stride in (8, 16, 32)]
        for count in (80, 44)
    )
    scores[1][0, 7, 1, 3], scores[1][0, 7, 2, 3] = 0.9, 0.8
    spreads[1][0, [1, 11 + 2, 22 + 3, 33 + 4], 1:3, 3] = 100  # distances of 1, 2, 3 and 4 cells
    return scores + spreads, [56 - 16, 24 - 32, 56 + 48, 24 + 64]


@pytest.mark.slow
@pytest.mark.parametrize("name", DETECTORS)
def test_decoding_is_in_the_graph_of_the_network(tmp_path, monkeypatch, name):
    outputs, box = one_thing(name)
    monkeypatch.setattr(pretrained_graphs, "Graph", lambda *_: Outputs(outputs))
    network, images = DETECTORS[name](tmp_path).eval(), torch.zeros(1, 3, 64, 96)
    boxes_found, scores, labels = (of[0] for of in network(images))
    assert boxes_found[0].tolist() == pytest.approx(box, abs=1e-3) and labels[0] == 7
    assert scores.tolist() == pytest.approx([0.9] + [0] * (FOUND - 1))
    network.body = Outputs([torch.rand(of.shape) for of in outputs])
    export(network, (64, 96), tmp_path / "detector.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "detector.onnx"))
    assert [of.name for of in session.get_outputs()] == ["boxes", "scores", "labels"]
    exported = session.run(None, {"images": images.numpy()})
    kept = exported[1] > 0  # detections without a score have no order
    for found, expected in zip(exported, network(images), strict=True):
        np.testing.assert_allclose(found[kept], expected.numpy()[kept], atol=1e-3)
    (found,), (scores,), (labels,) = exported
    assert (np.diff(scores) <= 0).all() and scores[0] > 0.9
    for label in set(labels) if name == "NanoDet" else ():  # two of a class do not overlap
        own = found[(labels == label) & (scores > 0)].astype(float)
        assert (boxes.iou(own, own) - np.eye(len(own))).max() <= 0.6


# -- made-up photographs, and scenes of them ----------------------------------------------------


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


class White:
    """A detector of white things; it finds none at the border, where tiles cut them."""

    mean, std, side, name = (0.0,), (1.0,), 512, "white"

    def normalised(self, image):
        return image.transpose(2, 0, 1).astype(np.float32) / 255

    def __call__(self, image):
        *_, rows, _ = cv2.connectedComponentsWithStats((image[0] > 0.5).astype(np.uint8))
        x, y, width, height = rows[1:, :4].T
        found = np.stack((x, y, x + width, y + height), 1).astype(float)
        found = found[((found > 1) & (found < np.array(image.shape[:0:-1] * 2) - 1)).all(1)]
        return found, np.full(len(found), 0.9), np.zeros(len(found), int)


LOOKS = Look("raw"), Look("mercator"), Look("square"), tiles(5), slices(2, 576), slices(3, 410)


@pytest.mark.slow
@pytest.mark.parametrize("look", LOOKS, ids=lambda look: f"{look.view} {look.options}")
def test_detections_come_back_to_the_picture(made_up, look):
    scene, picture = Scene(Files(made_up), "level", 0), np.zeros((SIZE, SIZE, 3), np.uint8)
    truth = np.array([[480, 480, 540, 540], [700, 500, 760, 560], [300, 200, 360, 260.0]])
    for x, y in truth[:, :2].astype(int) + 30:
        cv2.circle(picture, (x, y), 30, (255, 255, 255), -1)
    found = pretrained_methods.merged([pretrained_methods.detect(look, scene, picture, White())])
    assert len(found.boxes) == 3
    assert (boxes.iou(truth, found.boxes.astype(float)).max(1) > 0.7).all()


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
