"""Runs that start from a trained model."""

from dataclasses import replace

import pytest
import torch
from helpers import refused
from lens_pictures import WOODSCAPE, write_frames
from runs import DIGITS, QUIET, assert_same, checkpoint, error, fit, killed_fit, test
from safetensors.torch import load_file

from darswin import create_model
from darswin.lens import Equidistant, save
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.train.classification import Classification
from darswin.train.finetuning import (
    check_name,
    frozen_parts,
    name_from,
    settle,
    start_from,
    weights_file,
)

STILL = """--model.learning_rate 1e-12 --model.warmup_rate 0 --model.final_rate 0
    --trainer.max_steps 1 --trainer.logger false""".split()  # noqa: SIM905
SMALL = dict(embed_dim=8, depths=[1, 1, 1], rings=8, sectors=32, samples=[2, 2])
CARD = ModelCard("darswin_a_nano", dict(num_classes=3, in_chans=1, mean=[0.4], std=[0.2],
                 spacing="tan"), list("abc"), 32)  # fmt: skip
NONE = dict(size=None, channels=None, mean=None, std=None)


def weights_of(run, name="last"):
    return load_file(run / "checkpoints" / f"{name}.safetensors")


def close(a, b):
    return torch.allclose(a, b, rtol=1e-5, atol=1e-8)


@pytest.fixture(scope="module")
def classifier(tmp_path_factory):
    """A classifier of 32 px with weights that no new model has."""
    file = tmp_path_factory.mktemp("models") / "classifier.safetensors"
    options = dict(num_classes=4, in_chans=3, mean=[0.4] * 3, std=[0.2] * 3, **SMALL)
    card = ModelCard("darswin_a_nano", options, list("abcd"), 32)
    save_model(file, card.create().state_dict(), card)
    return file


@pytest.mark.slow
@pytest.mark.products
def test_fine_tuning_beats_a_fresh_start(tmp_path):
    data = write_frames(tmp_path / "frames", count=900, classes="012345")
    base, minutes = tmp_path / "base", ["--config", "minutes", "--data.size", "32"]
    fit(base, *minutes, "--data.path", data, "--data.lens", WOODSCAPE, *QUIET,
        "--trainer.max_epochs", "12")  # fmt: skip
    # Other digits, of another camera. After 3 epochs the lead is within the seeds' span.
    lens = tmp_path / "lens.json"
    save(Equidistant(38.0, 1.5, image_size=(121, 160)), lens)
    others = [
        *("--data.path", write_frames(tmp_path / "others", lens, 600, classes="1234567")),
        *("--data.lens", lens, "--data.batch_size", "16", "--data.holdout", "0.4"),
        *("--trainer.max_epochs", "6", "--model.warmup_epochs", "0", "--model.mixup", "0"),
        *("--model.cutmix", "0", "--data.randaugment", "false", "--data.erasing", "0"),
        *("--model.learning_rate", "3e-3", "--model.reference_batch", "48", *QUIET),
    ]
    tuned, fresh = tmp_path / "tuned", tmp_path / "fresh"
    fit(tuned, *others, "--model.weights", base, "--model.freeze_stages", "1")
    fit(fresh, *others, *minutes)
    card = load_model(tuned / "checkpoints" / "last.safetensors")[1]
    assert (card.model, card.size, card.options["in_chans"]) == ("darswin_a_nano", 32, 1)
    assert test(tuned)[0]["top1"] > test(fresh)[0]["top1"] + 0.1


@pytest.mark.slow
def test_the_head_stays_with_its_classes(whole, labelled, scenes, tmp_path):
    digits = ["--data.path", "digits", "--data.limit", "16", "--data.train_lenses", "low"]
    pixels = ["--task", "segmentation", "--data.path", scenes]
    names = {"digits": "9876543210", "pixels": ["sky", "wall", "ground"]}
    for run, options, order in ((whole, digits, "digits"), (labelled, pixels, "pixels")):
        file = tmp_path / f"{order}.txt"
        file.write_text("\n".join(names[order]))
        before = weights_of(run, "best")
        given = [*options, *STILL, *QUIET, "--data.batch_size", "8", "--model.weights", run]
        given += ["--seed_everything", "1"]  # else a new head begins as the one before did
        fit(tmp_path / order / "same", *given)
        fit(tmp_path / order / "other", *given, "--data.classes", file)
        same, other = (weights_of(tmp_path / order / name) for name in ("same", "other"))
        assert all(close(before[name], same[name]) for name in before)
        changed = {name for name in before if not close(before[name], other[name])}
        assert changed and all("head." in name for name in changed)


