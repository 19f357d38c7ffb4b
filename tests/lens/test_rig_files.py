"""Files of rigs: each program's own arithmetic projects points where the rig does."""

import itertools
import json
import random
import re
import warnings

import cv2
import hypothesis
import numpy as np
import pytest
import torch
import yaml
from helpers import few_calls, refused
from lens_examples import FILES, K, file_text, poses
from scipy.spatial.transform import Rotation

from darswin import Rig
from darswin.lens import BrownConrady, DoubleSphere, Equidistant, KannalaBrandt, OCam, to_dict
from darswin.lens import load as load_lens

SIZE = (960, 1280)
TERMS = [0.02, -0.003, 0.001, -0.0002]
LENS = KannalaBrandt(421.3, radial=TERMS, theta_max=1.5, center=(643.1, 478.6))
POINTS = np.random.default_rng(1).normal(size=(300, 3)) * 3
TURNS = poses(5, 3)  # rig → camera; the rig's frame is that of the first one
TURNS[0] = np.eye(4)
BACK = [np.linalg.inv(turn) for turn in TURNS]


def kalibr(**poses_of) -> dict:
    """Cameras with these matrices, one list for each key."""
    plain = dict(camera_model="pinhole", distortion_model="equidistant", distortion_coeffs=TERMS,
                 intrinsics=[421.3, 420.9, 643.1, 478.6], resolution=[1280, 960])  # fmt: skip
    rows = [[(k, m.tolist()) for m in matrices] for k, matrices in poses_of.items()]
    return {f"cam{i}": plain | dict(row) for i, row in enumerate(zip(*rows, strict=True))}


def chain() -> dict:
    """Of each camera, the pose of the one before it, which cam0 lacks; and that of an IMU."""
    steps = [turn @ np.linalg.inv(before) for before, turn in itertools.pairwise(TURNS)]
    content = kalibr(T_cn_cnm1=[np.eye(4), *steps], T_cam_imu=TURNS)
    del content["cam0"]["T_cn_cnm1"]
    return content


def views(**entries) -> dict:
    """What OpenCV's sample of calibrateMultiview writes."""
    turns = np.array(TURNS)
    return dict(
        Ks=np.array([K] * 3), distortions=np.array([TERMS] * 3), is_fisheye=np.array([1, 1, 1]),
        image_sizes=np.array([[1280, 960]] * 3), cam_ids="l,m,r", Ts=turns[:, :3, 3:],
        rvecs=np.stack([cv2.Rodrigues(turn[:3, :3])[0] for turn in turns]),
    ) | entries  # fmt: skip


def colmap() -> list:
    params = [421.3, 420.9, 643.6, 479.1, *TERMS]  # its pixels begin at 0.5
    cameras = [dict(image_prefix=f"{name}/", camera_model_name="OPENCV_FISHEYE",
                    camera_params=params) for name in "amz"]  # fmt: skip
    cameras[0]["ref_sensor"] = True
    for camera, turn in zip(cameras[1:], TURNS[1:], strict=True):
        x, y, z, w = Rotation.from_matrix(turn[:3, :3]).as_quat().tolist()
        offset = turn[:3, 3].tolist()
        camera |= dict(cam_from_rig_rotation=[w, x, y, z], cam_from_rig_translation=offset)
    return [{"cameras": cameras}]


def matrices() -> dict:
    """Cameras of OpenCV, each with a matrix whose direction the file does not say."""
    plain = dict(K=K, D=TERMS, fisheye=1, width=1280, height=960)
    return {f"c{i}": plain | dict(T=turn.tolist()) for i, turn in enumerate(TURNS)}


def woodscape(name="FV", back=BACK[1]) -> dict:
    quaternion = Rotation.from_matrix(back[:3, :3]).as_quat().tolist()  # x, y, z, w
    extrinsic = dict(quaternion=quaternion, translation=back[:3, 3].tolist())
    return json.loads(file_text("woodscape.json")) | dict(name=name, extrinsic=extrinsic)


