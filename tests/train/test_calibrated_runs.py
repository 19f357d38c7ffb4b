"""Runs on pictures that calibrated cameras took, in this process, with a tiny model."""

import json
import shutil

import pytest
import torch
import yaml
from frames import WOODSCAPE, write_frames
from runs import KilledError, assert_same, checkpoint, error, fit, killed, patch_batch

from darswin.cli.main import main
from darswin.cli.predict import predict
from darswin.models.saving import load_model

EQUIDISTANT = {"model": "Equidistant", "focal": 45.0, "theta_max": 1.5, "image_size": [121, 160]}


KD = "K and D"  # a calibration that does not say its model


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("data") / "frames", count=90)


@pytest.fixture
def tiny(data):
    return [
        *("--config", "minutes", "--data.path", str(data), "--data.lens", str(WOODSCAPE)),
        *("--data.batch_size", "8", "--data.workers", "0", "--checkpoint_steps", "1"),
        *("--trainer.max_epochs", "2", "--trainer.enable_progress_bar", "false"),
        *("--trainer.enable_model_summary", "false", "--data.randaugment", "true"),
        *("--data.flip", "true", "--data.rotate_deg", "180"),
        *("--model.options", "{embed_dim: 8, depths: [1, 1, 1]}", "--model.mixup", "0.8"),
    ]


def lenses_json(folder):
    file = folder / "lenses.json"
    file.write_text(json.dumps({".": str(WOODSCAPE), "1": EQUIDISTANT, "2": EQUIDISTANT}))
    return file


def test_train_test_and_predict_see_the_same(tiny, data, tmp_path, capsys):
    run = tmp_path / "run"
    fit(run, *tiny, "--data.fit", "stretch")
    recorded = yaml.safe_load((run / "config.yaml").read_text())["data"]
    assert recorded["lens"] == str(WOODSCAPE)
    _, card = load_model(run / "checkpoints" / "best.safetensors")
    assert card.fit == "stretch" and card.size == 32 and card.fov == 0
    for command in ("validate", "test"):
        main([command, "--run", str(run), "--trainer.enable_progress_bar", "false"])
    (row,) = json.loads((run / "test.json").read_text())["results"]
    assert row["lenses"] == "woodscape.json" and (run / "test.png").exists()
    # What `test` counted is what `predict` says of the same pictures.
    from darswin.data import open_source

    source = open_source(data, "test", channels=1)
    files = [str(source.file(k)) for k in range(len(source))]
    found = predict(files, lens=str(WOODSCAPE), run=str(run), top=1)
    right = [f["top"][0]["class"] == source.classes[source[k][1]] for k, f in enumerate(found)]
    assert sum(right) / len(right) == pytest.approx(row["top1"])


@pytest.mark.parametrize("several", [False, True])
def test_a_killed_run_goes_on_bit_for_bit(tiny, tmp_path, monkeypatch, several):
    options = tiny + (["--data.lens", str(lenses_json(tmp_path))] if several else [])
    fit(tmp_path / "whole", *options)
    run = tmp_path / "killed"
    for number, given in ((5, options), (6, ["--resume"])):
        patch_batch(monkeypatch, number, killed)
        with pytest.raises(KilledError):
            fit(run, *given)
    patch_batch(monkeypatch, 0, killed)
    fit(run, "--resume")
    assert checkpoint(run)["global_step"] == 16
    assert_same(run, tmp_path / "whole")


def test_a_calibration_may_move(tiny, tmp_path, capsys):
    run, lens = tmp_path / "run", tmp_path / "lens.json"
    shutil.copy(WOODSCAPE, lens)
    fit(run, *tiny, "--trainer.max_epochs", "1", "--data.lens", str(lens))
    lens = lens.rename(tmp_path / "moved.json")
    assert "lens.json" in error(capsys, run, "--resume", "--trainer.max_epochs", "2")
    fit(run, "--resume", "--trainer.max_epochs", "2", "--data.lens", str(lens))
    assert f"--data.lens '{lens}' in place of" in capsys.readouterr().err


def test_a_model_of_warped_pictures_is_tested_on_a_camera_s(tiny, tmp_path):
    run = tmp_path / "run"
    fit(run, *tiny, "--data.lens", "null", "--trainer.max_epochs", "1")
    assert load_model(run / "checkpoints" / "last.safetensors")[1].fit == "whole"
    quiet = ["--run", str(run), "--trainer.enable_progress_bar", "false"]
    main(["test", *quiet, "--data.lens", json.dumps(EQUIDISTANT)])
    (row,) = json.loads((run / "test.json").read_text())["results"]
    assert row["lenses"] == "lens"
    main(["test", *quiet, "--xi", "0.3"])
    (row,) = json.loads((run / "test.json").read_text())["results"]
    assert row["lenses"] == "0.3"


@pytest.mark.parametrize("name", ["swin_nano", "swin_undis_nano"])
def test_other_models_train_on_them(tiny, tmp_path, name):
    options = ["--model.name", name, "--trainer.max_steps", "2", "--model.options", "{}"]
    fit(tmp_path / "run", *tiny, *options)
    weights = checkpoint(tmp_path / "run")["state_dict"]
    assert all(torch.isfinite(tensor).all() for tensor in weights.values())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data.lens", "none.json"], "none.json"),
        (["--data.lens", '{"model": "Fish"}'], "must be one of"),
        (["--data.camera", "7"], "camera must be one of"),
        (["--data.lens", "null", "--data.camera", "7"], "--data.camera 7 is one of a calibration"),
        (["--data.coefficients", "pinhole"], "its cameras say their model"),
        (["--data.lens", KD], 'give --data.coefficients "fisheye"'),
        (["--data.lens", KD, "--data.coefficients", "fish"], "coefficients"),
        (["--data.lens", KD, "--data.coefficients", "pinhole"], "the lens is of pictures of 80×80"),
        (
            ["--data.lens", "null", "--data.coefficients", "pinhole"],
            "--data.coefficients pinhole i",
        ),
        (["--data.path", "digits"], "the lens is of pictures of 966×1280 px, and 8×8"),
        (["--data.train_lenses", "low"], "--data.train_lenses warps pictures"),
        (["--data.test_lenses=low"], "--data.test_lenses warps pictures"),
        (["--xi", "0.3"], "--xi warps pictures"),
    ],
)
def test_wrong_lenses_are_named(tiny, tmp_path, capsys, options, message):
    file = tmp_path / "kd.json"
    file.write_text(json.dumps(dict(K=[30, 0, 39.5, 0, 30, 29.5, 0, 0, 1], D=[0.1, 0, 0, 0],
                                       width=80, height=80)))  # fmt: skip
    options = [str(file) if option == KD else option for option in options]
    assert message in error(capsys, tmp_path / "run", *tiny, *options)
    assert not (tmp_path / "run" / "checkpoints").exists()
