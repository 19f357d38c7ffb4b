"""The methods of the calibration study: each finds rays at pixels from the same corners."""

import os
import re
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from darswin.calibrate import CalibrationError, calibrate
from darswin.lens import BrownConrady, KannalaBrandt, Lens, Mei

FOLDER = Path(__file__).parent
# A Python with mrcal (Debian's package), and one with opencv-contrib in an environment of its own.
MRCAL = os.environ.get("MRCAL_PYTHON", "/usr/bin/python3")
OMNIDIR = os.environ.get("OMNIDIR_PYTHON", str(FOLDER.parent / ".venv-contrib" / "bin" / "python"))
KNOTS = 8  # of the spline, along each axis: more knots than this made it worse
LEAST = 3  # pictures


class FailedError(Exception):
    """A method gave no lens; the message says why."""


@dataclass
class Given:
    """What a method is given: corners (P, K, 2) px, NaN where not seen, of a board (K, 3), rows of
    `columns` corners, in pictures of size (H, W); the angles (P, K) of the corners, degrees, by
    which a method may leave out pictures; the field of view, degrees, and a focal length, px, near
    the axis, for methods that need a guess; the true model, which one method is told; the pixels
    (M, 2) whose rays are asked; and whether the board is known to be flat."""

    corners: np.ndarray
    board: np.ndarray
    columns: int
    size: tuple[int, int]
    angles: np.ndarray
    fov: float
    focal: float
    model: str
    pixels: np.ndarray
    flat: bool = True

    def within(self, degrees: float) -> np.ndarray:
        """The corners of the pictures that show none beyond an angle from the axis."""
        kept = self.corners[~(self.angles > degrees).any(1)]
        if len(kept) < LEAST:
            raise FailedError(f"only {len(kept)} pictures lie within {degrees:.0f}°")
        return kept


class Found(NamedTuple):
    """What a method finds: rays (M, 3) at the pixels; the board (K, 3), if it bends it; and the
    model that it chose."""

    rays: np.ndarray
    board: np.ndarray | None = None
    model: str = ""


Method = Callable[[Given], Found]


def _seen(corners: np.ndarray, board: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The points and the corners of each picture that are seen."""
    seen = ~np.isnan(corners).any(2)
    return [board[there] for there in seen], [
        c[there] for c, there in zip(corners, seen, strict=True)
    ]


def ours(model: str | None) -> Method:
    """`calibrate` with a model, or with that of the true lens."""

    def method(given: Given) -> Found:
        try:
            found = calibrate(given.corners, given.board[:, :2], given.size, model or given.model)
        except CalibrationError as error:
            raise FailedError(str(error)) from None
        lens = found.lens
        return Found(_rays(lens, given.pixels), found.board.numpy(), type(lens).__name__)

    return method


def _rays(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    return lens.with_theta_max(None).unproject_points(torch.from_numpy(pixels)).numpy()


def _row(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


def _of_opencv(model: type[Lens], matrix: np.ndarray, size: tuple[int, int], **terms) -> Lens:
    """A lens that OpenCV found. Our inverse is exact where OpenCV's is not."""
    (fx, skew, cx), (_, fy, cy), _ = matrix
    affine = torch.tensor([[[1.0, skew / fx], [0.0, fy / fx]]], dtype=torch.float64)
    try:
        return model(
            focal=_row(fx)[0], affine=affine, center=_row(cx, cy), image_size=_row(*size), **terms
        )
    except ValueError as error:
        raise FailedError(f"no camera has such numbers: {error}") from None


def lens_of_brown(matrix: np.ndarray, d: np.ndarray, size: tuple[int, int]) -> Lens:
    """The lens of a camera matrix and the 5 or 8 coefficients of `cv2.calibrateCamera`."""
    terms = dict(radial=_row(d[0], d[1], d[4]), tangential=_row(d[2], d[3]))
    if len(d) >= 8:
        terms["denominator"] = _row(*d[5:8])
    return _of_opencv(BrownConrady, matrix, size, **terms)


def pinhole(flags: int, limit: float) -> Method:
    """`cv2.calibrateCamera` with the pictures that show nothing beyond `limit`, degrees."""

    def method(given: Given) -> Found:
        corners = given.within(limit)
        found = brown(corners, given.board, given.size, flags)
        return Found(_rays(lens_of_brown(*found, given.size), given.pixels))

    return method


def brown(
    corners: np.ndarray, board: np.ndarray, size: tuple[int, int], flags: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """The camera matrix and the coefficients of `cv2.calibrateCamera`."""
    points, places = _seen(corners.astype(np.float32), board.astype(np.float32))
    try:
        _, matrix, d, *_ = cv2.calibrateCamera(points, places, size[::-1], None, None, flags=flags)
    except cv2.error as error:
        raise FailedError(str(error).strip().splitlines()[-1]) from None
    if not (np.isfinite(matrix).all() and np.isfinite(d).all()):
        raise FailedError("the numbers are not finite")
    return matrix, d.ravel()


def fisheye(flags: int, limit: float) -> Method:
    """`cv2.fisheye.calibrate`. As its users do, a picture that it calls ill-conditioned is left
    out, and it is tried again."""

    def method(given: Given) -> Found:
        left = [*given.within(limit)]
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-8)
        height, width = given.size
        while True:
            guess = np.array(
                [[given.focal, 0, (width - 1) / 2], [0, given.focal, (height - 1) / 2], [0, 0, 1]]
            )
            try:
                points, places = (
                    [x[None] for x in each] for each in _seen(np.array(left), given.board)
                )
                _, matrix, d, *_ = cv2.fisheye.calibrate(
                    points, places, (width, height), guess, np.zeros(4), flags=flags, criteria=stop
                )
                break
            except cv2.error as error:
                ill = re.search(r"input array (\d+)", str(error))
                if ill is None or len(left) <= LEAST:
                    raise FailedError(str(error).strip().splitlines()[-1]) from None
                del left[int(ill[1])]
        if not (np.isfinite(matrix).all() and np.isfinite(d).all()):
            raise FailedError("the numbers are not finite")
        lens = _of_opencv(KannalaBrandt, matrix, given.size, radial=_row(*d.ravel()))
        return Found(_rays(lens, given.pixels))

    return method


def _program(command: list[str], given: Given, corners: np.ndarray) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        there, back = (Path(folder) / name for name in ("in.npz", "out.npz"))
        np.savez(
            there, corners=corners, points=given.board, columns=given.columns,
            rows=len(given.board) // given.columns, size=given.size, focal=given.focal,
            square=np.linalg.norm(given.board[1] - given.board[0]), pixels=given.pixels,
            flat=given.flat,
        )  # fmt: skip
        # Its packages are its own.
        env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            [*command, str(there), str(back)], capture_output=True, text=True, env=env, timeout=120
        )
        if done.returncode:
            raise FailedError((done.stderr.strip() or "it ended without words").splitlines()[-1])
        return dict(np.load(back))


