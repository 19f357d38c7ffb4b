"""Files of rigs: each program's own arithmetic projects points where the rig does."""

import itertools
import json
import random
import re
import warnings

import cv2
import hypothesis
import numpy as np
import pycolmap
import pytest
import torch
import yaml
from helpers import few_calls, refused
from lens_examples import FILES, file_text, poses
from scipy.spatial.transform import Rotation

from darswin.lens import (
    BrownConrady,
    DoubleSphere,
    Equidistant,
    KannalaBrandt,
    OCam,
    Rig,
    load,
    to_dict,
)

SIZE = (400, 600)
LENS = KannalaBrandt(180.0, radial=[0.02, -0.003], theta_max=1.7, center=(300, 190))
CAMERA_MATRIX = np.array([[180.0, 0, 300], [0, 181.0, 190], [0, 0, 1]])
TERMS = np.array([0.02, -0.003, 0.001, -0.0002])
POINTS = np.random.default_rng(1).normal(size=(300, 3)) * 3
TURNS = poses(5, 3)  # rig → camera; the first is replaced by the identity where that is the frame
TURNS[0] = np.eye(4)
DIRECTIONS = ("camera_to_rig", "rig_to_camera")


def kalibr(camera: int, **entries):
    return {f"cam{camera}": dict(
        camera_model="pinhole", distortion_model="equidistant", resolution=[600, 400],
        intrinsics=[180.0, 181.0, 300.0, 190.0], distortion_coeffs=TERMS.tolist(), **entries,
    )}  # fmt: skip


def chain() -> str:
    """Kalibr's: three cameras, each with the pose of the one before it."""
    steps = [turn @ np.linalg.inv(before) for before, turn in itertools.pairwise(TURNS)]
    last = [kalibr(i + 1, T_cn_cnm1=step.tolist()) for i, step in enumerate(steps)]
    return yaml.safe_dump(last[1] | kalibr(0, T_cam_imu=TURNS[2].tolist()) | last[0])


def multi_view(**entries):
    """What OpenCV's sample of calibrateMultiview writes."""
    turns = np.array(TURNS)
    vectors = np.stack([cv2.Rodrigues(turn[:3, :3])[0] for turn in turns])
    return dict(
        Ks=np.array([CAMERA_MATRIX] * 3), distortions=np.array([TERMS] * 3),
        is_fisheye=np.array([1, 1, 1]), image_sizes=np.array([[600, 400]] * 3),
        rvecs=vectors, Ts=turns[:, :3, 3:], rvecs0=np.zeros((9, 3)), cam_ids="l,m,r",
    ) | entries  # fmt: skip


def rig_config() -> str:
    cameras = [dict(image_prefix=f"{name}/", camera_model_name="OPENCV_FISHEYE",
                    camera_params=[180.0, 181, 300.5, 190.5, *TERMS]) for name in "amz"]  # fmt: skip
    cameras[0]["ref_sensor"] = True
    for camera, turn in zip(cameras[1:], TURNS[1:], strict=True):
        camera["cam_from_rig_rotation"] = (-Rotation.from_matrix(turn[:3, :3]).as_quat())[
            [3, 0, 1, 2]
        ].tolist()
        camera["cam_from_rig_translation"] = turn[:3, 3].tolist()
    return json.dumps([{"cameras": cameras}])


def with_matrix(**entries) -> str:
    """Cameras of OpenCV, each with a matrix whose direction the file does not say."""
    return json.dumps({f"c{i}": dict(K=CAMERA_MATRIX.tolist(), D=TERMS.tolist(), fisheye=1, width=600,
                                     height=400, T=turn.tolist()) | entries
                       for i, turn in enumerate(TURNS)})  # fmt: skip


