"""Files of rigs: what the poses of each program mean, and our own JSON."""

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml

from darswin.lens.base import Lens, to_dict
from darswin.lens.files.content import decoded, parse, read_bytes
from darswin.lens.files.fields import Fields, listed, short, to_flag, to_number
from darswin.lens.files.load import Calibration
from darswin.lens.files.named import KALIBR
from darswin.lens.files.opencv import numbers_of
from darswin.lens.files.save import warn_of_rays_beyond
from darswin.lens.files.woodscape import camera_to_vehicle
from darswin.lens.image import Size
from darswin.utils.files import replace_file
from darswin.utils.parameters import naming
from darswin.utils.poses import from_quaternion, from_rotation_vector, inverse, to_pose
from darswin.utils.text import mapping

DIRECTIONS = ("camera_to_rig", "rig_to_camera")
# A camera's matrix in our own files, and in others that do not say its direction.
MATRIX = ("pose", "extrinsics", "extrinsic", "T")
KITTI = "calib_cam_to_pose.txt"
SUFFIXES = (".json", ".yaml", ".yml", ".xml")  # of the files that are read in a folder
_ABOUT = (
    "A rig of darswin. pose takes points of the camera's frame (x right, y down, z forward) to the "
    "rig's, in metres. up, away from gravity, and forward are in the rig's frame. size is the "
    "height and width of the pictures, px."
)
_RIGS = (
    "files of rigs are those of Kalibr, OpenCV's calibrateMultiview, COLMAP (rig_config.json), "
    f"WoodScape, KITTI-360 (a folder with {KITTI}), and our own JSON"
)

Vector = Sequence[float]
# The pose of each camera, up if the file says it, and whether the frame is that of a camera.
Read = tuple[dict[str, np.ndarray], Vector | None, bool]
Parts = tuple[Lens, Size, np.ndarray]


class Found(NamedTuple):
    """What files say of a rig.

    Attributes: cameras: for each name the lens; (H, W) of its pictures, or None for the lens's
    image_size; and the pose (4, 4), camera → rig. up, forward: in the rig's frame, or None if the
    files do not say. in_camera: True if that is the frame of a camera.
    """

    cameras: dict[str, Parts]
    up: Vector | None = None
    forward: Vector | None = None
    in_camera: bool = False