def own() -> dict:
    lens = dict(model="KannalaBrandt", focal=421.3, radial=TERMS, center=[643.1, 478.6],
                affine=[[1, 0], [0, 420.9 / 421.3]])  # fmt: skip
    cameras = {f"c{i}": dict(lens=lens, size=[960, 1280], pose=back.tolist())
               for i, back in enumerate(BACK)}  # fmt: skip
    return dict(direction="camera_to_rig", up=[0, -1, 0], forward=[0, 0, 1], cameras=cameras)


def written(path, content):
    text = content if isinstance(content, str) else json.dumps(content, default=np.ndarray.tolist)
    path.write_text(text)
    return path


def check(rig, projected=None):
    """The rig sees points where OpenCV does, with R and T, or where another function does."""
    pixels, _ = rig.project(POINTS)
    assert len(rig) == 3
    for i, turn in enumerate(TURNS):
        vector = cv2.Rodrigues(turn[:3, :3])[0]
        args = POINTS[:, None], vector, turn[:3, 3], np.array(K), np.array(TERMS)
        expected = projected(i) if projected else cv2.fisheye.projectPoints(*args)[0][:, 0]
        known = ~np.isnan(pixels[i]).any(1) & ((POINTS @ turn[2, :3] + turn[2, 3]) > 0)
        assert known.sum() > 50 and pixels[i, known] == pytest.approx(expected[known], abs=1e-6)


@pytest.mark.parametrize("end", ["yaml", "xml", "json", "npz"])
def test_opencv_projects_with_r_and_t_of_its_multi_view_file(end, tmp_path):
    turns, path = np.array(TURNS), tmp_path / f"views.{end}"
    with_matrices = views(Rs=turns[:, :3, :3])
    del with_matrices["rvecs"]
    flat = views(Ts=turns[:, :3, 3], rvecs=views()["rvecs"][..., 0])
    for entries in (views(), flat, with_matrices):
        if end == "npz":
            np.savez(path, **entries | dict(cam_ids=["l", "m", "r"]))
        else:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
            for name, value in entries.items():
                storage.write(name, value)
            storage.release()
        rig = Rig.load(path)
        check(rig)
        assert (rig.names, rig.up, rig.forward) == (("l", "m", "r"), (0, -1, 0), (0, 0, 1))


def test_opencv_finds_the_poses_that_its_pictures_were_made_with(tmp_path):
    rng, turns = np.random.default_rng(0), [np.eye(4) for _ in range(3)]
    for i in (1, 2):
        turns[i][:3] = np.column_stack((cv2.Rodrigues((0, 0.2 * i, 0.1))[0], (0.2 * i, 0.05, 0)))
    board = np.array([[x, y, 0] for y in range(6) for x in range(8)], np.float32) * np.float32(0.1)
    seen, known = [[], [], []], (np.array(K), np.array(TERMS))
    for _ in range(12):
        at = rng.uniform((-0.5, -0.4, 1.2), (0.1, 0.1, 1.3))
        points = board @ cv2.Rodrigues(0.3 * rng.normal(size=3))[0].T + at
        for turn, pixels in zip(turns, seen, strict=True):
            args = points[:, None], cv2.Rodrigues(turn[:3, :3])[0], turn[:3, 3], *known
            pixels.append(cv2.fisheye.projectPoints(*args)[0][:, 0].astype(np.float32))
    _, matrices, terms, rotations, offsets = cv2.calibrateMultiview(
        [board] * 12, seen, [(1280, 960)] * 3, np.ones((3, 12), np.uint8),
        np.full(3, cv2.CALIB_MODEL_FISHEYE, np.uint8), [known[0]] * 3, [known[1]] * 3, None, None,
        None, cv2.CALIB_USE_INTRINSIC_GUESS,
    )[:5]  # fmt: skip
    content = views(Ks=matrices, distortions=terms, Rs=np.array(rotations), Ts=np.array(offsets))
    del content["rvecs"]
    content = {key: np.array(value).tolist() for key, value in content.items()}
    rig = Rig.load(written(tmp_path / "views.json", content))
    for turn, camera in zip(turns, rig.cameras.values(), strict=True):
        assert np.linalg.inv(camera.pose) == pytest.approx(turn, abs=1e-6)


