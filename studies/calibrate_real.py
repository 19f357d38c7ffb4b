"""Real chessboards: those of OpenCV's documentation, with the calibrations that it ships.

Debian's package `opencv-doc` has 13 pictures of a left and of a right camera. A method is judged by
its leave-one-out error: fit on the other pictures, find the pose of the one left out, and measure
the distances of its corners.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from calibrate_peers import FailedError, brown, lens_of_brown
from calibrate_rays import grid, ray_errors
from torch import Tensor

from darswin.calibrate import Board, CalibrationError, calibrate, find_corners
from darswin.lens import Lens, load

DATA = Path("/usr/share/doc/opencv-doc/examples/data")
BOARD = Board.chessboard(9, 6, 0.025)
AUTO = "ours, auto"
Method = Callable[[np.ndarray, tuple[int, int]], Lens]


def by_ours(model: str) -> Method:
    def method(corners: np.ndarray, size: tuple[int, int]) -> Lens:
        try:
            return calibrate(corners, BOARD, size, model).lens
        except CalibrationError as error:
            raise FailedError(str(error)) from None

    return method


def by_opencv(flags: int) -> Method:
    def method(corners: np.ndarray, size: tuple[int, int]) -> Lens:
        return lens_of_brown(*brown(corners, _flat(), size, flags), size)

    return method


METHODS = {
    "ours, BrownConrady": by_ours("BrownConrady"),
    "ours, KannalaBrandt": by_ours("KannalaBrandt"),
    AUTO: by_ours("auto"),
    "cv2.calibrateCamera": by_opencv(0),
    "cv2.calibrateCamera, rational": by_opencv(cv2.CALIB_RATIONAL_MODEL),
}


def _flat() -> np.ndarray:
    points = np.asarray(BOARD.points, dtype=float)
    return np.concatenate((points, np.zeros((len(points), 1))), 1)


def miss(lens: Lens, corners: np.ndarray) -> np.ndarray:
    """(K, 2) px: by how much a lens misses the corners of one picture, in the pose that makes the
    squares smallest."""
    lens = lens.with_theta_max(None)
    board, pixels = torch.from_numpy(_flat()), torch.from_numpy(corners)
    rays = lens.unproject_points(pixels).numpy()
    _, turn, shift = cv2.solvePnP(board.numpy(), rays[:, :2] / rays[:, 2:], np.eye(3), None)
    start = torch.from_numpy(cv2.Rodrigues(turn)[0])

    def off(pose: Tensor) -> Tensor:
        axes = torch.linalg.cross(pose[:3].expand(3, 3), torch.eye(3).to(pose)).T
        return lens.project_points(board @ (torch.matrix_exp(axes) @ start).T + pose[3:]) - pixels

    pose = torch.from_numpy(np.concatenate((np.zeros(3), shift[:, 0])))
    for _ in range(10):
        slopes = torch.func.jacfwd(off)(pose).reshape(-1, 6)
        pose = pose - torch.linalg.lstsq(slopes, off(pose).reshape(-1, 1)).solution[:, 0]
    return off(pose).numpy()


def left_out(method: Method, corners: np.ndarray, size: tuple[int, int]) -> list[float | None]:
    """px: the root mean square distance of the corners of each picture from a fit on the others;
    None where that fit does not see all corners."""
    return [_error(method(np.delete(corners, k, 0), size), one) for k, one in enumerate(corners)]


def _error(lens: Lens, corners: np.ndarray) -> float | None:
    error = float(np.sqrt(np.square(miss(lens, corners)).sum(1).mean()))
    return error if np.isfinite(error) else None


def published(data: Path, camera: str) -> Lens:
    """The calibration that OpenCV ships."""
    if camera == "left":
        lens = load(data / "left_intrinsics.yml")
    else:
        file = cv2.FileStorage(str(data / "intrinsics.yml"), cv2.FILE_STORAGE_READ)
        lens = lens_of_brown(file.getNode("M2").mat(), file.getNode("D2").mat().ravel(), (480, 640))
    return lens.to(torch.float64)


def real_cameras(data: Path, auto: bool = True) -> list[dict]:
    """Of each camera: the errors of all methods, and how far their rays are from the published."""
    cameras = []
    for camera in ("left", "right"):
        files = sorted(data.glob(f"{camera}[0-9][0-9].jpg"))
        pictures = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
        size = pictures[0].shape
        corners = np.stack([find_corners(picture, BOARD) for picture in pictures])
        seen = np.isfinite(corners).all((1, 2))
        corners, pixels = corners[seen], grid(size)
        known = published(data, camera).with_theta_max(None)
        rays = known.unproject_points(torch.from_numpy(pixels)).numpy()
        there = np.isfinite(rays).all(1)
        results = {}
        for name, method in METHODS.items():
            if name == AUTO and not auto:
                continue
            lens = method(corners, size)
            # The model that is best for all pictures is also that of the fits without one.
            again = by_ours(type(lens).__name__) if name == AUTO else method
            found = lens.with_theta_max(None).unproject_points(torch.from_numpy(pixels[there]))
            off = ray_errors(found.numpy(), rays[there])
            results[name] = dict(
                model=type(lens).__name__, left_out=left_out(again, corners, size),
                median=float(np.median(off)), most=float(np.quantile(off, 0.95)),
            )  # fmt: skip
        stored = [_error(known, one) for one in corners]
        names = [file.name for file, whole in zip(files, seen, strict=True) if whole]
        cameras.append(
            dict(camera=camera, pictures=names, of=len(files), published=stored, results=results)
        )
    return cameras