def omnidir(given: Given) -> Found:
    found = _program([OMNIDIR, str(FOLDER / "calibrate_omnidir.py")], given, given.corners)
    matrix, xi, d = found["matrix"], float(found["xi"].squeeze()), found["distortion"].ravel()
    terms = dict(xi=_row(xi)[0], radial=_row(d[0], d[1]), tangential=_row(d[2], d[3]))
    return Found(_rays(_of_opencv(Mei, matrix, given.size, **terms), given.pixels))


def mrcal(model: str, limit: float) -> Method:
    def method(given: Given) -> Found:
        name = "LENSMODEL_" + model.format(fov=round(1.05 * given.fov))
        command = [MRCAL, str(FOLDER / "calibrate_mrcal.py"), name]
        found = _program(command, given, given.within(limit))
        with np.errstate(invalid="ignore"):
            rays = found["rays"] / np.linalg.norm(found["rays"], axis=1, keepdims=True)
        return Found(rays, None if given.flat else found["board"])

    return method


SPLINED = f"SPLINED_STEREOGRAPHIC_order=3_Nx={KNOTS}_Ny={KNOTS}_fov_x_deg={{fov}}"
FLAGS = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
CHECKED = FLAGS | cv2.CALIB_CHECK_COND
GUESS = FLAGS | cv2.CALIB_USE_INTRINSIC_GUESS
OURS = {
    "ours, auto": ours("auto"), "ours, KannalaBrandt": ours("KannalaBrandt"),
    "ours, true model": ours(None),
}  # fmt: skip
# Each with the limit that served it best on the whole.
PEERS = {
    "cv2.calibrateCamera": pinhole(0, 60),
    "cv2.calibrateCamera, rational": pinhole(cv2.CALIB_RATIONAL_MODEL, 80),
    "cv2.fisheye": fisheye(0, 85),
    "cv2.fisheye, flags": fisheye(FLAGS, 85),
    "cv2.fisheye, flags and check": fisheye(CHECKED, 85),
    "cv2.fisheye, flags and guess": fisheye(GUESS, 180),
    "cv2.omnidir": omnidir,
    "mrcal, OPENCV8": mrcal("OPENCV8", 180),
    "mrcal, splined": mrcal(SPLINED, 180),
}
METHODS = OURS | PEERS
# The tools that do not come with OpenCV.
NEEDS = {"cv2.omnidir": "opencv-contrib", "mrcal, OPENCV8": "mrcal", "mrcal, splined": "mrcal"}


def versions() -> dict[str, str]:
    """Of the tools; those that are not installed are missing."""
    found = {"opencv": cv2.__version__}
    for name, command in (
        ("opencv-contrib", [OMNIDIR, "-c", "import cv2; cv2.omnidir; print(cv2.__version__)"]),
        ("mrcal", [MRCAL, "-c", "import mrcal"]),
    ):
        try:
            done = subprocess.run(command, capture_output=True, text=True, env={})
        except OSError:
            continue
        if done.returncode == 0:
            found[name] = done.stdout.strip()
    if "mrcal" in found:
        asked = ["dpkg-query", "--show", "--showformat=${Version}", "mrcal"]
        found["mrcal"] = subprocess.run(asked, capture_output=True, text=True).stdout
    return found