def test_kalibr_leads_from_each_camera_to_the_next_or_from_the_imu(tmp_path):
    path, content = tmp_path / "camchain.yaml", chain()
    rig = Rig.load(written(path, yaml.safe_dump(content)), up=(0, -0.1, -2))  # it looks down
    check(rig)
    assert rig.names == ("cam0", "cam1", "cam2") and rig.forward == (0, -1, 0)
    point = np.array((0.3, -0.2, 0.9, 1))
    moved = content["cam2"]["T_cn_cnm1"] @ (content["cam1"]["T_cn_cnm1"] @ point)
    assert np.linalg.inv(rig["cam2"].pose) @ point == pytest.approx(moved)
    assert Rig.load(path, height=1.5)["cam0"].pose[:3, 3] == pytest.approx((0, -1.5, 0))
    for content in (kalibr(T_cam_imu=TURNS), kalibr(T_imu_cam=BACK)):  # of Kalibr, of open_vins
        written(path, content)
        refused(rf"^rig {path}: .* does not say which way is up .*give `up`", Rig.load, path)
        rig = Rig.load(path, up=(0, 0, 9.81))
        check(rig)
        assert rig.up == (0, 0, 1) and rig.forward == (1, 0, 0)


def test_woodscape_turns_vectors_of_the_camera_to_the_vehicle(tmp_path):
    names = ("FV", "MVL", "RV")
    paths = [written(tmp_path / f"00_{name}.json", woodscape(name, back))
             for name, back in zip(names, BACK, strict=True)]  # fmt: skip
    lens = load_lens(paths[0], dtype=torch.float64)

    def projected(i):
        local = torch.from_numpy(POINTS @ TURNS[i][:3, :3].T + TURNS[i][:3, 3])
        return lens.project_points(local[None])[0].numpy()

    for rig in (Rig.load(tmp_path), Rig.load(paths), Rig.load(map(str, paths), up=(0, 0, 2))):
        assert (rig.names, rig.up, rig.forward) == (names, (0, 0, 1), (1, 0, 0))
        check(rig, projected)
    front = Rig.load(FILES / "woodscape.json")["FV"].pose  # at the front of a car, it looks ahead
    assert (
        front[0, 2] > 0.8 and front[2, 1] < -0.5 and front[:3, 3] == pytest.approx((3.61, 0, 0.72))
    )
    written(paths[1], woodscape())
    refused("two cameras are called FV", Rig.load, tmp_path)
    other = written(tmp_path / "cam.yaml", chain())
    refused(f"^rig .*{other}: its poses are in a camera's frame", Rig.load, [paths[0], other])


def test_pycolmap_projects_with_its_rig_config(tmp_path):
    import pycolmap  # 130 MB that no other test needs

    path, rows = written(tmp_path / "rig_config.json", colmap()), tmp_path / "cameras.txt"
    config = pycolmap.read_rig_config(path)[0].cameras

    def projected(i):
        camera = config[i].camera
        camera.width, camera.height = 1280, 960
        found = map(camera.img_from_cam, config[i].cam_from_rig * POINTS if i else POINTS)
        return np.array([(np.nan, np.nan) if at is None else at for at in found]) - 0.5

    rig = Rig.load(path, image_size=SIZE)
    check(rig, projected)
    assert rig.names == ("a", "m", "z") == tuple(c.image_prefix.strip("/") for c in config)
    content = colmap()
    for camera in content[0]["cameras"]:
        del camera["camera_model_name"], camera["camera_params"]
    content[0]["cameras"].reverse()  # COLMAP counts the folders in the order of their names
    written(path, content)
    refused(f"^rig {path}: camera 'z' has no lens: give .*cameras.txt", Rig.load, path)
    row = " OPENCV_FISHEYE 1280 960 {} 420.9 643.6 479.1 " + " ".join(map(str, TERMS)) + "\n"
    rig = Rig.load(path, cameras=written(rows, "1" + row.format(421.3)))
    assert rig.names == ("z", "m", "a")
    check(Rig({name: rig[name] for name in "amz"}))
    written(rows, "".join(f"{i}{row.format(420 + i)}" for i in (3, 10, 2)))
    focals = {name: c.lens.focal.item() for name, c in Rig.load(path, cameras=rows).cameras.items()}
    assert focals == {"a": 422, "m": 423, "z": 430}
    written(rows, "".join(f"{i}{row.format(420 + i)}" for i in (3, 10)))
    refused("has 2 cameras, the rig 3", Rig.load, path, cameras=rows)


