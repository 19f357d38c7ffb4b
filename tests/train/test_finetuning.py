"""Runs that start from a trained model."""

import json
from dataclasses import replace

import pytest
import torch
import yaml
from frames import WOODSCAPE, write_frames
from runs import KilledError, assert_same, checkpoint, error, fit, killed, patch_batch
from safetensors.torch import load_file, save_file

from darswin.cli.main import main
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.train.classification import Classification
from darswin.train.finetuning import frozen_parts, settle, start_from

QUIET = """--data.workers 0 --trainer.enable_progress_bar false
    --trainer.enable_model_summary false""".split()  # noqa: SIM905
FRESH = ["--config", "minutes", "--model.warmup_epochs", "0"]


def write_classes(folder, names):
    file = folder / f"{''.join(names)}.txt"
    file.write_text("\n".join(names))
    return str(file)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A run on frames of the digits 0 to 5, of one camera."""
    folder = tmp_path_factory.mktemp("base")
    data = write_frames(folder / "frames", count=900, classes="012345")
    options = ["--data.path", str(data), "--data.lens", str(WOODSCAPE), *QUIET]
    fit(folder / "run", "--config", "minutes", *options, "--trainer.max_epochs", "12")
    return folder / "run"


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """Frames of the digits 1 to 7, of another camera."""
    folder = tmp_path_factory.mktemp("others")
    lens = folder / "lens.json"
    lens.write_text(
        '{"model": "Equidistant", "focal": 38.0, "theta_max": 1.5, "image_size": [121, 160]}'
    )
    data = write_frames(folder / "frames", lens, 600, classes="1234567")
    rates = ["--model.learning_rate", "3e-3", "--model.reference_batch", "48"]
    return [
        *("--data.path", str(data), "--data.lens", str(lens), "--data.batch_size", "16"),
        *("--data.holdout", "0.4"),
        *("--trainer.max_epochs", "3", "--model.warmup_epochs", "0", "--model.mixup", "0"),
        *("--model.cutmix", "0", "--data.randaugment", "false", "--data.erasing", "0"),
        *rates, *QUIET,
    ]  # fmt: skip


def accuracy(run):
    main(["test", "--run", str(run), "--trainer.enable_progress_bar", "false"])
    (row,) = json.loads((run / "test.json").read_text())["results"]
    return row["top1"]


def weights_of(run, name="last"):
    return load_file(run / "checkpoints" / f"{name}.safetensors")


def test_fine_tuning_beats_a_fresh_start_and_leaves_frozen_stages_alone(base, others, tmp_path):
    tuned, fresh = tmp_path / "tuned", tmp_path / "fresh"
    others = [*others, "--trainer.max_epochs", "6"]  # after 3 the lead is within the seeds' span
    fit(tuned, *others, "--model.weights", str(base), "--model.freeze_stages", "1")
    fit(fresh, *others, "--config", "minutes")
    before, after = weights_of(base, "best"), weights_of(tuned)
    frozen = [n for n in before if n.startswith(("patch_embed.", "stages.0."))]
    assert len(frozen) > 10 and all(torch.equal(before[n], after[n]) for n in frozen)
    trained = [n for n in before if n not in frozen and not n.startswith("head.")]
    assert all(not torch.equal(before[n], after[n]) for n in trained if "weight" in n)
    assert after["head.weight"].shape[0] == 7
    card = load_model(tuned / "checkpoints" / "last.safetensors")[1]
    assert (card.model, card.size, card.options["in_chans"]) == ("darswin_a_nano", 32, 1)
    state = checkpoint(tuned)["optimizer_states"][0]["state"]
    count = sum(len(group["params"]) for group in checkpoint(tuned)["optimizer_states"][0][
        "param_groups"])  # fmt: skip
    assert len(state) == count == sum(n not in frozen for n in after)
    assert accuracy(tuned) > accuracy(fresh) + 0.1


def test_the_head_stays_with_its_classes(base, tmp_path):
    recorded = yaml.safe_load((base / "config.yaml").read_text())["data"]
    options = ["--data.path", recorded["path"], "--data.lens", str(WOODSCAPE), *QUIET]
    start = ["--model.weights", str(base / "checkpoints" / "best.safetensors")]
    still = ["--model.learning_rate", "1e-12", "--model.warmup_rate", "0", "--model.final_rate"]
    run = tmp_path / "same"
    fit(run, *options, *start, *still, "0", "--trainer.max_steps", "1", "--data.batch_size", "8")
    before, after = weights_of(base, "best"), weights_of(run)
    torch.testing.assert_close(after["head.weight"], before["head.weight"], rtol=1e-5, atol=1e-8)
    order = write_classes(tmp_path, list("543210"))
    run = tmp_path / "other"
    fit(run, *options, *start, *still, "0", "--trainer.max_steps", "1", "--data.batch_size", "8",
        "--data.classes", order)  # fmt: skip
    after = weights_of(run)
    assert not torch.allclose(after["head.weight"], before["head.weight"], atol=1e-3)
    torch.testing.assert_close(after["norm.weight"], before["norm.weight"])


def test_a_resumed_run_does_not_read_the_weights_again(base, others, tmp_path, monkeypatch):
    weights = tmp_path / "m.safetensors"
    weights.write_bytes((base / "checkpoints" / "best.safetensors").read_bytes())
    start = ["--model.weights", str(weights), "--model.freeze_stages", "1", *others]
    start += ["--trainer.max_epochs", "2", "--checkpoint_steps", "1", "--model.mixup", "0.8"]
    fit(tmp_path / "whole", *start)
    run = tmp_path / "killed"
    patch_batch(monkeypatch, 4, killed)
    with pytest.raises(KilledError):
        fit(run, *start)
    weights.unlink()
    patch_batch(monkeypatch, 0, killed)
    fit(run, "--resume")
    assert_same(run, tmp_path / "whole")
    assert 0 <= accuracy(run) <= 1  # nor does a test


def test_all_stages_frozen_train_the_head_alone(base):
    net = load_model(base / "checkpoints" / "best.safetensors")[0]
    task = Classification("darswin_a_nano", weights=str(base), freeze_stages=3)
    task.net = net
    task._freeze()
    names = {name for name, p in net.named_parameters() if p.requires_grad}
    assert names == {"head.weight", "head.bias"}
    task.train()
    assert net.head.training and not net.stages[2].training and not net.patch_embed.training
    assert {name for name, m in net.named_children() if m.training} <= {"head", "stages"}


CARD = ModelCard("darswin_a_nano", dict(num_classes=3, in_chans=1, mean=[0.4], std=[0.2],
                 spacing="tan"), list("abc"), 32)  # fmt: skip
NONE = dict(size=None, channels=None, mean=None, std=None)


def test_options_not_given_are_the_model_s():
    model, data = settle(CARD, "w", "classification", dict(name=None, options={"jitter": 0}), NONE)
    assert model == {"name": "darswin_a_nano", "options": {"spacing": "tan", "jitter": 0}}
    assert data == {"size": 32, "channels": 1, "mean": [0.4], "std": [0.2]}
    again = settle(CARD, "w", "classification", model, data)
    assert again == (model, data)
    assert settle(CARD, "w", "classification", model, NONE | {"size": 64})[1]["size"] == 64
    swin = replace(CARD, options={**CARD.options, "image_size": 32})
    with pytest.raises(ValueError, match="`size` 64 disagrees with `weights` w"):
        settle(swin, "w", "classification", model, NONE | {"size": 64})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--model.name", "swin_nano"], "--model.name swin_nano disagrees with --model.weights"),
        (["--model.options", "{spacing: tan}"], "--model.options {'spacing': 'tan'} disagrees"),
        (["--data.channels", "3"], "--data.channels 3 disagrees with"),
        (["--data.mean", "0.1"], "--data.mean [0.1] disagrees with"),
        (["--model.freeze_stages", "4"], "from 0 to the model's 3 stages, got 4"),
        (["--model.freeze_stages", "-1"], "from 0 to the model's 3 stages, got -1"),
        (["--model.weights", "none.safetensors"], "none.safetensors"),
        (["--model.weights", "null", "--model.freeze_stages", "1"], "give --model.weights"),
    ],
)
def test_what_disagrees_is_named(base, others, tmp_path, capsys, options, message):
    start = [*others, "--model.weights", str(base), *options]
    assert message in error(capsys, tmp_path / "run", *start)
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_weights_that_start_nothing(base, others, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    start = [*others, "--model.weights", str(tmp_path / "empty")]
    assert "there is no model in" in error(capsys, tmp_path / "run", *start)
    save_file({"a": torch.zeros(2)}, tmp_path / "a.safetensors")
    start = [*others, "--model.weights", str(tmp_path / "a.safetensors")]
    assert "not the name of their model" in error(capsys, tmp_path / "run", *start)
    other = replace(CARD, options=CARD.options | {"embed_dim": 12})
    save_model(tmp_path / "b.safetensors", other.create().state_dict(), other)
    with pytest.raises(ValueError, match="holds the weights of another model"):
        start_from(CARD.create(), ["a", "b"], tmp_path / "b.safetensors")


@pytest.mark.parametrize("name", ["darswin_ra_nano", "swin_nano", "swin_undis_nano", "dat_nano"])
def test_every_model_freezes_what_stands_before_its_stages(name):
    net = ModelCard(name, {"image_size": 32} if "darswin" not in name else {}).create()
    frozen = {id(p) for module in frozen_parts(net, 1) for p in module.parameters()}
    names = {n.split(".")[0] for n, p in net.named_parameters() if id(p) not in frozen}
    assert names == {"stages", "norm", "head"}
    assert all(id(p) in frozen for p in net.stages[0].parameters())
    assert not frozen_parts(net, 0)