def kitti360(folder, **poses_of):
    folder.mkdir(exist_ok=True)
    said = {f"image_0{i}": np.linalg.inv(TURNS[i - 1])[:3] for i in (2, 3)} | poses_of
    lines = (f"{name}: {' '.join(map(str, np.ravel(pose)))}\n" for name, pose in said.items())
    (folder / "calib_cam_to_pose.txt").write_text("".join(lines))
    for name in ("kitti360_02.yaml", "kitti360_03.yaml"):
        (folder / f"image_{name[-7:]}").write_text(file_text(name))
    return folder


def written(path, text):
    path.write_text(text)
    return path


def seen(i: int, points=POINTS) -> np.ndarray:
    """The pixels of camera i by OpenCV, with its R and T."""
    vector = cv2.Rodrigues(TURNS[i][:3, :3])[0]
    args = (points[:, None], vector, TURNS[i][:3, 3], CAMERA_MATRIX, TERMS)
    return cv2.fisheye.projectPoints(*args)[0][:, 0]


def check(rig, expected=seen, count=3):
    """The rig projects the points that each camera sees as another program does."""
    pixels, _ = rig.project(POINTS)
    assert len(rig) == count
    for i in range(count):
        known = ~np.isnan(pixels[i]).any(1) & ((POINTS @ TURNS[i][:3, :3].T)[:, 2] > 0)
        known &= (POINTS @ TURNS[i][2, :3] + TURNS[i][2, 3]) > 0  # others OpenCV does not know
        assert known.sum() > 50
        assert pixels[i, known] == pytest.approx(expected(i)[known], abs=1e-6)


@pytest.mark.parametrize("end", ["yaml", "xml", "json", "npz"])
def test_opencv_projects_with_r_and_t_of_its_multi_view_file(end, tmp_path):
    turns = np.array(TURNS)
    for entries in (
        multi_view(),
        multi_view(Ts=turns[:, :3, 3], rvecs=multi_view()["rvecs"][..., 0]),
        {k: v for k, v in multi_view(Rs=turns[:, :3, :3]).items() if k != "rvecs"},
    ):
        path = tmp_path / f"views.{end}"
        if end == "npz":
            np.savez(path, **entries)
        else:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
            for name, value in entries.items():
                storage.write(name, value)
            storage.release()
        rig = Rig.load(path)
        check(rig)
        assert rig.up == (0, -1, 0) and rig.forward == (0, 0, 1)
        assert end == "npz" or rig.names == ("l", "m", "r")


def test_a_kalibr_chain_leads_from_each_camera_to_the_next(tmp_path):
    path = written(tmp_path / "camchain.yaml", chain())
    rig = Rig.load(path, up=(0, -0.1, -2))
    check(rig)
    assert rig.names == ("cam0", "cam1", "cam2") and rig.forward == (0, -1, 0)  # it looks down
    content, point = yaml.safe_load(chain()), np.array((0.3, -0.2, 0.9, 1))
    moved = content["cam2"]["T_cn_cnm1"] @ (content["cam1"]["T_cn_cnm1"] @ point)
    assert np.linalg.inv(rig["cam2"].pose) @ point == pytest.approx(moved)
    lifted = Rig.load(path, height=1.5)
    assert lifted["cam0"].pose[:3, 3] == pytest.approx((0, -1.5, 0))


@pytest.mark.parametrize("key", ["T_cam_imu", "T_imu_cam"])
def test_without_a_chain_kalibr_cameras_are_in_the_frame_of_the_imu(key, tmp_path):
    cameras = {}
    for i, turn in enumerate(TURNS):
        matrix = turn if key == "T_cam_imu" else np.linalg.inv(turn)
        cameras |= kalibr(i, **{key: matrix.tolist()})
    path = written(tmp_path / "imu.yaml", yaml.safe_dump(cameras))
    refused(rf"{re.escape(str(path))}: .*does not say which way is up.*give `up`", Rig.load, path)
    rig = Rig.load(path, up=(0, 0, 9.81))
    check(rig)
    assert rig.up == (0, 0, 1) and rig.forward == (1, 0, 0)