def test_kitti360_takes_points_of_the_camera_to_the_imu(tmp_path):
    said = tmp_path / "calib_cam_to_pose.txt"
    lines = [f"image_0{i}: {' '.join(map(str, BACK[i - 1][:3].ravel()))}\n" for i in (2, 3)]
    written(said, "".join(lines))
    refused("image_02.yaml and image_03.yaml must stand beside", Rig.load, tmp_path)
    for i in (2, 3):
        written(tmp_path / f"image_0{i}.yaml", file_text(f"kitti360_0{i}.yaml"))
    rig = Rig.load(tmp_path)
    assert (rig.names, rig.up, rig.forward) == (("image_02", "image_03"), (0, 0, -1), (1, 0, 0))
    for i, (name, camera) in enumerate(rig.cameras.items(), 1):
        assert camera.pose == pytest.approx(BACK[i])
        lens = load_lens(FILES / f"kitti360_{name[6:]}.yaml", dtype=torch.float64)
        assert to_dict(lens) == to_dict(camera.lens)
    refused("image_03 is missing", Rig.load, written(said, lines[0]).parent)
    written(said, lines[0] + "image_03: 1 2")
    refused("image_03 must be 3×4 or 4×4 numbers", Rig.load, tmp_path)
    refused("lines of a camera", Rig.load, written(said, "1 2\n").parent)


def test_the_direction_of_a_matrix_is_asked_for_by_one_word(tmp_path):
    path = written(tmp_path / "rig.json", matrices())
    refused("does not say which way its poses go: give `direction`", Rig.load, path, up=(0, 1, 0))
    refused("direction must be camera_to_rig or rig_to_camera", Rig.load, path, direction="up")
    refused("give `up`", Rig.load, path, direction="rig_to_camera")
    check(Rig.load(path, direction="rig_to_camera", up=(0, -1, 0)))
    back = Rig.load(path, direction="camera_to_rig", up=(0, -1, 0))
    assert back["c2"].pose == pytest.approx(TURNS[2])
    path.unlink()
    for name, entry in matrices().items():  # a file for each
        data = np.ravel(entry.pop("T"))
        written(tmp_path / f"{name}.json", entry | dict(extrinsics=dict(rows=4, cols=4, data=data)))
    rig = Rig.load(tmp_path, direction="rig_to_camera", up=(0, -1, 0))
    assert rig.names == ("c0", "c1", "c2")
    check(rig)


def test_our_own_file_keeps_all_of_a_rig(tmp_path):
    check(Rig.load(written(tmp_path / "own.json", own())))
    lenses = LENS, DoubleSphere(-0.2, 0.6, 150.0, theta_max=2.0), OCam([-200.0, 0, 1e-3], 2.0)
    cameras = zip(lenses, itertools.repeat(SIZE), poses(2, 3), strict=False)
    rig = Rig({f"[ {i} ]": c for i, c in enumerate(cameras)}, up=(1, 2, 3), forward=(3, 1, 0))
    rig.raised(1.0).save(tmp_path / "folder" / "rig.json")
    again = Rig.load(tmp_path / "folder" / "rig.json", height=-1.0)
    assert (again.names, again.up, again.forward) == (rig.names, rig.up, rig.forward)
    for name, camera in rig.cameras.items():
        assert again[name].pose == pytest.approx(camera.pose) and again[name].size == SIZE
        assert to_dict(again[name].lens) == to_dict(camera.lens)
    rig.save(tmp_path / "rig.json")
    assert (Rig.load(tmp_path / "rig.json")["[ 2 ]"].pose == rig["[ 2 ]"].pose).all()
    assert "camera's frame" in json.loads((tmp_path / "rig.json").read_text())["about"]


