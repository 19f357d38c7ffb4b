"""Files of OpenCV, COLMAP and Kalibr that are written here: the same lens, for them and for us."""

from pathlib import Path

import cv2
import hypothesis
import numpy as np
import pytest
import torch
import yaml
from hypothesis import strategies as st
from lens_examples import assert_projects, points_around

from darswin.cli.main import main
from darswin.lens import MODELS, Spherical, as_curves, load, load_all, save

FILES = Path(__file__).parent / "files"
f64 = torch.float64
FORMATS = {"opencv": (".yaml", ".xml", ".json"), "colmap": (".txt",), "kalibr": (".yaml",)}


def small(count):
    return st.lists(st.floats(-0.01, 0.01), min_size=count, max_size=count)


def lens_of(draw, name):
    """A lens of a model with a mild distortion, of an image that it sees the whole of."""
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
    affine = [[1.0, skew], [0.0, draw(st.floats(0.9, 1.1))]]
    center = [draw(st.floats(100, 500)), draw(st.floats(100, 400))]
    tensors = {key: torch.tensor(values[key], dtype=f64) for key in wanted}
    return model(**tensors, center=torch.tensor(center, dtype=f64), image_size=(480, 640),
                 affine=torch.tensor(affine, dtype=f64), theta_max=0.3)  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
@hypothesis.given(data=st.data())
def test_a_written_file_reads_back_to_the_same_lens_or_is_refused(name, data, tmp_path_factory):
    lens = lens_of(data.draw, name)
    theta = 0.3 * torch.linspace(0, 1, 15, dtype=f64)
    azimuth = torch.linspace(-3, 3, 15, dtype=f64)
    for form, suffixes in FORMATS.items():
        path = tmp_path_factory.getbasetemp() / f"lens{data.draw(st.sampled_from(suffixes))}"
        try:
            assert save(lens, path, form) == form
        except ValueError as error:
            holds = f" has no exact place for this {name} lens; it holds "
            assert holds in str(error) and "darswin.lens.fit, or --model" in str(error)
            continue
        found = load(path, theta_max=0.3, dtype=f64)
        expected = lens.project_rays(theta, azimuth)
        torch.testing.assert_close(found.project_rays(theta, azimuth), expected, rtol=0, atol=1e-9)
        assert found.image_size.tolist() == [[480, 640]]


def cameras():
    for path in sorted(set(FILES.iterdir()) - {FILES / "README.md"}):
        for name, lens in load_all(path, dtype=f64).items():
            yield f"{path.name}-{name}", lens


# The formats that hold each; ours holds all.
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


def test_which_formats_hold_which_cameras(tmp_path):
    seen = 0
    for name, lens in cameras():
        held = []
        for form, (suffix, *_) in FORMATS.items():
            path = tmp_path / f"lens{suffix}"
            try:
                save(lens, path, form)
            except ValueError:
                continue
            held.append(form)
            found = load(path, dtype=f64)
            assert type(found) is type(lens), name
            theta = torch.minimum(found.theta_max, lens.theta_max) * torch.linspace(0, 0.99, 20)
            azimuth = torch.linspace(-3, 3, 20, dtype=f64)
            torch.testing.assert_close(
                found.project_rays(theta, azimuth), lens.project_rays(theta, azimuth),
                rtol=0, atol=1e-8,
            )  # fmt: skip
        if name in HELD:
            seen += 1
            assert held == HELD[name].split(), name
    assert seen == len(HELD)


def test_a_table_of_many_slopes(tmp_path):
    lens = as_curves(load(FILES / "kalibr_tumvi.yaml", camera="cam0", dtype=f64))
    save(lens, tmp_path / "lens.json")
    found = load(tmp_path / "lens.json", dtype=f64)
    assert torch.equal(found.slopes, lens.slopes) and lens.slopes.shape == (1, 512)


# -- for the libraries themselves ---------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS["opencv"])
@pytest.mark.parametrize(
    ("name", "camera"),
    [("opencv_fisheye.yaml", None), ("kalibr_tumvi.yaml", "cam0"), ("ros_plumb_bob.yaml", None),
     ("colmap_all.txt", "7"), ("colmap_all.txt", "15"), ("colmap_all.txt", "2")],
)  # fmt: skip
def test_opencv_reads_what_is_written_for_it(name, camera, suffix, tmp_path):
    lens = load(FILES / name, camera=camera, dtype=f64)
    save(lens, tmp_path / f"lens{suffix}", "opencv")
    storage = cv2.FileStorage(str(tmp_path / f"lens{suffix}"), cv2.FILE_STORAGE_READ)
    matrix, d = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients")
    fisheye = storage.getNode("fisheye_model").real()
    size = [storage.getNode(f"image_{side}").real() for side in ("height", "width")]
    assert size == lens.image_size[0].tolist()
    points = points_around(0.6)
    if fisheye:
        found, _ = cv2.fisheye.projectPoints(
            points[None], np.zeros(3), np.zeros(3), matrix, d.mat()
        )
        found = found[0]
    else:
        found = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, d.mat())[0][:, 0]
    assert_projects(lens, points, found)