def test_woodscape_turns_vectors_of_the_camera_to_the_vehicle(tmp_path):
    content, paths = json.loads(file_text("woodscape.json")), []
    for name, turn in zip(("FV", "MVL", "RV"), TURNS, strict=True):
        back = np.linalg.inv(turn)
        quaternion = Rotation.from_matrix(back[:3, :3]).as_quat().tolist()  # x, y, z, w
        extrinsic = dict(quaternion=quaternion, translation=back[:3, 3].tolist())
        text = json.dumps(content | dict(name=name, extrinsic=extrinsic))
        paths.append(written(tmp_path / f"00_{name}.json", text))
    lens = load(paths[0], dtype=torch.float64)
    for rig in (Rig.load(tmp_path), Rig.load(paths), Rig.load(map(str, paths), up=(0, 0, 2))):
        assert rig.names == ("FV", "MVL", "RV") and rig.up == (0, 0, 1) and rig.forward == (1, 0, 0)
        for i, turn in enumerate(TURNS):
            local = torch.from_numpy(POINTS @ turn[:3, :3].T + turn[:3, 3])
            expected = lens.project_points(local[None])[0].numpy()
            assert rig.project(POINTS)[0][i] == pytest.approx(expected, abs=1e-6, nan_ok=True)
    front = Rig.load(FILES / "woodscape.json")  # in front of the car, it looks ahead
    assert front["FV"].pose[:3, 2] @ (1, 0, 0) > 0.8 and front["FV"].pose[2, 1] < -0.5
    assert front.names == ("FV",) and front["FV"].pose[:3, 3] == pytest.approx((3.61, 0, 0.72))
    written(paths[1], paths[0].read_text())
    refused("two cameras are called 'FV'", Rig.load, tmp_path)
    refused(f"poses of .*{'cam'}.*are in a camera's frame", Rig.load,
            [paths[0], written(tmp_path / "cam.yaml", chain())])  # fmt: skip


def test_pycolmap_projects_with_its_rig_config(tmp_path):
    path = written(tmp_path / "rig_config.json", rig_config())
    config = pycolmap.read_rig_config(path)[0].cameras
    names = [camera.image_prefix.strip("/") for camera in config]

    def projected(i):
        camera = config[i].camera
        camera.width, camera.height = 600, 400
        points = POINTS if i == 0 else config[i].cam_from_rig * POINTS
        found = [camera.img_from_cam(point) for point in points]
        return np.array([(np.nan, np.nan) if p is None else p for p in found]) - 0.5

    rig = Rig.load(path, image_size=SIZE)
    check(rig, projected)
    assert [*rig.names] == names == ["a", "m", "z"] and rig["a"].size == SIZE
    content = json.loads(rig_config())
    for camera in content[0]["cameras"]:
        del camera["camera_model_name"], camera["camera_params"]
    content[0]["cameras"].reverse()  # COLMAP counts the folders in the order of their names
    written(path, json.dumps(content))
    refused(f"{path}: camera 'z' has no lens: give .*cameras.txt", Rig.load, path)
    row = " OPENCV_FISHEYE 600 400 {} 181 300.5 190.5 " + " ".join(map(str, TERMS)) + "\n"
    rows = written(tmp_path / "cameras.txt", "1" + row.format(180))
    rig = Rig.load(path, cameras=rows)
    assert rig.names == ("z", "m", "a")
    check(Rig({name: rig[name] for name in "amz"}, up=(0, -1, 0)))
    written(rows, "".join(f"{i}{row.format(170 + i)}" for i in (3, 10, 2)))
    focals = {name: c.lens.focal.item() for name, c in Rig.load(path, cameras=rows).cameras.items()}
    assert focals == {"a": 172, "m": 173, "z": 180}
    written(rows, "".join(f"{i}{row.format(170 + i)}" for i in (3, 10)))
    refused("has 2 cameras, the rig 3", Rig.load, path, cameras=rows)
    for said, change in (
        ("must hold one rig, got 2", lambda c: c.append(c[0])),
        ("one camera must be the ref_sensor, got 0", lambda c: c[0]["cameras"].pop()),
        ("two cameras are called 'm'", lambda c: c[0]["cameras"][0].update(image_prefix="m")),
        (r"cam_from_rig_rotation must not be zero", lambda c: c[0]["cameras"][0].update(
            cam_from_rig_rotation=[0, 0, 0, 0])),
        ("cam_from_rig_translation is missing", lambda c: c[0]["cameras"][0].pop(
            "cam_from_rig_translation")),
    ):  # fmt: skip
        wrong = json.loads(json.dumps(content))
        change(wrong)
        written(rows, "1" + row.format(180))
        refused(said, Rig.load, written(path, json.dumps(wrong)), cameras=rows)


