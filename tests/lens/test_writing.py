"""Files written in the formats of OpenCV, COLMAP, Kalibr and our own hold the same lens."""

import contextlib
import json
import math
import re
import warnings
from itertools import product

import cv2
import hypothesis
import numpy as np
import pytest
import torch
import yaml
from helpers import refused, slow
from hypothesis import strategies as st
from lens_examples import ASIDE, FILES, assert_projects, double, example, f64, points_around
from torch.testing import assert_close

from darswin.cli.main import main
from darswin.lens import (
    MODELS,
    EnhancedUnified,
    Equidistant,
    FieldOfView,
    Fisheye624,
    Mei,
    Spherical,
    from_dict,
    load,
    load_all,
    save,
    to_dict,
)
from darswin.lens.curves import as_curves
from darswin.lens.files.load import Calibration

FORMATS = {"opencv": (".yaml", ".xml", ".json"), "colmap": (".txt",), "kalibr": (".yaml",)}


def small(count):
    return st.lists(st.floats(-0.01, 0.01), min_size=count, max_size=count)


def lens_of(draw, name):
    """A lens with mild distortion, which sees its whole image."""
    model = MODELS[name]
    values = dict(
        focal=draw(st.floats(200, 900)), omega=draw(st.floats(0.1, 1.5)),
        xi=draw(st.floats(0.0, 0.9)), alpha=draw(st.floats(0.1, 0.7)),
        beta=draw(st.floats(0.5, 2)), radial=draw(st.integers(1, 6).flatmap(small)),
        denominator=draw(st.integers(1, 3).flatmap(small)), tangential=draw(small(2)),
        prism=draw(small(4)), coefficients=[300.0, *draw(small(2))], angles=[0.0, 0.5, 1.2],
        radii=[0.0, 140.0, 400.0], slopes=[270.0, 330.0, 380.0],
    )  # fmt: skip
    if name == "OCam":
        values["coefficients"] = [-300.0, *(value / 10 for value in values["coefficients"][1:])]
    elif name == "OCamInverse":
        values["coefficients"] = [500.0, 320.0, 1.0]
    wanted = [*model.parameters, *(key for key in model.optional if draw(st.booleans()))]
    skew = draw(st.sampled_from([0.0, 0.0, 0.001]))
    values["affine"] = [[1.0, skew], [0.0, draw(st.floats(0.9, 1.1))]]
    values["center"] = [draw(st.floats(100, 500)), draw(st.floats(100, 400))]
    tensors = {n: torch.tensor(values[n], dtype=f64) for n in (*wanted, "affine", "center")}
    return model(**tensors, image_size=(480, 640), theta_max=0.3)