def test_a_written_camchain_is_read_back(tmp_path):
    brown, path = BrownConrady(300.0, radial=[[0.1, -0.05]]), tmp_path / "camchain.yaml"
    lenses = zip((LENS, LENS, brown), itertools.repeat(SIZE), poses(8, 3), strict=False)
    rig = Rig(dict(zip("abc", lenses, strict=True)))
    rig.save(path)
    again, first = Rig.load(path), np.linalg.inv(rig["a"].pose)
    assert again.names == ("cam0", "cam1", "cam2") and "/b/image_raw" in path.read_text()
    for ours, theirs in zip(rig.cameras.values(), again.cameras.values(), strict=True):
        assert theirs.pose == pytest.approx(first @ ours.pose, abs=1e-12)
        assert theirs.size == SIZE and type(theirs.lens) is type(ours.lens)
        assert (theirs.lens.focal == ours.lens.focal) & (
            theirs.lens.radial == ours.lens.radial
        ).all()
    Rig({"a": (LENS, SIZE, np.eye(4))}).save(path)
    assert Rig.load(path).names == ("cam0",)
    with pytest.warns(UserWarning, match="no pixels for rays of 90°"):
        Rig({"w": (Equidistant(120.0, theta_max=1.8), SIZE, np.eye(4))}).save(path)
    other = Rig({"o": (OCam([-200.0, 0, 1e-3]), SIZE, np.eye(4))})
    refused("camera o: Kalibr files cannot hold this OCam lens exactly", other.save, path)
    refused("ending must be .json, or .yaml", rig.save, tmp_path / "rig.txt")


SCALED = np.diag((1, 2, 1, 1)).tolist()
WRONG = [
    (chain, "no cam1", lambda c: c.pop("cam1")),
    (chain, "cam2.T_cn_cnm1 is missing", lambda c: c["cam2"].pop("T_cn_cnm1")),
    (chain, "cam1.*holds no rotation", lambda c: c["cam1"].update(T_cn_cnm1=SCALED)),
    (chain, "cam1.intrinsics is missing", lambda c: c["cam1"].pop("intrinsics")),
    (chain, "cam0: .*has a size of its", lambda c: c["cam0"].pop("resolution")),
    (lambda: kalibr(T_cam_imu=TURNS), "cam1 has no pose", lambda c: c["cam1"].pop("T_cam_imu")),
    (views, "rvecs must be 3 or 9 numbers for each of 3 cameras, got 1",
     lambda c: c.update(rvecs=[1])),
    (views, "Ts must be a finite number", lambda c: c.update(Ts=[None] * 9)),
    (views, "Rs must be 3 or 9 .*missing|Rs is missing", lambda c: c.pop("rvecs")),
    (views, "appears twice", lambda c: c.update(cam_ids="a,b,a")),
    (colmap, "must hold one rig, got 2", lambda c: c.append(c[0])),
    (colmap, "one camera must be the ref_sensor, got 2",
     lambda c: c[0]["cameras"][1].update(ref_sensor=True)),
    (colmap, "'m' appears twice", lambda c: c[0]["cameras"][0].update(image_prefix="m")),
    (colmap, "rotation must not be zero",
     lambda c: c[0]["cameras"][1].update(cam_from_rig_rotation=[0] * 4)),
    (colmap, "translation is missing",
     lambda c: c[0]["cameras"][1].pop("cam_from_rig_translation")),
    (colmap, "'a' has no lens", lambda c: c[0]["cameras"][0].pop("camera_model_name")),
    (woodscape, "translation is missing", lambda c: c["extrinsic"].pop("translation")),
    (own, "c0.pose is missing", lambda c: c["cameras"]["c0"].pop("pose")),
    (own, "c0.pose must be 3×4", lambda c: c["cameras"]["c0"].update(pose=[[1, 2], [3, 4]])),
    (own, "c0.pose must be a finite", lambda c: c["cameras"]["c0"].update(pose=[["a"] * 4] * 4)),
    (own, "c0.size must be two", lambda c: c["cameras"]["c0"].update(size=[1])),
    (own, "c0.lens must be a mapping", lambda c: c["cameras"]["c0"].update(lens=3)),
    (own, "camera 'c0'.*entries are none", lambda c: c["cameras"]["c0"].update(lens={})),
    (own, "c0 must be a mapping", lambda c: c["cameras"].update(c0=3)),
    (own, r"up\[1\] must be a finite", lambda c: c.update(up=[1, None, 2])),
    (own, "direction must be one of", lambda c: c.update(direction="out")),
]  # fmt: skip