def test_kitti360_takes_points_of_the_camera_to_the_imu(tmp_path):
    rig = Rig.load(kitti360(tmp_path / "calibration"))
    assert rig.names == ("image_02", "image_03") and rig.up == (0, 0, -1)
    assert rig.forward == (1, 0, 0)
    for name, turn in zip(rig.names, TURNS[1:], strict=True):
        assert rig[name].pose == pytest.approx(np.linalg.inv(turn))
        own = load(FILES / f"kitti360_{name[6:]}.yaml", dtype=torch.float64)
        assert to_dict(own) == to_dict(rig[name].lens)
    folder = kitti360(tmp_path / "short", image_03=[1, 2])
    refused("image_03 must be 3×4 or 4×4 numbers", Rig.load, folder)
    (folder / "calib_cam_to_pose.txt").write_text("image_02: " + "1 0 0 0 " * 3)
    refused("image_02: its pose holds no rotation", Rig.load, folder)
    for path in folder.glob("*.yaml"):
        path.unlink()
    refused("image_02.yaml and image_03.yaml must stand beside", Rig.load, folder)


def test_the_direction_of_a_matrix_is_asked_for_by_one_word(tmp_path):
    path = written(tmp_path / "rig.json", with_matrix())
    refused("does not say which way its poses go: give `direction`", Rig.load, path, up=(0, 1, 0))
    refused("direction must be camera_to_rig or rig_to_camera", Rig.load, path, direction="up")
    refused("give `up`", Rig.load, path, direction="rig_to_camera")
    check(Rig.load(path, direction="rig_to_camera", up=(0, -1, 0)))
    back = Rig.load(path, direction="camera_to_rig", up=(0, -1, 0))
    assert back["c2"].pose == pytest.approx(TURNS[2])
    for i, (key, entry) in enumerate(json.loads(with_matrix()).items()):  # a file for each
        entry["extrinsics"] = dict(rows=4, cols=4, data=np.ravel(entry.pop("T")).tolist())
        written(tmp_path / f"{key}.yaml", yaml.safe_dump(entry))
        assert i < 3
    path.unlink()
    rig = Rig.load(tmp_path, direction="rig_to_camera", up=(0, -1, 0))
    assert rig.names == ("c0", "c1", "c2")
    check(rig)


