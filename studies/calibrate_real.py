"""Real boards: each method is judged by the corners in pictures that it did not get.

Five fits leave out a fifth of the pictures each. Then only the poses of the boards in the pictures
that were left out are fitted, and the distances of their corners are measured. The pictures are
those of Debian's package `opencv-doc`, and of public repositories that are cloned into a folder;
one repository has the corners of its pictures only.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from calibrate_peers import METHODS, NEEDS, FailedError, Given, Method
from calibrate_tables import REAL
from torch import Tensor

from darswin.calibrate import (
    Board,
    CalibratedLens,
    CalibrationError,
    calibrate,
    find_corners,
    radial,
)
from darswin.lens import Lens

OPENCV = "/usr/share/doc/opencv-doc/examples/data"
FOLDS, OFF = 5, 6.0  # standard deviations: a corner that is farther off counts for no method
SQUARE = 0.03  # the unit does not matter


class Boards(NamedTuple):
    """Pictures of a chessboard with columns × rows inner corners: the pattern of their names, or
    the file in which OpenCV has written their corners."""

    pictures: str
    columns: int
    rows: int


SETS = {
    "OpenCV, left": Boards(f"{OPENCV}/left[0-9][0-9].jpg", 9, 6),
    "OpenCV, right": Boards(f"{OPENCV}/right[0-9][0-9].jpg", 9, 6),
    "OCamCalib, fish_1": Boards("py-OCamCalib/test_images/fish_1/*.jpg", 8, 6),
    "OCamCalib, fish_2": Boards("py-OCamCalib/test_images/fish_2/*.jpg", 8, 6),
    "stereo, left": Boards("fisheye-stereo-calibration/imgs/left*.jpg", 9, 6),
    "stereo, right": Boards("fisheye-stereo-calibration/imgs/right*.jpg", 9, 6),
    "camodocal, front": Boards("camodocal/data/images/*.bmp", 9, 6),
    "NXP, curled sheet": Boards(
        "surround-view-imx/App/Content/camera_models/chessboard_1/*.jpg", 7, 5
    ),
    "copark": Boards("fisheye_calib/img*.png", 8, 6),
    "T265, on paper": Boards("underwater-fisheye-calibration/fisheye_imgs/*.png", 7, 5),
    "T265, in air": Boards("underwater-fisheye-calibration/air_fisheye_right_imgs/*.png", 7, 5),
    "glass": Boards("fisheye_calibration/data/glass1/img*0.png", 8, 6),
    "omnidir's tutorial": Boards(
        "opencv_contrib/modules/ccalib/tutorials/data/omni_calib_data.xml", 6, 9
    ),
}


def files_of(boards: Boards, folder: Path) -> list[Path]:
    """The pictures that are there; each pattern is of names below a folder, or of whole names."""
    whole = folder / boards.pictures
    return sorted(whole.parent.glob(whole.name))


def real_set(name: str, files: list[Path], tools: dict[str, str]) -> dict:
    """The errors of the methods whose tools are there, on pictures that were left out."""
    _, columns, rows = SETS[name]
    board = Board.chessboard(columns, rows, SQUARE)
    corners, size = _corners(files, board)
    count = len(corners)
    corners = corners[np.isfinite(corners).all((1, 2))]
    try:
        whole = calibrate(corners, board, size, "KannalaBrandt")
    except CalibrationError:  # of mirrors
        whole = calibrate(corners, board, size)
    distance = whole.residuals.norm(dim=-1).numpy()
    wrong = distance > OFF * whole.sigma
    corners[wrong] = np.nan
    results = {
        method: left_out(METHODS[method], corners, board, size, whole)
        for method in REAL
        if NEEDS.get(method, "opencv") in tools
    }
    return dict(
        set=name, of=count, pictures=len(corners), corners=corners[..., 0].size,
        wrong=int(wrong.sum()), results=results,
    )  # fmt: skip


def _corners(files: list[Path], board: Board) -> tuple[np.ndarray, tuple[int, int]]:
    """The corners (P, K, 2) px, NaN where not found, and the size (H, W)."""
    if files[0].suffix == ".xml":
        stored = cv2.FileStorage(str(files[0]), cv2.FILE_STORAGE_READ)
        points, sides = stored.getNode("imagePoints"), stored.getNode("imageSize")
        width, height = (int(sides.at(k).real()) for k in (0, 1))
        places = [points.at(k).mat().reshape(-1, 2) for k in range(points.size())]
        return np.array(places, np.float64), (height, width)
    # Some sets have a picture twice.
    read = (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files)
    pictures = [*{picture.tobytes(): picture for picture in read if picture is not None}.values()]
    (size,) = {picture.shape for picture in pictures}
    return np.stack([find_corners(picture, board) for picture in pictures]), size


def left_out(
    method: Method, corners: np.ndarray, board: Board, size: tuple[int, int], whole: CalibratedLens
) -> dict:
    """The root mean square and the median distance, px, over all pictures, each left out once; how
    many of them no lens was found for, or one that does not see them; and the models chosen."""
    flat = np.pad(board.points, ((0, 0), (0, 1)))
    measure = whole.lens.with_theta_max(None)
    near = torch.full((1, 1), 0.02, dtype=torch.float64)
    angles = np.degrees(whole.theta.numpy())
    distances, failed, models = [], 0, []
    for k in range(FOLDS):
        out = np.arange(len(corners)) % FOLDS == k
        given = Given(
            corners[~out], flat, board.columns, size, angles[~out],
            2 * float(np.nanmax(angles)), measure.project(near).item() / 0.02,
            "KannalaBrandt", corners[out].reshape(-1, 2), flat=False,
        )  # fmt: skip
        try:
            found = method(given)
        except FailedError:
            failed += int(out.sum())
            continue
        models += [found.model] * (found.model != "")
        rays = found.rays.reshape(*corners[out].shape[:2], 3)
        solid = flat if found.board is None else found.board
        for picture, seen in zip(rays, ~np.isnan(corners[out]).any(2), strict=True):
            off = miss(measure, solid, picture, seen)
            failed += off is None
            distances += [] if off is None else [off]
    result = dict(failed=failed, models=[*dict.fromkeys(models)])
    if distances:
        off = np.concatenate(distances)
        result |= dict(error=float(np.sqrt(np.square(off).mean())), median=float(np.median(off)))
    return result


def miss(measure: Lens, board: np.ndarray, rays: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """(K',) px: the distances of the rays (K, 3) of the seen corners from a board (K, 3), in the
    pose that makes their squares smallest. One lens measures the angles of all methods in pixels,
    so a method needs no projection. None if a seen corner has no ray."""
    if not np.isfinite(rays[seen]).all():
        return None
    solid = torch.from_numpy(board[seen] - board[seen].mean(0))
    to = torch.nn.functional.normalize(torch.from_numpy(rays[seen]), dim=-1)
    goal = measure.project_points(to)
    turns, shifts = radial.poses(to[None], torch.ones(1, len(to)).to(to), solid[:, :2])

    def off(pose: Tensor) -> Tensor:
        axes = torch.linalg.cross(pose[:3].expand(3, 3), torch.eye(3).to(pose)).T
        turned = solid @ (torch.matrix_exp(axes) @ turns[0]).T
        return measure.project_points(turned + shifts[0] + pose[3:]) - goal

    pose = solid.new_zeros(6)
    for _ in range(15):
        slopes = torch.func.jacfwd(off)(pose).reshape(-1, 6)
        pose = pose - torch.linalg.lstsq(slopes, off(pose).reshape(-1, 1)).solution[:, 0]
    found = off(pose).norm(dim=1).numpy()
    return found if np.isfinite(found).all() else None
