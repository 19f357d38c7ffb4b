"""Bytes and archives of calibrations: encodings, arrays, COLMAP's binary files, damage."""

import codecs
import contextlib
import io
import random
from itertools import product

import numpy as np
import pytest
import torch
from helpers import few_calls, refused
from lens_examples import FILES, FISHEYE, PLUMB_BOB, f64, file_text, loads, write_opencv

from darswin.lens import load, load_all, to_dict

K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]


def test_paths(tmp_path):
    for path in (tmp_path, "/dev/zero"):
        refused("it must be a file", load, path)
    (tmp_path / "large").write_bytes(b" " * ((16 << 20) + 1))
    refused(r"calibration /.*large: it must be at most 16 MiB", load, tmp_path / "large")
    (tmp_path / "latin").write_bytes("name: caf\xe9".encode("latin-1"))
    refused(r"must be text in UTF-8: .* 0xe9", load, tmp_path / "latin")


ENCODINGS = {
    "UTF-8 with a mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16, little end first": lambda text: codecs.BOM_UTF16_LE + text.encode("utf-16-le"),
    "UTF-16, big end first": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "Windows": lambda text: text.replace("\n", "\r\n").encode("utf-16"),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("name", [
    "opencv_fisheye.yaml", "kalibr_ds.yaml", "kitti360_02.yaml", "woodscape.json", "ours.json",
    "opencv_omnidir.xml", "ocamcalib.txt", "colmap.txt",
])  # fmt: skip
def test_editors_of_other_systems_may_have_saved_a_calibration(name, encoding, tmp_path):
    path = tmp_path / name
    text = file_text(name)
    if name.endswith(".xml") and "UTF-16" in encoding:
        text = text.replace('version="1.0"', 'version="1.0" encoding="UTF-16"')
    path.write_bytes(ENCODINGS[encoding](text))
    assert to_dict(load(path, dtype=f64)) == to_dict(load(FILES / name, dtype=f64))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_of_numpy(save, tmp_path):
    path = tmp_path / "calib.npz"
    points = np.random.default_rng(0).normal(size=(20, 5000, 3))  # megabytes without a meaning
    save(path, mtx=np.array(K), dist=np.array([PLUMB_BOB]), DIM=np.array([1280, 960]), ret=0.31,
         objpoints=points)  # fmt: skip
    described = to_dict(load(path, dtype=f64))
    expected = dict(model="BrownConrady", radial=[-0.22, 0.05, 0.003], tangential=[0.001, -0.002],
                    center=[320, 240], image_size=[960, 1280])  # fmt: skip
    assert described | expected == described
    save(path, cameraMatrix=np.array(K), distCoeffs=np.array(FISHEYE)[:, None])
    assert load(path, coefficients="fisheye", dtype=f64).radial.tolist() == [FISHEYE]


CLOSE = 1.15  # the middles of both orders are so close that only an exact one tells them apart
SHIFTS = [(0.0, 0.0), (0.02, -0.02), (-0.03, 0.01)]


@pytest.mark.parametrize(
    ("ratio", "shift"), [*product([16 / 9, 3 / 2, 4 / 3, 5 / 4], SHIFTS), (CLOSE, (0.0, 0.0))]
)
@pytest.mark.parametrize("turned", [False, True])
def test_arrays_of_numpy_in_either_order(ratio, turned, shift, tmp_path):
    """`np.savez(img_size=img.shape[:2])` and `img_size=img.shape[1::-1]`."""
    short, long = 960, round(960 * ratio)
    height, width = (long, short) if turned else (short, long)
    path = tmp_path / "calib.npz"
    center = [(0.5 + part) * side for part, side in zip(shift, (width, height), strict=True)]
    k = np.array([[421.3, 0, center[0]], [0, 420.9, center[1]], [0, 0, 1]])
    array = np.zeros((height, width, 3), np.uint8)
    for entry in (
        dict(img_size=array.shape[:2]), dict(img_size=array.shape[1::-1]), dict(shape=array.shape),
        dict(shape=array.shape[:2]), dict(shape=array.shape[1::-1]), dict(size=array.shape),
    ):  # fmt: skip
        np.savez(path, K=k, D=np.array(FISHEYE), **entry)
        assert load(path, coefficients="fisheye").image_size.tolist() == [[height, width]], entry


def test_damaged_archives_are_refused_in_a_sentence(tmp_path):
    path, data = tmp_path / "calib.npz", io.BytesIO()
    np.savez(data, K=np.reshape(K, (3, 3)), D=D)
    rng = np.random.default_rng(0)
    for _ in range(30):
        broken = bytearray(data.getvalue())
        for place in rng.integers(4, len(broken), rng.integers(1, 4)):
            broken[place] = rng.integers(256)
        path.write_bytes(broken[: rng.integers(4, 2 * len(broken))])
        try:
            load(path)
        except ValueError as error:
            assert str(path) in str(error) and "\n" not in str(error)


def test_arrays_of_objects_are_named(tmp_path):
    """They are not unpickled. One that should hold numbers is an error, others are left out."""
    path, shape = tmp_path / "calib.npz", dict(width=1280, height=960, fisheye_model=1)
    rows, entry = np.array([np.zeros(3), np.zeros(2)], dtype=object), np.array([[{}]], dtype=object)
    numbers = dict(K=np.reshape(K, (3, 3)), D=np.array(D[:4]))
    for name in numbers:
        np.savez(path, **numbers | {name: numbers[name].astype(object)}, **shape)
        refused(rf"{name} must be .*, got \['dtype', 'object'\]", load, path)
    np.savez(path, **numbers, rvecs=rows, notes=entry, **shape)
    assert load(path).radial.tolist() == [pytest.approx(D[:4])]


def test_cameras_that_are_read_together_are_those_read_alone(tmp_path):
    rows = [f"{i} OPENCV_FISHEYE 640 480 {300 + i} 310 320 240 0.01 -0.002 0.0003 0\n"
            for i in range(9)]  # fmt: skip
    path = tmp_path / "cameras.txt"
    path.write_text("".join(rows))
    lenses = load_all(path, dtype=f64)
    for camera in ("0", "5", "8"):
        for name, value in load(path, camera=camera, dtype=f64)._tensors().items():
            torch.testing.assert_close(getattr(lenses[camera], name), value, rtol=1e-12, atol=0)
    for bad in (6, 8):
        rows[bad] = rows[bad].replace("310", "1e-300")
    path.write_text("".join(rows))
    with few_calls(1_000_000):
        refused(r"COLMAP calibration .*: camera '6': ", load_all, path)
    assert load(path, camera="5").focal.item() == 305


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_a_calibration_with_its_image_points(suffix, tmp_path):
    points = np.random.default_rng(0).uniform(0, 1000, (60, 1000)).astype(np.float32)
    matrix, path = np.reshape(K, (3, 3)), tmp_path / f"c.{suffix}"
    write_opencv(path, image_points=points, camera_matrix=matrix, distortion_coefficients=[D])
    assert path.stat().st_size > 600_000
    with few_calls(3_000_000):
        lens = load(path, image_size=(480, 640), dtype=f64)
    assert lens.radial.tolist() == [[-0.3, 0.1, 0.01]]
    # So many numbers as coefficients are an error.
    text = path.read_text().replace("image_points", "D").replace("distortion_coefficients", "x")
    refused("must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers, go", loads, text)


def test_binary_files_that_are_wrong(tmp_path):
    whole, path = (FILES / "colmap_all.bin").read_bytes(), tmp_path / "cameras.bin"

    def error_of(data):
        path.write_bytes(data)
        return refused(r"calibration .*cameras\.bin", load_all, path)

    for length in range(8, len(whole), 31):
        assert "it ends within camera" in error_of(whole[:length])
    assert "it has 3 extra bytes after the last camera" in error_of(whole + b"abc")
    assert "cameras, got 4294967295" in error_of(b"\xff" * 4 + whole[4:])
    assert "to 16 (EUCM), got 17" in error_of(whole[:12] + bytes([17]) + whole[13:])
    random.seed(0)
    for _ in range(12):  # any bytes give a lens or an error
        data = bytearray(whole)
        data[random.randrange(len(data))] = random.randrange(256)
        path.write_bytes(data)
        with contextlib.suppress(ValueError):
            load(path, camera=random.choice([*range(1, 16), 17, 18]), theta_max=0.3)