@pytest.mark.parametrize("name", MODELS)
@hypothesis.given(data=st.data())
@hypothesis.settings(max_examples=hypothesis.settings().max_examples // 6)
def test_a_written_file_reads_back_to_the_same_lens_or_is_refused(name, data, tmp_path_factory):
    lens = lens_of(data.draw, name)
    theta = 0.3 * torch.linspace(0, 1, 15, dtype=f64)
    azimuth = torch.linspace(-3, 3, 15, dtype=f64)
    for form, suffixes in FORMATS.items():
        folder = tmp_path_factory.getbasetemp() / "written"  # other tests look above theirs
        folder.mkdir(exist_ok=True)
        path = folder / f"lens{data.draw(st.sampled_from(suffixes))}"
        try:
            assert save(lens, path, form) == form
        except ValueError as error:
            assert f" files cannot hold this {name} lens exactly. They hold " in str(error)
            continue
        found = load(path, theta_max=0.3, dtype=f64)
        expected = lens.project_rays(theta, azimuth)
        assert_close(found.project_rays(theta, azimuth), expected, rtol=0, atol=1e-9)
        assert found.image_size.tolist() == [[480, 640]]


@pytest.mark.parametrize("name", [*MODELS, "Mei aside", "curve"])
def test_our_own_json_is_the_lens_to_the_bit(name, tmp_path):
    path = tmp_path / "lens.json"
    lens = ASIDE["Mei"]
    if name == "curve":
        lens = as_curves(load(FILES / "kalibr_tumvi.yaml", camera="cam0", dtype=f64))
    elif name in MODELS:
        lens = example(name, torch.Generator().manual_seed(3))[0]
    affine = double(1, 0.01, 0, 1.02).view(1, 2, 2)
    lens = lens.replace(affine=affine, image_size=double(48, 64)[None])
    for dtype, other, share in ((torch.float32, f64, 1), (f64, torch.float32, 0.7)):
        used = lens.to(dtype).with_theta_max(None)
        used = used.with_theta_max(share * used.theta_max)
        save(used, path)
        assert load(path, dtype=dtype).same_as(used)
        assert_close(load(path, dtype=other).theta_max, used.theta_max.to(other), rtol=0, atol=1e-4)


def test_our_own_json_alone_keeps_how_far_corners_support_the_lens(tmp_path):
    lens, path = Spherical(0.5, 300.0, 1.5, image_size=(480, 640)), tmp_path / "lens.json"
    assert save(lens, path, supported=1.2) == "darswin"
    assert Calibration.read(path).supported() == 1.2
    content = json.loads(path.read_text())
    assert load(path).same_as(lens) and from_dict(content).same_as(lens)
    assert {k: v for k, v in content.items() if k not in to_dict(lens)} == {"supported": 1.2}
    refused("supported must be above 0 and at most 3.142 rad, got 71", save, lens, path,
            supported=71)  # fmt: skip
    assert json.loads(path.read_text()) == content
    for form, name in (("darswin", "other.json"), ("opencv", "plain.json")):
        save(lens, tmp_path / name, form)
        assert Calibration.read(tmp_path / name).supported() is None
    save(lens, path, "opencv", supported=1.2)
    assert path.read_text() == (tmp_path / "plain.json").read_text()


# The formats that hold each camera; ours holds all.
HELD = {
    "basalt.json-cam0": "colmap kalibr", "basalt.json-cam1": "kalibr",
    "basalt.json-cam3": "opencv colmap kalibr", "basalt.json-cam4": "opencv colmap",
    "kalibr_fov.yaml-cam0": "colmap kalibr", "kalibr_omni.yaml-cam0": "opencv kalibr",
    "kitti360_02.yaml-image_02": "opencv kalibr", "opencv_omnidir.xml-camera": "opencv",
    "ros_plumb_bob.yaml-camera": "opencv colmap kalibr", "ros2_echo.yaml-camera": "opencv colmap",
    "colmap_all.txt-1": "opencv colmap kalibr", "colmap_all.txt-11": "colmap",
    "colmap_all.txt-12": "colmap", "colmap_all.txt-17": "colmap", "woodscape.json-FV": "",
    "ocamcalib.txt-camera": "", "ours.json-lens": "colmap",
}  # fmt: skip


def opencvs(path, points):
    """Pixels of points, projected by OpenCV with a file that it reads."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, d = (storage.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients"))
    zero = np.zeros(3)
    if storage.getNode("fisheye_model").real():
        return cv2.fisheye.projectPoints(points[None], zero, zero, matrix, d)[0][0]
    return cv2.projectPoints(points, zero, zero, matrix, d)[0][:, 0]


# How many intrinsics each model of Kalibr has, and how many coefficients.
KALIBR = {"pinhole": 4, "omni": 5, "ds": 6, "eucm": 6}
COEFFICIENTS = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}


def check_kalibr(path, lens):
    """Checks a file like Kalibr's ConfigReader: the numbers and places of its values."""
    camera = yaml.safe_load(path.read_text())["cam0"]
    models = camera["camera_model"], camera["distortion_model"]
    intrinsics, coefficients = camera["intrinsics"], camera["distortion_coeffs"]
    assert (len(intrinsics), len(coefficients)) == (KALIBR[models[0]], COEFFICIENTS[models[1]])
    assert all(isinstance(value, float) for value in intrinsics + coefficients)
    assert camera["resolution"] == lens.image_size[0].flip(0).int().tolist()
    assert intrinsics[-2:] == lens.center[0].tolist()
    return models


@pytest.mark.slow
def test_which_formats_hold_which_cameras_and_their_libraries_read_them(tmp_path):
    seen, kinds, points = set(), set(), points_around(0.6)
    for path in sorted(set(FILES.iterdir()) - {FILES / "README.md"}):
        for camera, lens in load_all(path, dtype=f64).items():
            held, name = [], f"{path.name}-{camera}"
            for form in FORMATS:
                written = tmp_path / f"lens{FORMATS[form][len(seen) % len(FORMATS[form])]}"
                try:
                    save(lens, written, form)
                except ValueError:
                    continue
                held.append(form)
                found = load(written, dtype=f64)
                assert type(found) is type(lens), name
                theta = torch.minimum(found.theta_max, lens.theta_max) * torch.linspace(0, 0.99, 20)
                rays = theta, torch.linspace(-3, 3, 20, dtype=f64)
                assert_close(found.project_rays(*rays), lens.project_rays(*rays), rtol=0, atol=1e-8)
                if form == "kalibr":
                    kinds.add(check_kalibr(written, lens))
                square = lens.affine is None or lens.affine[0, 0, 1] == 0
                if form == "opencv" and square and type(lens).__name__ not in ("Mei", "Spherical"):
                    assert_projects(lens, points, opencvs(written, points))
            if name in HELD:
                seen.add(name)
                assert held == HELD[name].split(), name
    assert len(seen) == len(HELD)
    assert kinds == {*product(["pinhole"], ["radtan", "equidistant", "fov"]), ("omni", "radtan"),
                     ("ds", "none"), ("eucm", "none")}  # fmt: skip


def test_the_name_chooses_the_format(tmp_path):
    lens = load(FILES / "kalibr_tumvi.yaml", camera="cam0")
    for name, form, start in (
        ("a.json", "darswin", "{"), ("a.yaml", "opencv", "%YAML"), ("a.yml", "opencv", "%YAML"),
        ("a.xml", "opencv", "<?xml"), ("cameras.txt", "colmap", "# Camera list"),
        ("camchain.yaml", "kalibr", "cam0:"), ("kalibr_1.YML", "kalibr", "cam0:"),
        ("a", "darswin", "{"),
    ):  # fmt: skip
        assert save(lens, tmp_path / name) == form
        assert tmp_path.joinpath(name).read_text().startswith(start)
        assert type(load(tmp_path / name)) is type(lens)
    assert save(lens, tmp_path / "b.json", "opencv") == "opencv"
    assert "camera_matrix" in tmp_path.joinpath("b.json").read_text()
    # The row that pycolmap 4.2 wrote for the same camera.
    save(load(FILES / "colmap_all.txt", camera="12", dtype=f64), tmp_path / "cameras.txt")
    assert tmp_path.joinpath("cameras.txt").read_text().splitlines()[-1] == (
        "1 RAD_TAN_THIN_PRISM_FISHEYE 640 480 300.0 310.0 320.0 240.0 0.01 -0.002 0.0003 -0.0001 "
        "2e-05 1e-05 0.001 -0.002 0.0005 -0.0004 0.0003 -0.0002"
    )
    # The center of a lens without a center is the middle of its image.
    save(lens.replace(center=None), tmp_path / "a.yaml")
    assert load(tmp_path / "a.yaml").center.tolist() == [[255.5, 255.5]]


@pytest.mark.parametrize(("model", "formats"), [
    (Equidistant, "opencv colmap kalibr"), (Mei, ""), (FieldOfView, "colmap kalibr"),
    (EnhancedUnified, "colmap"),
])  # fmt: skip
def test_programs_that_end_at_90_degrees_are_named(model, formats, tmp_path):
    values = {"omega": 0.9, "alpha": 0.6, "beta": 1.1, "xi": 1.2, "focal": 200.0}
    used = {name: values[name] for name in model.parameters}
    for form, end in product(("darswin", "opencv", "colmap", "kalibr"), (1.5, 1.6)):
        lens = model(**used, theta_max=end, image_size=(480, 640))
        with warnings.catch_warnings(record=True) as said, contextlib.suppress(ValueError):
            save(lens, tmp_path / "lens", form)
        assert bool(said) == (end > 1.57 and form in formats.split())
        assert all("no pixels for rays of 90° and more" in str(w.message) for w in said)
    ray = np.array([[[math.sin(1.6), 0, math.cos(1.6)]]])  # to the right
    matrix, zeros = np.diag([200.0, 200, 1]), np.zeros(4)
    assert cv2.fisheye.projectPoints(ray, zeros[:3], zeros[:3], matrix, zeros)[0][0, 0, 0] < 0


def test_refusals(tmp_path):
    lens = load(FILES / "kalibr_tumvi.yaml", camera="cam0")
    two = Spherical([0.5, 0.6], 300.0, image_size=(9, 9))
    for wrong, form, message in (
        (lens, "ros", "format must be darswin, opencv, colmap, kalibr or None"),
        (lens.replace(image_size=None), "colmap", "need the lens's image_size"),
        (lens.replace(image_size=None), "kalibr", "need the lens's image_size"),
        (lens.replace(image_size=None, center=None), "opencv", "needs the image_size"),
        (two, "opencv", "one lens, got 2"),
        (two, "darswin", "one lens, got 2"),
        (load(FILES / "kalibr_ds.yaml"), "opencv", "OpenCV files cannot hold this DoubleS"),
    ):
        refused(message, save, wrong, tmp_path / "a", form)
    assert not list(tmp_path.iterdir())


TILTED = Fisheye624(
    300.0, radial=[0.02, -0.01], tangential=[0.0012, -0.0008], prism=[0.001, 0.0, -0.0006, 0.0],
    center=[320.2, 239.1], image_size=(480, 640), theta_max=1.2,
    affine=[[1.0, 0.002], [0.001, 1.003]],
)  # fmt: skip


ASIDE_TERMS = "tangential terms and prism terms"


@pytest.mark.parametrize(("out", "model", "lost"), [
    ("camera.yaml", "KannalaBrandt", f"{ASIDE_TERMS} and skew"),
    ("camera.json", "Equidistant", ASIDE_TERMS),
    ("camera.json", "KannalaBrandt", None),
    pytest.param("camera.yaml", "Mei", "prism terms and skew", marks=slow),
    pytest.param("kalibr.yaml", "KannalaBrandt", f"{ASIDE_TERMS} and skew", marks=slow),
])  # fmt: skip
def test_convert_leaves_out_what_the_format_cannot_hold(out, model, lost, tmp_path, capsys):
    given, path = tmp_path / "given.json", tmp_path / out
    save(TILTED, given)
    main(["lens", "convert", str(given), str(path), "--model", model])
    printed = capsys.readouterr().out
    assert ("it leaves out" in printed) == (lost is not None)
    assert lost is None or f", whose {lost} it leaves out" in printed
    said = float(re.search(r"at most (\S+) px", printed)[1])
    theta = torch.linspace(0.05, 1.2, 40)[:, None].expand(40, 60)[None]
    azimuth = torch.linspace(0, 2 * torch.pi, 60)[None, None].expand(1, 40, 60)
    found = load(path).with_theta_max(None)
    assert type(found).__name__ == model
    apart = found.project_rays(theta, azimuth) - TILTED.project_rays(theta, azimuth)
    assert apart.norm(dim=-1).max().item() == pytest.approx(said, rel=0.06)


def test_commands(tmp_path, capsys):
    calib, out = str(FILES / "kalibr_tumvi.yaml"), tmp_path / "cameras.txt"
    main(["lens", "convert", calib, str(out), "--camera", "cam1"])
    printed = capsys.readouterr().out
    assert printed.startswith(f"{out}: colmap, KannalaBrandt up to ") and "do not" not in printed
    assert load(out).focal.item() == pytest.approx(190.442369694)
    main(["lens", "convert", calib, str(out), "--camera=cam1", "--format=kalibr",
          "--theta_max_deg=60"])  # fmt: skip
    printed = capsys.readouterr().out
    assert "kalibr, KannalaBrandt up to 60.00°; kalibr files have no θ_max" in printed
    main(["lens", "info", str(FILES / "woodscape.json")])
    origin = "WoodScape, with the centre of the upper left pixel at (0.5, 0.5)\n"
    assert f"format          {origin}" in capsys.readouterr().out