def test_a_classifier_gives_its_encoder(classifier, scenes, tmp_path):
    options = ["--data.path", scenes, "--data.limit", "8", "--data.batch_size", "4", *QUIET, *STILL]
    run = tmp_path / "run"
    fit(run, "--task", "segmentation", *options, "--model.weights", classifier)
    before, after = load_file(classifier), weights_of(run)
    taken = [name for name in before if not name.startswith("head.")]
    assert len(taken) > 20
    assert all(close(before[name], after[f"encoder.{name}"]) for name in taken)
    assert after["segmentation_head.proj.weight"].shape[0] == 3
    # Then for another task, with the segmentation's decoder and a new head.
    fit(tmp_path / "other", "--task", "distance", *options, "--model.weights", run)
    again = weights_of(tmp_path / "other")
    kept = [name for name in after if not name.startswith("segmentation_head.")]
    assert all(close(after[name], again[name]) for name in kept)
    assert any(name.startswith("distance_head.") for name in again)


@pytest.mark.slow
def test_a_resumed_run_does_not_read_the_weights_again(classifier, scenes, tmp_path, monkeypatch):
    weights = tmp_path / "m.safetensors"
    weights.write_bytes(classifier.read_bytes())
    start = [
        *("--task", "segmentation", "--data.path", scenes, "--data.limit", "16", *QUIET),
        *("--data.batch_size", "4", "--trainer.max_epochs", "2", "--checkpoint_steps", "1"),
        *("--model.weights", weights, "--model.freeze_stages", "1"),
        *("--model.learning_rate", "1e-2", "--model.reference_batch", "8"),
    ]
    fit(tmp_path / "whole", *start)
    run = tmp_path / "killed"
    killed_fit(monkeypatch, run, 6, *start)
    weights.unlink()
    fit(run, "--resume")
    assert_same(run, tmp_path / "whole")
    before, after = load_file(classifier), weights_of(run)
    frozen = [n for n in before if n.startswith(("patch_embed.", "stages.0."))]
    assert len(frozen) > 8 and all(torch.equal(before[n], after[f"encoder.{n}"]) for n in frozen)
    trained = [n for n in before if n not in frozen and not n.startswith("head.")]
    assert any(not torch.equal(before[n], after[f"encoder.{n}"]) for n in trained)
    optimizer = checkpoint(run)["optimizer_states"][0]
    count = sum(len(group["params"]) for group in optimizer["param_groups"])
    assert len(optimizer["state"]) == count == len(after) - len(frozen)
    assert test(run)[0]["pixels"] > 0  # nor does a test


def test_all_stages_frozen_train_the_head_alone(classifier):
    task = Classification("darswin_a_nano", weights=str(classifier), freeze_stages=3)
    task.net = net = load_model(classifier)[0].requires_grad_(True)
    task._freeze()
    names = {name for name, p in net.named_parameters() if p.requires_grad}
    assert names == {"head.weight", "head.bias"}
    task.train()
    assert net.head.training and not net.stages[2].training and not net.patch_embed.training
    assert {name for name, m in net.named_children() if m.training} <= {"head", "stages"}


HEAD = {"stages", "norm", "head"}


@pytest.mark.parametrize(
    ("card", "stages", "parts"),
    [
        (ModelCard("darswin_ra_nano"), 1, HEAD),
        (ModelCard("swin_nano", {"image_size": 32}), 1, HEAD),
        (ModelCard("swin_nano", {"image_size": 32, "view": "mercator"}), 1, HEAD),
        (ModelCard("dat_nano", {"image_size": 32}), 1, HEAD),
        (ModelCard("darswin_unet_a_nano", SMALL), 3, {"decoder", "places", "segmentation_head"}),
    ],
)
def test_a_model_freezes_what_stands_before_its_stages(card, stages, parts):
    net = card.create()
    frozen = {id(p) for module in frozen_parts(net, stages) for p in module.parameters()}
    trained = {n.split(".")[0] for n, p in net.named_parameters() if id(p) not in frozen}
    assert trained == parts and not frozen_parts(net, 0)
    of_net = getattr(net, "encoder", net).stages
    assert all(id(p) in frozen for p in of_net[0].parameters())
    for wrong in (-1, len(of_net) + 1):
        said = f"the model's {len(of_net)} stages, got {wrong}"
        refused(said, frozen_parts, net, wrong)


