import json

import cv2
import numpy as np
import pytest
import torch

from darswin.__main__ import main
from darswin.lens import Spherical, from_dict
from darswin.models.saving import ModelCard, save_model
from darswin.predict import lens_of, predict

LENS = {"model": "Spherical", "xi": 0.5, "fov": 2.8}


@pytest.fixture
def run(tmp_path):
    """A run's folder with an untrained model in it, and a picture."""
    options = dict(num_classes=6, in_chans=3, mean=[0.5] * 3, std=[0.25] * 3)
    card = ModelCard("darswin_a_nano", options, list("abcdef"), 32, 2.8)
    save_model(tmp_path / "checkpoints" / "best.safetensors", card.create().state_dict(), card)
    picture = np.random.default_rng(0).integers(256, size=(64, 96, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "p.png"), picture)
    return tmp_path


def test_the_most_probable_classes(run, capsys):
    argv = ["predict", str(run / "p.png"), str(run / "p.png"), "--run", str(run), "--top", "3"]
    main([*argv, "--lens", json.dumps(LENS)])
    printed = json.loads(capsys.readouterr().out)
    assert [p["image"] for p in printed] == [str(run / "p.png")] * 2
    top = printed[0]["top"]
    assert len({t["class"] for t in top}) == 3 and all(t["class"] in "abcdef" for t in top)
    probabilities = [t["probability"] for t in top]
    assert probabilities == sorted(probabilities, reverse=True) and sum(probabilities) <= 1.0001
    (run / "lens.json").write_text(json.dumps(LENS))
    main([*argv, "--lens", str(run / "lens.json"), "--out", str(run / "out.json")])
    assert json.loads((run / "out.json").read_text()) == printed


def test_it_is_what_the_model_says_of_the_normalised_picture(run):
    from darswin.models.saving import load_model

    (found,) = predict([str(run / "p.png")], lens=json.dumps(LENS), run=str(run), top=6)
    net, _ = load_model(run / "checkpoints" / "best.safetensors")
    image = cv2.imread(str(run / "p.png"))[..., ::-1]
    image = cv2.resize(np.ascontiguousarray(image), (48, 32), interpolation=cv2.INTER_AREA)
    image = (torch.from_numpy(image).permute(2, 0, 1)[None] / 255 - 0.5) / 0.25
    expected = net(image, Spherical.from_fov(0.5, 2.8, 16)).softmax(-1)[0]
    for entry in found["top"]:
        k = "abcdef".index(entry["class"])
        assert entry["probability"] == pytest.approx(expected[k].item(), abs=1e-5)


def test_what_is_missing_is_said(run):
    with pytest.raises(SystemExit, match=r"cannot read .*none\.png"):
        main(["predict", "none.png", "--run", str(run), "--lens", json.dumps(LENS)])
    with pytest.raises(SystemExit, match="--run, a run's folder, or --model"):
        main(["predict", "none.png", "--lens", json.dumps(LENS)])
    with pytest.raises(SystemExit, match='"model" must be one of'):
        main(["predict", str(run / "p.png"), "--run", str(run), "--lens", "{}"])


def test_calibration_files(run):
    """Of another tool, whose pictures are larger; of several cameras; of another shape."""
    calibration = {"value0": {"intrinsics": [
        {"camera_type": "ucm", "intrinsics": dict(fx=fx, fy=fx, cx=95.5, cy=63.5, alpha=0.5)}
        for fx in (80.0, 120.0)
    ], "resolution": [[192, 128]] * 2}}  # fmt: skip
    path = run / "calibration.json"
    path.write_text(json.dumps(calibration))
    argv = ["predict", str(run / "p.png"), "--run", str(run), "--out", str(run / "o.json")]
    with pytest.raises(SystemExit, match="choose one as camera=: 'cam0', 'cam1'"):
        main([*argv, "--lens", str(path)])
    main([*argv, "--lens", str(path), "--camera", "cam1"])
    found = json.loads((run / "o.json").read_text())
    # The same lens in pixels of the picture, half as large: its center stays between two pixels.
    lens = lens_of(str(path), (64, 96), "cam1")
    assert lens.focal.item() == pytest.approx(60) and lens.center.tolist() == [[47.5, 31.5]]
    assert lens.image_size.tolist() == [[64, 96]]
    same = dict(
        model="EnhancedUnified", alpha=0.5, beta=1, focal=60, theta_max=lens.theta_max.item()
    )
    main([*argv, "--lens", json.dumps(same)])
    for a, b in zip(
        found[0]["top"], json.loads((run / "o.json").read_text())[0]["top"], strict=True
    ):
        assert a["probability"] == pytest.approx(b["probability"], abs=1e-5)
    calibration["value0"]["resolution"] = [[192, 192]] * 2
    path.write_text(json.dumps(calibration))
    with pytest.raises(SystemExit, match="pictures of 192×192 px, and 64×96 is not of that shape"):
        main([*argv, "--lens", str(path), "--camera", "cam1"])
    with pytest.raises(SystemExit, match="focal is missing"):
        main([*argv, "--lens", '{"model": "Spherical", "xi": 0.5}'])


def test_lenses_from_json():
    lens = from_dict({"model": "Spherical", "xi": 0.5, "focal": 20, "theta_max": 1.2}, (9, 9))
    assert lens.focal.item() == 20
    lens = from_dict({"model": "Perspective", "fov": 2.0}, (40, 60))
    assert lens.r_max.item() == pytest.approx(20)
    lens = from_dict({"model": "Polynomial", "coefficients": [9, 1], "theta_max": 1}, (9, 9))
    assert lens.r_max.item() == pytest.approx(10)
    with pytest.raises(ValueError, match="Spherical lens cannot be made of"):
        from_dict({"model": "Spherical", "x": 0.5}, (9, 9))