@pytest.mark.parametrize(("make", "said", "change"), WRONG, ids=[said for _, said, _ in WRONG])
def test_errors_name_the_file_and_the_camera(make, said, change, tmp_path):
    content, path = make(), tmp_path / "rig"
    size = SIZE if make is colmap else None
    change(content)
    refused(f"{path}: .*({said})", Rig.load, written(path, content), up=(0, -1, 0), image_size=size)


def test_what_is_no_file_of_a_rig(tmp_path):
    for name in ("opencv_stereo.json", "colmap.txt", "ocamcalib.txt"):
        refused(f"{name}: it has no poses: files of rigs are", Rig.load, FILES / name)
    for make in (chain, views, woodscape, own, colmap):
        path = written(tmp_path / "rig", make())
        options = dict(direction="camera_to_rig", image_size=SIZE)
        refused(f"^rig {path}: .*leave out `direction`", Rig.load, path, **options)
    refused("there are no files", Rig.load, [])
    refused("No such file", Rig.load, tmp_path / "none.json", error=FileNotFoundError)
    deep = '{"a": {"pose": [1], "x": ' + "[" * 900 + "]" * 900 + "}}"
    refused(str(path), Rig.load, written(path, deep), direction="camera_to_rig")


VALUES = ("abc", "NaN", "-1", "0", "1e308", "9" * 400, "[]", "{}", "[[1]]", "[" * 50, "null",
          "true", '""', "\0", "1 2", '{"a": 1}')  # fmt: skip


@pytest.mark.parametrize("make", [chain, views, colmap, matrices, woodscape, own])
def test_a_changed_file_gives_a_rig_or_an_error_of_one_line(make, tmp_path):
    path, rng = tmp_path / "file", random.Random(0)
    text = written(path, make()).read_text()
    words = [*re.finditer(r'"?[\w./+-]+"?', text)]
    options = dict(direction="camera_to_rig") if make is matrices else {}
    for _ in range(2 * hypothesis.settings().max_examples):
        changed = text
        for word in sorted(rng.sample(words, rng.choice((1, 1, 2))), key=lambda m: -m.start()):
            new = rng.choice((*VALUES, "", rng.choice(words)[0]))
            changed = changed[: word.start()] + new + changed[word.end() :]
        with warnings.catch_warnings(), few_calls(1_000_000):
            warnings.simplefilter("ignore")
            try:
                written(path, changed)
                rig = Rig.load(path, up=(0, -1, 0.1), image_size=SIZE, **options)
            except ValueError as error:
                said = str(error)
                assert str(path) in said and "\n" not in said and len(said) < 1200, changed
            else:
                assert all(np.isfinite(camera.pose).all() for camera in rig.cameras.values())