def test_our_own_file_keeps_all_of_a_rig(tmp_path):
    lenses = [LENS, DoubleSphere(-0.2, 0.6, 150.0, theta_max=2.0), OCam([-200.0, 0, 1e-3])]
    cameras = {f"[ {i} ]": (lens, SIZE, p) for i, (lens, p) in
               enumerate(zip(lenses, poses(2, 3), strict=True))}  # fmt: skip
    rig = Rig(cameras, up=(1, 2, 3), forward=(3, 1, 0)).raised(1.0)
    path = tmp_path / "folder" / "rig.json"
    rig.save(path)
    again = Rig.load(path)
    assert (again.names, again.up, again.forward) == (rig.names, rig.up, rig.forward)
    for name, camera in rig.cameras.items():
        assert (again[name].pose == camera.pose).all() and again[name].size == camera.size
        assert to_dict(again[name].lens) == to_dict(camera.lens)
    content = json.loads(path.read_text())
    assert "camera's frame" in content["about"] and content["direction"] == "camera_to_rig"
    refused("`direction` must be None", Rig.load, path, direction="camera_to_rig")
    for said, change in (
        (r"\[ 0 \].*pose is missing", lambda c, first: first.pop("pose")),
        (r"\[ 0 \].*pose must be 3×4", lambda c, first: first.update(pose=[[1, 2], [3, 4]])),
        (r"\[ 0 \].*pose must be a finite", lambda c, first: first.update(pose=[["a"] * 4] * 4)),
        (r"\[ 0 \].*size", lambda c, first: first.update(size=[1])),
        (r"\[ 0 \].*lens must be a mapping", lambda c, first: first.update(lens=3)),
        (r"\[ 0 \].*model", lambda c, first: first.update(lens={})),
        (r"\[ 0 \].*must be a mapping", lambda c, first: c["cameras"].update({"[ 0 ]": 3})),
        ("up must be 3 finite", lambda c, first: c.update(up=[1, None, 2])),
        ("direction must be one of", lambda c, first: c.update(direction="out")),
    ):
        content = json.loads(path.read_text())
        change(content, content["cameras"]["[ 0 ]"])
        wrong = written(tmp_path / "wrong.json", json.dumps(content))
        refused(f"{re.escape(str(wrong))}.*{said}", Rig.load, wrong)


def test_a_written_camchain_is_read_back(tmp_path):
    lens, brown = KannalaBrandt(180.0, radial=TERMS.tolist(), theta_max=1.4), BrownConrady
    cameras = dict(zip("ab", ((lens, SIZE, pose) for pose in poses(8, 2)), strict=True))
    cameras["c"] = (
        brown(300.0, radial=[0.1, -0.05], tangential=[0.001, 0.002]),
        SIZE,
        poses(9, 1)[0],
    )
    rig, path = Rig(cameras), tmp_path / "camchain.yaml"
    rig.save(path)
    again = Rig.load(path)
    assert again.names == ("cam0", "cam1", "cam2") and "/b/image_raw" in path.read_text()
    first = np.linalg.inv(rig["a"].pose)
    for ours, theirs in zip(rig.cameras.values(), again.cameras.values(), strict=True):
        assert theirs.pose == pytest.approx(first @ ours.pose, abs=1e-12)
        assert theirs.size == SIZE and type(theirs.lens) is type(ours.lens)
        assert (theirs.lens.focal == ours.lens.focal).all()
        assert (theirs.lens.radial == ours.lens.radial).all()
    Rig({"a": (lens, SIZE, np.eye(4))}).save(path)
    assert Rig.load(path).names == ("cam0",)
    wide = Rig({"w": (Equidistant(120.0, theta_max=1.8), SIZE, np.eye(4))})
    with pytest.warns(UserWarning, match="no pixels for rays of 90°"):
        wide.save(path)
    other = Rig({"o": (OCam([-200.0, 0, 1e-3]), SIZE, np.eye(4))})
    refused("camera o: Kalibr files cannot hold this OCam lens exactly", other.save, path)
    refused("ending must be .json, or .yaml", rig.save, tmp_path / "rig.txt")