class Reader(NamedTuple):
    """Reads files of rigs. The attributes are the options of `Rig.load`."""

    direction: str | None = None
    cameras: str | os.PathLike | None = None
    coefficients: str | None = None
    image_size: Size = None

    def read(self, path: Any) -> Found:
        """The rig of a file, a folder or several files. Raises ValueError and OSError."""
        if self.direction not in (None, *DIRECTIONS):
            raise ValueError(f"direction must be {' or '.join(DIRECTIONS)}, got {self.direction!r}")
        paths = [*map(Path, [path] if isinstance(path, (str, os.PathLike)) else path)]
        if len(paths) == 1 and paths[0].is_dir():
            if (paths[0] / KITTI).exists():
                return self._kitti360(paths[0])
            paths = sorted(p for p in paths[0].iterdir() if p.suffix.lower() in SUFFIXES)
        if not paths:
            raise ValueError(f"there are no files ({', '.join(SUFFIXES)}), and no {KITTI}")
        cameras, ups = dict[str, Parts](), set()
        for one in paths:
            with about(one):
                found = self._file(one)
                if len(paths) == 1:
                    return found
                if found.in_camera:
                    raise ValueError("its poses are in a camera's frame: give it alone")
                if twice := cameras.keys() & found.cameras:
                    raise ValueError(f"two cameras are called {listed(twice)}")
            cameras |= found.cameras
            ups.add(found.up and (*found.up,))
        return Found(cameras, ups.pop() if len(ups) == 1 else None)

    def _file(self, path: Path) -> Found:
        text = decoded(read_bytes(path))
        if text.lstrip().startswith("["):
            return self._colmap(parse(f'{{"rigs": {text}}}'))
        content = parse(text)
        if isinstance(content, Mapping) and (names := _with_matrix(content)):
            return self._matrices(path, Fields(content), names)
        file = Calibration(text, os.fspath(path), self.coefficients)
        read = _POSES.get(file.format.name)
        if read is None or isinstance(file.fields, list):
            raise ValueError(f"{file.what}: it has no poses: {_RIGS}")
        poses, up, in_camera = read(file.fields, file.names)
        self._goes(DIRECTIONS[0])
        lenses = file.lenses(image_size=self.image_size, dtype=torch.float64)
        cameras: dict[str, Parts] = {
            path.stem if name == "camera" else name: (lenses[name], None, pose)
            for name, pose in poses.items()
        }
        return Found(cameras, up, None, in_camera)

    def _goes(self, said: str | None) -> str:
        """The direction of poses, by the file or by the caller, not by both."""
        if (said is None) is (self.direction is None):
            text = "the file says which way its poses go: leave out `direction`"
            if said is None:
                text = (
                    "the file does not say which way its poses go: give `direction`, camera_to_rig "
                    "if they take points of the camera's frame to the rig's, or rig_to_camera"
                )
            raise naming(ValueError(text), "direction")
        return str(said or self.direction)

    def _lens(self, text: str, name: str) -> Lens:
        file = Calibration(text, f"of camera {short(name)}", self.coefficients)
        return file.lens(image_size=self.image_size, dtype=torch.float64)

    def _matrices(self, path: Path, file: Fields, names: list[str]) -> Found:
        """Our own JSON; and any cameras that `load` reads, each with its matrix."""
        said = file.one_of("direction", DIRECTIONS) if "direction" in file else None
        goes, cameras = self._goes(said), dict[str, Parts]()
        inside = file.section("cameras") if "cameras" in file else file
        for name in names:
            camera = inside.section(name) if name else file
            key = next((key for key in MATRIX if key in camera), MATRIX[0])
            pose = _matrix(camera, key)
            is_own = "lens" in camera
            entries = camera.section("lens").entries if is_own else camera.entries
            text = json.dumps({k: v for k, v in entries.items() if k != key})
            size = camera.sides("size") if is_own else None
            reader, name = self._replace(image_size=None) if is_own else self, name or path.stem
            pose = pose if goes == DIRECTIONS[0] else inverse(pose)
            cameras[name] = reader._lens(text, name), size, pose
        up, forward = (file.numbers(k, (3,)) if k in file else None for k in ("up", "forward"))
        return Found(cameras, up, forward)

    def _colmap(self, content: Any) -> Found:
        rigs = Fields(content).sections("rigs")
        if len(rigs) != 1:
            raise ValueError(f"it must hold one rig, got {len(rigs)}: keep one of them")
        self._goes(DIRECTIONS[1])
        entries = rigs[0].sections("cameras")
        named = mapping((entry.text("image_prefix").strip("/"), entry) for entry in entries)
        lenses, cameras, reference = self._lenses(named), dict[str, Parts](), []
        for name, entry in named.items():
            pose = np.eye(4)
            if "ref_sensor" in entry and to_flag(entry.entries["ref_sensor"], "ref_sensor"):
                reference.append(name)
            else:
                key = "cam_from_rig_rotation"  # w first
                pose[:3, :3] = from_quaternion(entry.path(key), *entry.numbers(key, (4,)))
                pose[:3, 3] = entry.numbers("cam_from_rig_translation", (3,))
            cameras[name] = lenses[name], None, inverse(pose)
        if len(reference) != 1:
            raise ValueError(f"one camera must be the ref_sensor, got {len(reference)}")
        return Found(cameras, in_camera=True)

    def _lenses(self, cameras: Mapping[str, Fields]) -> dict[str, Lens]:
        """The lenses of COLMAP's cameras, in the file `cameras` or beside the poses."""
        if self.cameras is not None:
            file = Calibration.read(self.cameras)
            lenses = file.lenses(image_size=self.image_size, dtype=torch.float64)
            # feature_extractor counts the folders of cameras in the order of their names.
            ids = sorted(lenses, key=lambda name: (len(name), name))
            ids = ids if file.has_several() else ids[:1] * len(cameras)
            if len(ids) != len(cameras):
                raise ValueError(f"{file.what} has {len(ids)} cameras, the rig {len(cameras)}")
            return {name: lenses[i] for name, i in zip(sorted(cameras), ids, strict=True)}
        found = {}
        for name, camera in cameras.items():
            if self.image_size is None or "camera_model_name" not in camera:
                raise ValueError(
                    f"camera {short(name)} has no lens: give the reconstruction's cameras.txt or "
                    "cameras.bin as cameras=, or image_size= beside camera_model_name and "
                    "camera_params in the file"
                )
            words = camera.of_kind("camera_params", list, "numbers")
            kind, (height, width) = camera.text("camera_model_name"), self.image_size
            found[name] = self._lens(" ".join(map(str, (1, kind, width, height, *words))), name)
        return found

    def _kitti360(self, folder: Path) -> Found:
        self._goes(DIRECTIONS[0])
        content, cameras = parse(decoded(read_bytes(folder / KITTI))), dict[str, Parts]()
        if not isinstance(content, Mapping):
            raise ValueError(f"{KITTI} must have lines of a camera, a colon and 12 numbers")
        for path in sorted(folder.glob("image_*.yaml")):
            lens = Calibration.read(path).lens(image_size=self.image_size, dtype=torch.float64)
            cameras[path.stem] = lens, None, _matrix(Fields(content), path.stem)
        if not cameras:
            raise ValueError(f"image_02.yaml and image_03.yaml must stand beside {KITTI}")
        return Found(cameras, (0.0, 0.0, -1.0))