def test_options_not_given_are_the_model_s():
    model, data = settle(CARD, "w", "classification", dict(name=None, options={"jitter": 0}), NONE)
    assert model == {"name": "darswin_a_nano", "options": {"spacing": "tan", "jitter": 0}}
    assert data == {"size": 32, "channels": 1, "mean": [0.4], "std": [0.2]}
    assert settle(CARD, "w", "classification", model, data) == (model, data)
    assert settle(CARD, "w", "classification", model, NONE | {"size": 64})[1]["size"] == 64
    own = dict(name=None, options={"typical_distance": 3.0})
    model, data = settle(CARD, "w", "distance", own, NONE)
    assert model["name"] == "darswin_unet_a_nano" and data["channels"] == 1
    # The Unet of this size has other depths.
    assert model["options"] == {"depths": (1, 2, 1), "spacing": "tan", "typical_distance": 3.0}
    encoder = create_model(model["name"], task="distance", **model["options"]).encoder
    classifier = create_model(CARD.model, num_classes=0)
    assert encoder.state_dict().keys() == classifier.state_dict().keys()


SQUARE = replace(CARD, options={**CARD.options, "image_size": 32})


@pytest.mark.parametrize(
    ("card", "task", "model", "data", "message"),
    [
        (CARD, "classification", dict(name="swin_nano"), {}, "`name` swin_nano"),
        (CARD, "classification", dict(options={"spacing": "g"}), {}, "`options` {'spacing': 'g'}"),
        (CARD, "distance", dict(options={"spacing": "theta"}), {}, "`options` {'spacing': 'theta'"),
        (CARD, "classification", {}, dict(channels=3), "`channels` 3"),
        (CARD, "classification", {}, dict(mean=[0.1]), r"`mean` \[0.1\]"),
        (SQUARE, "classification", {}, dict(size=64), "`size` 64"),
    ],
)
def test_options_that_disagree_are_named(card, task, model, data, message):
    model = dict(name=None, options=None) | model
    said = f"^{message}.* disagrees with `weights` w, whose model"
    refused(said, settle, card, "w", task, model, NONE | data)


def test_which_model_starts_from_which():
    classifiers = {"darswin_ra_tiny": "darswin_unet_ra_tiny", "swin_micro": "swin_unet_micro"}
    for name, dense in classifiers.items():
        assert name_from(ModelCard(name), "distance") == dense
        assert name_from(ModelCard(dense, task="distance"), "segmentation") == dense
    dense = ModelCard("swin_unet_nano", task="segmentation")
    for card, task in ((ModelCard("dat_nano"), "segmentation"), (dense, "classification")):
        said = rf"no model for {task} can start from a {card.model}"
        refused(said, name_from, card, task)
    check_name("swin_unet_nano", "distance")
    said = "no model for `task` classification; did you mean "
    refused(said, check_name, "swin_unet_nano", "classification")


def test_weights_that_start_nothing(classifier, tmp_path, capsys):
    refused("there is no model in", weights_file, tmp_path, error=FileNotFoundError)
    start = ["fit", "--run", tmp_path / "run", *DIGITS, "--model.name", "darswin_a_micro"]
    message = error(capsys, *start, "--model.weights", classifier)
    assert "--model.name darswin_a_micro disagrees with --model.weights" in message
    assert not (tmp_path / "run").exists()
    other = replace(CARD, options=CARD.options | {"embed_dim": 12})
    save_model(tmp_path / "b.safetensors", other.create().state_dict(), other)
    larger = ModelCard("darswin_unet_a_nano", {**SMALL, "embed_dim": 16})
    for card, weights in ((CARD, tmp_path / "b.safetensors"), (larger, classifier)):
        said = "holds the weights of another model"
        refused(said, start_from, card.create(), ["a", "b"], weights)