def test_errors_name_the_file_and_the_camera(tmp_path):
    content, path = yaml.safe_load(chain()), tmp_path / "rig.yaml"
    for said, change in (
        ("no cam1", lambda c: c.pop("cam1")),
        ("cam2.T_cn_cnm1 is missing", lambda c: c["cam2"].pop("T_cn_cnm1")),
        ("cam1.T_cn_cnm1: its pose holds no rotation",
         lambda c: c["cam1"].update(T_cn_cnm1=np.diag((1, 2, 1, 1)).tolist())),
        ("cam1 has no pose: T_cn_cnm1",
         lambda c: [c[f"cam{i}"].pop("T_cn_cnm1") for i in (1, 2)]),
        ("cam1.intrinsics", lambda c: c["cam1"].pop("intrinsics")),
    ):  # fmt: skip
        wrong = yaml.safe_load(chain())
        change(wrong)
        written(path, yaml.safe_dump(wrong))
        refused(f"{re.escape(str(path))}.*{said}", Rig.load, path)
    del content["cam0"]["resolution"]
    refused("cam0: .*has a size of its", Rig.load, written(path, yaml.safe_dump(content)))
    assert Rig.load(path, image_size=SIZE)["cam0"].size == SIZE
    refused("`direction` must be None", Rig.load, path, direction="rig_to_camera", image_size=SIZE)
    for entries, said in (
        (dict(rvecs=[[1, 2, 3]]), "rvecs must be 3 or 9 numbers for each of 3 cameras, got 3"),
        (dict(Ts=[None] * 9), "Ts must be a finite number"),
        (dict(cam_ids="a,b,a"), "appears twice"),
    ):
        text = {k: v.tolist() if isinstance(v, np.ndarray) else v
                for k, v in multi_view(**entries).items()}  # fmt: skip
        refused(f"{path}.*{said}", Rig.load, written(path, json.dumps(text)))
    del text["rvecs"], text["cam_ids"]
    refused("Rs is missing", Rig.load, written(path, json.dumps(text)))
    for name in ("opencv_stereo.json", "colmap.txt", "ocamcalib.txt"):
        refused(f"{name}: it has no poses: files of rigs are", Rig.load, FILES / name)
    refused("there are no files", Rig.load, [])
    (tmp_path / "empty").mkdir()
    refused("there are no files", Rig.load, tmp_path / "empty")
    refused("No such file", Rig.load, tmp_path / "none.json", error=FileNotFoundError)
    deep = '{"cameras": {"a": {"pose": [1], "x": ' + "[" * 900 + "]" * 900 + "}}}"
    refused(str(path), Rig.load, written(path, deep), direction="camera_to_rig")


# 40 in `make test`.
COUNT = 2 * hypothesis.settings().max_examples
TEXTS = {"camchain": chain, "rig_config": rig_config, "matrices": with_matrix,
         "woodscape": lambda: file_text("woodscape.json")}  # fmt: skip
VALUES = ("abc", "NaN", "-1", "0", "1e308", "9" * 400, "[]", "{}", "[[1]]", "[" * 50, "null", "true",
          '""', "\0", "1 2", '{"a": 1}')  # fmt: skip


@pytest.mark.parametrize("name", [*TEXTS, "own", "views"])
def test_a_changed_file_gives_a_rig_or_an_error_of_one_line(name, tmp_path):
    path, rng = tmp_path / "file", random.Random(0)
    if name == "own":
        Rig({"a": (LENS, SIZE, TURNS[1]), "b": (LENS, SIZE, TURNS[2])}).save(tmp_path / "a.json")
        text = (tmp_path / "a.json").read_text()
    elif name == "views":
        views = multi_view().items()
        text = json.dumps({k: v if isinstance(v, str) else v.tolist() for k, v in views})
    else:
        text = TEXTS[name]()
    direction = "camera_to_rig" if name == "matrices" else None
    for _ in range(COUNT):
        words = [*re.finditer(r'"?[\w./+-]+"?', text)]
        changed = text
        for word in sorted(rng.sample(words, rng.choice((1, 1, 2))), key=lambda m: -m.start()):
            new = rng.choice((*VALUES, "", rng.choice(words)[0]))
            changed = changed[: word.start()] + new + changed[word.end() :]
        path.write_text(changed)
        with warnings.catch_warnings(), few_calls(1_000_000):
            warnings.simplefilter("ignore")
            try:
                rig = Rig.load(path, direction=direction, up=(0, -1, 0.1), image_size=SIZE)
            except ValueError as error:
                assert str(path) in str(error) and "\n" not in str(error), changed
                assert len(str(error)) < 1200
            else:
                assert all(np.isfinite(camera.pose).all() for camera in rig.cameras.values())
