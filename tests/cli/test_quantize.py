"""`darswin quantize` of runs, and what `predict` makes of the file."""

import json
import re

import numpy as np
import pytest
from helpers import slow_but
from PIL import Image
from runs import PIXELS, QUIET, UNET, error, fit
from scenes import write_plain

from darswin.cli.main import main
from darswin.layers.quantized import quantized_layers
from darswin.models import load_model
from darswin.models.saving import read_card

FAST = [*QUIET, "--trainer.logger", "false", "--model.learning_rate", "1e-2"]
LENS = json.dumps({"model": "Spherical", "xi": 0.5, "fov": 2.8})


@pytest.fixture(scope="module")
def digits(tmp_path_factory):
    """A run of a few steps on the bundled digits."""
    run = tmp_path_factory.mktemp("runs") / "digits"
    fit(run, "-c", "minutes", "--data.path", "digits", "--data.limit", "200", "--model.options",
        UNET, "--trainer.max_epochs", "2", *FAST)  # fmt: skip
    return run


@pytest.mark.slow
def test_a_run_s_model(digits, tmp_path, capsys):
    main(["quantize", "--run", str(digits), "--pictures", "40"])
    said = capsys.readouterr().out
    file = digits / "checkpoints" / "best.int8.safetensors"
    model, card = load_model(file)
    layers = quantized_layers(model)
    assert str(file) in said and f"{len(layers)} of " in said and len(layers) >= 8
    assert card.quantized.keys() == layers.keys() and card.task == "classification"
    changed = float(re.search(r"40 validation pictures: .* variance: (\S+)", said)[1])
    assert 0 < changed < 0.02
    same = float(re.search(r"same prediction: (\S+) %", said)[1])
    assert same >= 90
    Image.fromarray(np.zeros((40, 40), np.uint8)).save(tmp_path / "p.png")
    answers = []
    for weights in (["--run", str(digits)], ["--model", str(file)]):
        main(["predict", str(tmp_path / "p.png"), *weights, "--lens", LENS, "--top", "10"])
        (answer,) = json.loads(capsys.readouterr().out)
        answers.append({t["class"]: t["probability"] for t in answer["top"]})
    assert answers[0] != answers[1]
    assert all(abs(answers[1][name] - p) < 0.1 for name, p in answers[0].items())


def test_what_is_kept_and_where_it_goes(digits, tmp_path, capsys):
    out = tmp_path / "q.safetensors"
    given = ["quantize", "--run", str(digits), "--pictures", "8", "--out", str(out)]
    main([*given, "--keep", '["stages.0", "stages.1"]'])
    assert read_card(out).quantized
    assert all(name.startswith("stages.2") for name in read_card(out).quantized)
    for more, message in (
        (["--keep", '["stages.7"]'], "the model has no module named stages.7"),
        (["--tolerance", "0"], "every part of the model exceeds the --tolerance 0"),
    ):
        assert message in error(capsys, *given, *more)


def test_what_is_wrong_with_the_data_has_the_names_of_the_runs_configuration(digits, capsys):
    """The command has no options for data. A run without validation is not compared."""
    config = (digits / "config.yaml").read_text()
    given = ["quantize", "--run", str(digits), "--pictures", "4"]
    try:
        for old, new, said in (
            ("path: digits", "path: gone", f"the data of {digits}/config.yaml: "),
            (
                "camera: null",
                "camera: front",
                "data.camera front needs a calibration: give data.lens",
            ),
        ):
            assert old in config
            (digits / "config.yaml").write_text(config.replace(old, new))
            assert said in error(capsys, *given)
        assert "limit_val_batches: null" in config
        off = config.replace("limit_val_batches: null", "limit_val_batches: 0")
        (digits / "config.yaml").write_text(off)
        main(given)
        assert "no validation pictures to compare" in capsys.readouterr().out
    finally:
        (digits / "config.yaml").write_text(config)


@pytest.mark.parametrize("task", slow_but(["segmentation", "distance"], "segmentation"))
def test_models_of_pixels(tmp_path, task, capsys):
    data, run = write_plain(tmp_path / "scenes", 20, size=(45, 60)), tmp_path / "run"
    fit(run, "--task", task, "--data.path", data, *PIXELS, *FAST, "--trainer.max_epochs", "2")
    main(["quantize", "--run", str(run), "--pictures", "4"])
    said = capsys.readouterr().out
    assert "2 validation pictures" in said and ("same prediction" in said) == (task != "distance")
    file, lens = run / "checkpoints" / "best.int8.safetensors", data / "lens.json"
    main(["predict", str(data / "images"), "--model", str(file), "--lens", str(lens),
          "--out", str(tmp_path / "out")])  # fmt: skip
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == 20
