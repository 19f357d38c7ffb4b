"""Several cameras that are fixed to each other: on a car, back to back, or the faces of a cube."""

import math
import os
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Self

import numpy as np
import torch

from darswin.lens.base import Lens
from darswin.lens.files import rigs
from darswin.lens.ideal import Perspective
from darswin.lens.image import Size
from darswin.utils.angles import unit_vector
from darswin.utils.parameters import naming
from darswin.utils.poses import ahead_of, frame_of, to_pose

MOST_CAMERAS = 255
# The faces of a cube in the order and by the names of these programs. Their geometry is the same:
# the lower border of the face above, and the upper border of the one below, lie in front.
CUBES = {
    "carla": ("front", "right", "back", "left", "up", "down"),
    "habitat": ("back", "down", "front", "left", "right", "up"),
    "opengl": ("+x", "-x", "+y", "-y", "+z", "-z"),
}
_OPENGL = {"+x": "right", "-x": "left", "+y": "up", "-y": "down", "+z": "front", "-z": "back"}
# x and z, right and forward, of each face in the frame of the cube.
_FACES = {
    "front": ((1, 0, 0), (0, 0, 1)), "right": ((0, 0, -1), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 0, -1)), "left": ((0, 0, 1), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, -1, 0)), "down": ((1, 0, 0), (0, 1, 0)),
}  # fmt: skip
_ROUNDING = 1e-3  # px: a point that is this little beyond the edge of a picture is on it


class Camera(NamedTuple):
    """A camera of a rig.

    Attributes: lens: one lens, in float64. size: (H, W) of its pictures. pose: (4, 4), takes points
    of the camera's frame to the rig's.
    """

    lens: Lens
    size: tuple[int, int]
    pose: np.ndarray