def test_colmap_reads_what_is_written_for_it(tmp_path):
    """Checked with pycolmap 4.2 where it is installed; else against a file that it wrote."""
    lens = load(FILES / "colmap_all.txt", camera="12", dtype=f64)
    save(lens, tmp_path / "cameras.txt")
    row = tmp_path.joinpath("cameras.txt").read_text().splitlines()[-1]
    assert row == (
        "1 RAD_TAN_THIN_PRISM_FISHEYE 640 480 300.0 310.0 320.0 240.0 0.01 -0.002 0.0003 -0.0001 "
        "2e-05 1e-05 0.001 -0.002 0.0005 -0.0004 0.0003 -0.0002"
    )
    pycolmap = pytest.importorskip("pycolmap")
    points = points_around(0.6)
    for _, lens in cameras():
        try:
            save(lens, tmp_path / "cameras.txt")
        except ValueError:
            continue
        row = tmp_path.joinpath("cameras.txt").read_text().splitlines()[-1].split()
        camera = pycolmap.Camera(
            model=row[1], width=int(row[2]), height=int(row[3]), params=list(map(float, row[4:]))
        )
        pixels = np.array([camera.img_from_cam(point) for point in points]) - 0.5
        assert_projects(lens, points, pixels, atol=1e-8)


def test_kalibr_reads_what_is_written_for_it(tmp_path):
    """As its ConfigReader checks: the numbers of values, and where they stand."""
    counts = {"pinhole": 4, "omni": 5, "ds": 6, "eucm": 6}
    coefficients = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}
    kinds = set()
    for _, lens in cameras():
        path = tmp_path / "camchain.yaml"
        try:
            assert save(lens, path) == "kalibr"
        except ValueError:
            continue
        camera = yaml.safe_load(path.read_text())["cam0"]
        kind, distortion = camera["camera_model"], camera["distortion_model"]
        kinds.add((kind, distortion))
        assert len(camera["intrinsics"]) == counts[kind]
        assert len(camera["distortion_coeffs"]) == coefficients[distortion]
        assert all(isinstance(v, float) for v in camera["intrinsics"] + camera["distortion_coeffs"])
        assert camera["resolution"] == lens.image_size[0].flip(0).int().tolist()
        assert camera["intrinsics"][-2:] == lens.center[0].tolist()
        assert camera["rostopic"] == "/cam0/image_raw"
    assert kinds == {("pinhole", "radtan"), ("pinhole", "equidistant"), ("pinhole", "fov"),
                     ("omni", "radtan"), ("ds", "none"), ("eucm", "none")}  # fmt: skip


# -- names, refusals, the command line ----------------------------------------------------------


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
    with pytest.raises(ValueError, match="format must be darswin, opencv, colmap, kalibr or None"):
        save(lens, tmp_path / "c.json", "ros")


def test_refusals(tmp_path):
    lens = load(FILES / "kalibr_tumvi.yaml", camera="cam0")
    for form in ("colmap", "kalibr"):
        with pytest.raises(ValueError, match=r"have an image_size, \(H, W\), and this lens has n"):
            save(lens.replace(image_size=None), tmp_path / "a", form)
    with pytest.raises(ValueError, match="needs the image_size"):
        save(lens.replace(image_size=None, center=None), tmp_path / "a", "opencv")
    with pytest.raises(ValueError, match="one lens, got 2"):
        save(Spherical([0.5, 0.6], 300.0, image_size=(9, 9)), tmp_path / "a", "opencv")
    with pytest.raises(
        ValueError, match="OpenCV has no exact place for this DoubleSphere lens; it "
    ):
        save(load(FILES / "kalibr_ds.yaml"), tmp_path / "a", "opencv")
    assert not list(tmp_path.iterdir())
    # A lens that has no center of its own has that of its image.
    save(lens.replace(center=None), tmp_path / "a.yaml")
    assert load(tmp_path / "a.yaml").center.tolist() == [[255.5, 255.5]]


def test_convert(tmp_path, capsys):
    calib, out = str(FILES / "kalibr_tumvi.yaml"), tmp_path / "cameras.txt"
    main(["lens", "convert", calib, str(out), "--camera", "cam1"])
    printed = capsys.readouterr().out
    assert printed.startswith(f"{out}: colmap, KannalaBrandt up to ") and "do not" not in printed
    assert load(out).focal.item() == pytest.approx(190.442369694)
    main(["lens", "convert", calib, str(out), "--camera=cam1", "--format=kalibr",
          "--theta_max_deg=60"])  # fmt: skip
    printed = capsys.readouterr().out
    assert "kalibr, KannalaBrandt up to 60.00°; kalibr files do not say how far" in printed
    assert "--theta_max_deg 60.00" in printed
    assert load(out, theta_max=1.0).focal.item() == pytest.approx(190.442369694)
    woodscape = str(FILES / "woodscape.json")
    with pytest.raises(SystemExit, match=r"^darswin: COLMAP has no exact place for this Polynom"):
        main(["lens", "convert", woodscape, str(out), "--format", "colmap"])
    main(["lens", "convert", woodscape, str(tmp_path / "w.xml"), "--model", "KannalaBrandt"])
    assert "opencv, KannalaBrandt up to 95.21°, at most" in capsys.readouterr().out
    assert type(load(tmp_path / "w.xml")).__name__ == "KannalaBrandt"


def test_info_names_the_format(capsys):
    for name, text in (
        ("woodscape.json", "WoodScape, with the centre of the upper left pixel at (0.5, 0.5)\n"),
        ("ours.json", "darswin, with the centre of the upper left pixel at (0, 0)\n"),
        ("opencv_fisheye.yaml", "OpenCV, with the centre of the upper left pixel at (0, 0)\n"),
    ):
        main(["lens", "info", str(FILES / name)])
        printed = capsys.readouterr().out
        assert f"format          {text}" in printed and "camera   " not in printed