@contextmanager
def about(path: Any) -> Iterator[None]:
    """Adds the file to errors that do not name it."""
    try:
        yield
    except (ValueError, RecursionError) as error:
        if f" {path}:" in f" {error}" or str(error).startswith("rig "):
            raise
        raise ValueError(f"rig {path}: {error}") from error


def write(path: str | os.PathLike, cameras: Mapping[str, Any], up: Vector, forward: Vector) -> None:
    """Writes the parts of a `Rig`, as its `save` says."""
    suffix = Path(path).suffix.lower()
    if suffix == ".json":
        written: dict[str, Any] = {
            name: {"lens": to_dict(lens), "size": [*size], "pose": pose.tolist()}
            for name, (lens, size, pose) in cameras.items()
        }
        head = {"about": _ABOUT, "direction": DIRECTIONS[0], "up": [*up], "forward": [*forward]}
        text = json.dumps(head | {"cameras": written}, indent=2, allow_nan=False) + "\n"
        # Each list of numbers gets a line.
        text = re.sub(r"\[\n[^][{}]*\]", lambda numbers: " ".join(numbers[0].split()), text)
    elif suffix in (".yaml", ".yml"):
        written, before = {}, None
        for i, (name, (lens, size, pose)) in enumerate(cameras.items()):
            try:
                text = KALIBR.write(lens.replace(image_size=torch.tensor([size])), suffix)
            except ValueError as error:
                raise ValueError(f"camera {name}: {error}") from error
            warn_of_rays_beyond(lens, path, "kalibr")
            entry = yaml.safe_load(text)["cam0"] | {"rostopic": f"/{name}/image_raw"}
            if before is not None:
                entry["T_cn_cnm1"] = (inverse(pose) @ before).tolist()
            written[f"cam{i}"], before = entry, pose
        text = yaml.safe_dump(written, default_flow_style=None, width=1000)
    else:
        raise ValueError("its ending must be .json, or .yaml for Kalibr")
    replace_file(path, text)