class Rig:
    """Cameras with names that are fixed to each other, and what is up and ahead of them.

    A rig has a frame of its own, in metres. `view.at(rig)` shows what its cameras see together.

    Args:
        cameras: for each name a lens; (H, W) of its pictures, or None for the lens's image_size;
            and the pose, (3 or 4, 4), that takes points of the camera's frame (x right, y down, z
            forward) to the rig's. The order is that of lists of pictures.
        up: the direction away from gravity in the rig's frame, of any length. The default is that
            of vehicles: x forward, y left, z up (ISO 8855).
        forward: where the rig looks, in its frame; its level part counts. None means x if `up` is
            nearest to the z axis, and else z, as in the frame of a camera.

    Attributes:
        cameras: a `Camera` for each name. up, forward: unit vectors.

    Raises:
        TypeError: a lens is no `Lens`.
        ValueError: there are no cameras or more than 255, a lens is several, a size is missing,
            below 2 × 2 px or not that of the lens, a pose holds no rotation, or `forward` is along
            `up`. The message names the camera.
    """

    def __init__(
        self,
        cameras: Mapping[str, tuple[Lens, tuple[int, int] | None, Any]],
        *,
        up: Any = (0.0, 0.0, 1.0),
        forward: Any = None,
    ):
        if not 1 <= len(cameras) <= MOST_CAMERAS:
            raise ValueError(f"a rig has 1 to {MOST_CAMERAS} cameras, got {len(cameras)}")
        self.cameras = {
            str(name): _camera(f"camera {name}", *camera) for name, camera in cameras.items()
        }
        self.up = unit_vector("up", up)
        if forward is None:
            forward = (1, 0, 0) if np.argmax(np.abs(self.up)) == 2 else (0, 0, 1)
        self.forward = unit_vector("forward", forward)
        if np.linalg.norm(np.cross(self.up, self.forward)) < 1e-6:
            raise ValueError(f"forward must not be along up {self.up}, got {self.forward}")

    @classmethod
    def cube(cls, side: int, faces: str = "carla") -> Self:
        """The six pictures of a simulator at one place, each 90° wide and high.

        The frame of the cube is that of the front camera: x right, y down, z forward.

        Args:
            side: of the pictures, px.
            faces: "carla" (front, right, back, left, up, down), "habitat" (back, down, front, left,
                right, up) or "opengl" (+x, -x, +y, -y, +z, -z, as cube maps are stored): the order
                and the names.
        """
        if faces not in CUBES:
            raise ValueError(f"faces must be one of {', '.join(CUBES)}, got {faces!r}")
        if side < 2:
            raise ValueError(f"side must be at least 2 px, got {side}")
        middle = (side - 1) / 2
        lens = Perspective(side / 2, theta_max=math.atan(math.sqrt(2)), center=(middle, middle))
        cameras = {}
        for name in CUBES[faces]:
            right, ahead = _FACES[_OPENGL.get(name, name)]
            pose = np.eye(4)
            pose[:3, :3] = np.stack((right, np.cross(ahead, right), ahead), 1)
            cameras[name] = (lens, (side, side), pose)
        return cls(cameras, up=(0, -1, 0), forward=(0, 0, 1))

    @classmethod
    def single(
        cls, lens: Lens, size: tuple[int, int] | None = None, *, up: Any = (0.0, -1.0, 0.0),
        height: float = 0.0,
    ) -> Self:  # fmt: skip
        """One camera, called "camera", above the ground.

        The frame of the rig has the camera's axes, and its origin is on the ground below it.

        Args:
            lens: of the camera. size: (H, W) of its pictures; None means the lens's image_size.
            up: the direction away from gravity in the camera's frame.
            height: of the camera above the ground, m.
        """
        return cls({"camera": (lens, size, np.eye(4))}, up=up, forward=ahead_of(up)).raised(height)

    @classmethod
    def load(
        cls, path: str | os.PathLike | Iterable[str | os.PathLike], *, up: Any = None,
        forward: Any = None, height: float = 0.0, direction: str | None = None,
        cameras: str | os.PathLike | None = None, coefficients: str | None = None,
        image_size: Size = None,
    ) -> Self:  # fmt: skip
        """Reads the cameras and their poses.

        The files are our own JSON, Kalibr's camchain, that of OpenCV's calibrateMultiview,
        WoodScape's, COLMAP's rig_config.json, KITTI-360's folder, and any camera that `load` reads
        with its matrix beside it. The page "Files of rigs" says what the numbers of each mean.

        Args:
            path: a file, several files of one camera each, or a folder of them.
            up: away from gravity in the rig's frame; None means what the file says, and else the
                top of the picture of the camera in whose frame the poses are.
            forward: see `Rig`; None means what the file says, and else `up` tells.
            height: of the origin of the file's frame above the ground, m: see `raised`.
            direction: "camera_to_rig" or "rig_to_camera", where the poses of a file lead that does
                not say so.
            cameras: the cameras.txt or cameras.bin of a COLMAP rig_config.json without lenses.
            coefficients: see `load`.
            image_size: (H, W) px, used if the file has no image size.

        Raises:
            ValueError: an unknown format, a missing or wrong entry, no poses, a pose that holds no
                rotation, two cameras of one name, or an option that is missing. The message names
                the file and the camera.
            OSError: a file cannot be opened.
        """
        with rigs.about(path):
            found = rigs.Reader(direction, cameras, coefficients, image_size).read(path)
            up = found.up if up is None else up
            if up is None and not found.in_camera:
                text = "the file does not say which way is up in its frame: give `up`"
                raise naming(ValueError(text), "up")
            up = (0.0, -1.0, 0.0) if up is None else up
            forward = found.forward if forward is None else forward
            if forward is None and found.in_camera:
                forward = ahead_of(up)
            return cls(found.cameras, up=up, forward=forward).raised(height)

    def save(self, path: str | os.PathLike) -> None:
        """Writes a file that `load` reads.

        Our own JSON (.json) holds all of a rig. Kalibr's camchain (.yaml, .yml) calls the cameras
        cam0, cam1, …, and has their poses in the frame of the first one; what is up and θ_max are
        lost.

        Warns:
            UserWarning: a lens sees more than Kalibr knows: see `darswin.lens.save`.

        Raises:
            ValueError: another ending, or a lens that the file cannot hold exactly.
        """
        with rigs.about(path):
            rigs.write(path, self.cameras, self.up, self.forward)

    def raised(self, height: float) -> Self:
        """The same rig with its origin lower by a height, m: on the ground, on which `GroundView`
        needs it, if that is the height of the origin above it."""
        if not math.isfinite(height):
            raise ValueError(f"height must be a finite number of metres, got {height}")
        lift = np.eye(4)
        lift[:3, 3] = np.multiply(height, self.up)
        return self.with_cameras(
            {n: c._replace(pose=lift @ c.pose) for n, c in self.cameras.items()}
        )

    def with_cameras(self, cameras: Mapping[str, Any]) -> Self:
        """The same rig with these cameras, see `Rig`, in place of those of their names, or more."""
        return type(self)({**self.cameras, **cameras}, up=self.up, forward=self.forward)

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, name: str) -> Camera:
        if name not in self.cameras:
            raise KeyError(f"there is no camera {name!r}, only {', '.join(self.cameras)}")
        return self.cameras[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras, in their order."""
        return tuple(self.cameras)

    @property
    def level(self) -> np.ndarray:
        """The rotation (3, 3) to the rig's frame from its level one, x right, y down, z ahead."""
        return np.array(frame_of(self.up, self.forward, upright=True))

    @property
    def middle(self) -> np.ndarray:
        """The mean of the cameras' places, (3,) m in the rig's frame."""
        return np.mean([camera.pose[:3, 3] for camera in self.cameras.values()], 0)

    @property
    def spread(self) -> float:
        """The largest distance of a camera from `middle`, m."""
        places = [camera.pose[:3, 3] for camera in self.cameras.values()]
        return float(np.linalg.norm(places - self.middle, axis=1).max())

    def project(self, points: Any) -> tuple[np.ndarray, np.ndarray]:
        """The pixels of all cameras at which points of the rig's frame are seen.

        Args:
            points: (..., 3), m.

        Returns:
            Pixels (n, ..., 2), NaN beyond θ_max; and whether a picture shows the point, (n, ...).
        """
        points, pixels, shown = np.asarray(points, np.float64), [], []
        for lens, size, pose in self.cameras.values():
            local = torch.from_numpy((points - pose[:3, 3]) @ pose[:3, :3])
            pixels.append(lens.project_points(local[None], size)[0].numpy())
            shown.append(is_in(pixels[-1], size))
        return np.stack(pixels), np.stack(shown)

    def __repr__(self) -> str:
        cameras = (f"{name}: {c.lens}, {c.size}" for name, c in self.cameras.items())
        return f"Rig({'; '.join(cameras)}; up={self.up}, forward={self.forward})"


def is_in(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """True for pixels (..., 2) of a picture of (H, W), whose outer ones extend to its edges."""
    sides = np.array(size[::-1])
    beyond = np.abs(pixels + 0.5 - sides / 2) - sides / 2
    return np.asarray((beyond <= _ROUNDING).all(-1))  # False for NaN


def _camera(what: str, lens: Any, size: Any, pose: Any) -> Camera:
    if not isinstance(lens, Lens):
        raise TypeError(f"{what}: lens must be a darswin.lens.Lens, got {type(lens).__name__}")
    if len(lens) != 1:
        raise ValueError(f"{what}: a camera has one lens, got {len(lens)}")
    own = lens.image_size
    if own is not None:
        height, width = (round(side) for side in own[0].tolist())
        if size is not None and tuple(size) != (height, width):
            raise ValueError(
                f"{what}: its lens belongs to pictures of (H, W) = {(height, width)}, got {size}"
            )
        size = height, width
    if size is None:
        raise ValueError(f"{what}: neither the lens nor image_size has a size of its pictures")
    if len(size) != 2 or min(size) < 2:
        raise ValueError(f"{what}: its pictures must have a size of at least 2 × 2 px, got {size}")
    exact = lens.detach().to("cpu", torch.float64)
    return Camera(exact, (int(size[0]), int(size[1])), to_pose(what, pose))
