"""Dense runs that start from a trained model: a dense one, or a classifier of the same encoder."""

import pytest
import torch
from runs import error, fit
from safetensors.torch import load_file
from scenes import write_plain

from darswin.models.saving import ModelCard, save_model
from darswin.train.finetuning import frozen_parts, name_from, settle, start_from

SMALL = dict(embed_dim=8, depths=[1, 1, 1], rings=8, sectors=32, samples=[2, 2])
NONE = dict(size=None, channels=None, mean=None, std=None)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_plain(tmp_path_factory.mktemp("data") / "scenes", 24, size=(45, 60))


@pytest.fixture(scope="module")
def classifier(tmp_path_factory):
    """A classifier of 32 px with weights that no new model has."""
    file = tmp_path_factory.mktemp("models") / "classifier.safetensors"
    options = dict(num_classes=4, in_chans=3, mean=[0.4] * 3, std=[0.2] * 3, **SMALL)
    card = ModelCard("darswin_a_nano", options, list("abcd"), 32)
    save_model(file, card.create().state_dict(), card)
    return file


def started(data, weights, run, *options, task="segmentation", steps=1):
    still = [
        "--model.learning_rate",
        "1e-12",
        "--model.warmup_rate",
        "0",
        "--model.final_rate",
        "0",
    ]
    fit(run, "--task", task, "--data.path", str(data), "--model.weights", str(weights), *still,
        "--data.workers", "0", "--data.batch_size", "4", "--trainer.max_steps", str(steps),
        "--trainer.enable_progress_bar", "false", "--trainer.enable_model_summary", "false",
        "--trainer.logger", "false", *options)  # fmt: skip
    return load_file(run / "checkpoints" / "last.safetensors")


def close(a, b):
    return torch.allclose(a, b, rtol=1e-5, atol=1e-8)


def test_a_classifier_gives_its_encoder(data, classifier, tmp_path):
    before = load_file(classifier)
    after = started(data, classifier, tmp_path / "run")
    taken = [name for name in before if not name.startswith("head.")]
    assert len(taken) > 20
    assert all(close(before[name], after[f"encoder.{name}"]) for name in taken)
    assert after["segmentation_head.proj.weight"].shape[0] == 3
    # Then for another task, with the segmentation's decoder and a new head.
    again = started(data, tmp_path / "run", tmp_path / "other", task="distance")
    kept = [name for name in after if not name.startswith("segmentation_head.")]
    assert all(close(after[name], again[name]) for name in kept)
    assert any(name.startswith("distance_head.") for name in again)


def test_the_head_stays_with_its_classes(data, classifier, tmp_path):
    before = started(data, classifier, tmp_path / "before")
    same = started(data, tmp_path / "before", tmp_path / "same", "--seed_everything", "1")
    assert all(close(before[name], same[name]) for name in before)
    names = tmp_path / "names.txt"
    names.write_text("sky\nwall\nground\n")
    seed = ["--seed_everything", "1"]  # else a new head begins as the one before did
    options = ["--data.classes", str(names), *seed]
    other = started(data, tmp_path / "before", tmp_path / "other", *options)
    changed = {name for name in before if not close(before[name], other[name])}
    assert changed and all(name.startswith("segmentation_head.") for name in changed)


def test_frozen_stages_stay_as_they_are(data, classifier, tmp_path):
    rates = ["--model.learning_rate", "1e-2", "--model.warmup_epochs", "0"]
    options = ["--model.freeze_stages", "1", *rates]
    after = started(data, classifier, tmp_path / "run", *options, steps=2)
    before = load_file(classifier)
    frozen = [n for n in before if n.startswith(("patch_embed.", "stages.0."))]
    assert len(frozen) > 8 and all(torch.equal(before[n], after[f"encoder.{n}"]) for n in frozen)
    trained = [n for n in before if n not in frozen and not n.startswith("head.")]
    assert any(not torch.equal(before[n], after[f"encoder.{n}"]) for n in trained)


def test_a_dense_model_freezes_its_encoder_alone():
    net = ModelCard("darswin_unet_a_nano", SMALL).create()
    frozen = {id(p) for module in frozen_parts(net, 3) for p in module.parameters()}
    parts = {n.split(".")[0] for n, p in net.named_parameters() if id(p) not in frozen}
    assert parts == {"decoder", "places", "segmentation_head"}


def test_which_model_starts_from_which():
    classifiers = {"darswin_ra_tiny": "darswin_unet_ra_tiny", "swin_micro": "swin_unet_micro",
                   "swin_undis_nano": "swin_unet_undis_nano"}  # fmt: skip
    for name, dense in classifiers.items():
        assert name_from(ModelCard(name), "distance") == dense
        assert name_from(ModelCard(dense, task="distance"), "segmentation") == dense
    for card, task in (
        (ModelCard("dat_nano"), "segmentation"),
        (ModelCard("swin_unet_nano", task="segmentation"), "classification"),
    ):
        with pytest.raises(ValueError, match=rf"no model for {task} starts from a {card.model}"):
            name_from(card, task)
    card = ModelCard("darswin_a_nano", dict(num_classes=4, in_chans=1, spacing="tan"), list("abcd"))
    options = {"typical_distance": 3.0}
    model, data = settle(card, "w", "distance", {"name": None, "options": options}, NONE)
    assert model["name"] == "darswin_unet_a_nano" and data["channels"] == 1
    assert model["options"] == {"spacing": "tan", "typical_distance": 3.0}
    with pytest.raises(ValueError, match="disagrees with `weights` w"):
        settle(card, "w", "distance", {"name": None, "options": {"spacing": "theta"}}, NONE)


def test_weights_that_start_nothing(data, classifier, tmp_path, capsys):
    other = ["--task", "segmentation", "--data.path", str(data), "--model.weights", str(classifier)]
    message = error(capsys, tmp_path / "run", *other, "--model.name", "swin_unet_nano")
    assert "--model.name swin_unet_nano disagrees with" in message
    plain = error(capsys, tmp_path / "run", *other[2:], "--task", "classification", "--model.name",
                  "darswin_unet_a_nano")  # fmt: skip
    assert "disagrees with" in plain
    larger = ModelCard("darswin_unet_a_nano", {**SMALL, "embed_dim": 16})
    with pytest.raises(ValueError, match="holds the weights of another model"):
        start_from(larger.create(), [], classifier)