def _kalibr(file: Fields, names: list[str]) -> Read:
    """T_cn_cnm1 takes points of the previous camera's frame to this one's, T_cam_imu those of the
    IMU's; open_vins' T_imu_cam goes back."""
    poses, pose = {}, np.eye(4)
    cameras = {name: Fields(file.entries.get(name, file.entries), f"{name}.") for name in names}
    in_camera = any("T_cn_cnm1" in camera for camera in cameras.values())
    for i, name in enumerate(sorted(names, key=lambda name: (len(name), name))):
        camera = cameras[name]
        if in_camera and name != f"cam{i}":
            raise ValueError(f"the chain is broken: it has {short(name)}, but no cam{i}")
        if in_camera:
            pose = pose @ inverse(_matrix(camera, "T_cn_cnm1")) if i else pose
        elif "T_imu_cam" in camera:
            pose = _matrix(camera, "T_imu_cam")
        elif "T_cam_imu" in camera:
            pose = inverse(_matrix(camera, "T_cam_imu"))
        elif len(names) > 1:
            raise ValueError(f"{name} has no pose: T_cn_cnm1 (of all but cam0), or T_cam_imu")
        else:  # the only one
            in_camera = True
        poses[name] = pose
    return poses, None, in_camera


def _multi_view(file: Fields, names: list[str]) -> Read:
    """R, or a rotation vector, and T take points of the first camera's frame to each one's."""
    numbers = []
    for key, sizes in (("rvecs" if "rvecs" in file else "Rs", (3, 9)), ("Ts", (3,))):
        expected = f"{' or '.join(map(str, sizes))} numbers for each of {len(names)} cameras"
        values = [to_number(value, key) for value in numbers_of(file.get(key, expected))]
        if len(values) not in [size * len(names) for size in sizes]:
            raise ValueError(f"{key} must be {expected}, got {len(values)}")
        numbers.append(np.reshape(values, (len(names), -1)))
    poses = {}
    for name, turn, offset in zip(names, *numbers, strict=True):
        rotation = turn.reshape(3, 3) if len(turn) == 9 else from_rotation_vector(turn)
        poses[name] = inverse(to_pose(f"camera {name}", np.column_stack((rotation, offset))))
    return poses, None, True


def _woodscape(file: Fields, names: list[str]) -> Read:
    """The quaternion and the translation take points of the camera's frame to the vehicle's."""
    pose = np.eye(4)
    pose[:3, :3] = camera_to_vehicle(file)
    pose[:3, 3] = file.section("extrinsic").numbers("translation", (3,))
    return {names[0]: pose}, (0.0, 0.0, 1.0), False


_POSES: dict[str, Callable[[Fields, list[str]], Read]] = {
    "Kalibr": _kalibr, "OpenCV multi-view": _multi_view, "WoodScape": _woodscape
}  # fmt: skip


def _matrix(camera: Fields, name: str) -> np.ndarray:
    expected, where = "3×4 or 4×4 numbers", camera.path(name)
    numbers = numbers_of(camera.get(name, expected))
    if len(numbers) not in (12, 16):
        raise ValueError(f"{where} must be {expected}, got {short(numbers)}")
    return to_pose(where, np.reshape([to_number(n, where) for n in numbers], (-1, 4)))


def _with_matrix(content: Mapping) -> list[str]:
    """The names of cameras of which each has a matrix; "" for the only one of a file."""
    if any(len(numbers_of(content.get(key))) in (12, 16) for key in MATRIX):
        return [""]
    inside = content.get("cameras", content)
    entries = inside.items() if isinstance(inside, Mapping) else ()
    found = [n for n, c in entries if isinstance(c, Mapping) and not {*MATRIX}.isdisjoint(c)]
    return [*inside] if found and "cameras" in content else found
