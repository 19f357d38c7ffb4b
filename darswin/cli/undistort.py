"""`darswin lens undistort`: pictures and videos as an ideal camera would have taken them."""

import json
import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

import darswin.lens
from darswin.cli.views import Look, Up
from darswin.lens import Lens
from darswin.lens.files.load import reach
from darswin.lens.files.reader import Coefficients
from darswin.utils.files import replace_file
from darswin.utils.parameters import check, with_flags
from darswin.utils.words import counted, in_px

if TYPE_CHECKING:
    import numpy as np

    from darswin.cli.pictures import Broken, File, Picture
    from darswin.data.cameras import Calibrations
    from darswin.frames import Sampler

MOST_PIXELS = 2**26  # of a view
RECORD, LENS = "undistorted.json", "lens.json"


def undistort(
    calib: str, paths: Sequence[str] = (), *, out: str, view: str = "perspective",
    fov_deg: float | None = None, size: tuple[int, int] | None = None, yaw_deg: float = 0.0,
    pitch_deg: float = 0.0, up: Up | None = None, theta_max_deg: float | None = None,
    camera: str | None = None, coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Undistorts pictures and videos of a fisheye or wide-angle camera.

    Writes pictures and videos of the same names into a new folder, and, for perspective views,
    their calibration, lens.json. Pictures and videos are turned upright by their metadata, and
    their lens with them. Pictures may have another size than those of the calibration, but not
    another shape. Files that cannot be read are named at the end; all others are written.

    Args:
        calib: the calibration file of the camera, in any format that darswin.lens.load reads; or a
            lenses.json for several cameras.
        paths: pictures, videos, and folders of them, whose subfolders are kept.
        out: the folder to write to: new, empty, or from an earlier undistort, whose files are
            replaced. Pictures have 8 bits per channel and no transparency, videos have no sound.
            Endings that cannot be written get .png or .mp4 in addition.
        view: the projection: perspective, cylindrical, equirectangular, mercator, stereographic,
            panorama or square. A perspective view shows straight lines straight, but its middle
            becomes coarse above 100°. A cylindrical view shows verticals straight. Equirectangular
            and Mercator views are parts of a map of the sphere; in a Mercator view and in a
            stereographic one objects keep their shape. A panorama shows all directions around the
            vertical, for cameras that look down or up. A square shows the whole image disc, in
            equal steps of the incident angle.
        fov_deg: the horizontal field of view between the outer edges of a row, in degrees. The
            default is all that the picture shows; for a perspective view, 100° at most; for a
            panorama, 360°.
        size: height and width of the views in px, e.g. 480,640. The default is a shape that fits
            the view, with the longer side of the picture; a square has the shorter one. Videos have
            even sides.
        yaw_deg: the angle that the view looks to the right, in degrees.
        pitch_deg: the angle that the view looks up, in degrees.
        up: the direction away from gravity, e.g. 0,-1,0: x to the right of the upright picture, y
            down and z ahead. The verticals of the view follow it. The default is the top of the
            picture, turned with the view.
        theta_max_deg: the incident angle beyond which the view is black, in degrees. The default is
            that of the calibration file; if it has none, all of the picture is shown.
    """
    # These import OpenCV, Pillow and the models; other commands of `lens` do not need them.
    from darswin.cli.pictures import Broken, claim_folder, files_at, is_below, relative_names
    from darswin.data.cameras import Calibrations, is_json
    from darswin.utils.progress import Progress

    look = Look(view, fov_deg, yaw_deg, pitch_deg, up)
    look.check()
    if theta_max_deg is not None:
        in_range = 0 < theta_max_deg <= 180
        check("theta_max_deg", theta_max_deg, in_range, "above 0° and at most 180°")
    if size is not None:
        fits = min(size) >= 2 and math.prod(size) <= MOST_PIXELS
        check("size", size, fits, f"at least 2,2 and at most {MOST_PIXELS} px in all")
        check("size", size, view != "square" or size[0] == size[1], "square for this view")
    if not paths:
        raise ValueError("missing pictures or videos: give files or folders")
    files = files_at(paths, leave_out=out)
    if inside := [path for path in paths if is_below(path, out)]:
        raise ValueError(f"--out must be a folder without the originals, but has {inside[0]}")
    root = "." if is_json(calib) else Path(calib).parent
    calibrations = Calibrations(calib, root, camera, coefficients)
    if not files:
        raise ValueError(f"no pictures or videos in {', '.join(paths)}, apart from those of --out")
    folder = claim_folder(out, RECORD)
    (folder / LENS).unlink(missing_ok=True)
    views = _Views(look, size, theta_max_deg)
    names = relative_names(paths, files)
    broken = Broken()
    written: dict[str, Lens | None] = {}
    try:
        with Progress("undistort", len(files)) as progress:
            for file in files:
                with broken.skipped(ValueError):
                    target, lens = _undistorted(
                        file, calibrations, folder / names[file.name], views, broken
                    )
                    written[target.relative_to(folder).as_posix()] = lens
                progress.done += 1
    finally:
        replace_file(folder / RECORD, json.dumps([*written], indent=1, ensure_ascii=False))
        _write_lens(folder, written)
    if written:
        with_lens = f"; their calibration is {folder / LENS}" * (folder / LENS).exists()
        print(f"{folder}: {len(written)} of {counted(len(files), 'file')}, {views.said}{with_lens}")
    broken.report()


class _Viewed(NamedTuple):
    sampler: "Sampler"
    camera: Lens | None  # the perspective camera of the view


class _Views:
    """The views of pictures, planned once for each lens."""

    def __init__(self, look: Look, size: tuple[int, int] | None, theta_max_deg: float | None):
        from darswin.cli.pictures import ByLens

        self._look, self._size, self._theta_max_deg = look, size, theta_max_deg
        self._by_lens = ByLens()
        self._said: set[str] = set()

    @property
    def said(self) -> str:
        """The view in words."""
        (shape,) = self._said if len(self._said) == 1 else ("in several sizes",)
        return f"{self._look.view} view, {shape}"

    def of(self, picture: "Picture", even: bool) -> _Viewed:
        """The view of a picture; `even` makes its sides even."""
        height, width, _ = picture.image.shape
        planned = partial(self._planned, picture.lens, (height, width), even)
        return self._by_lens(picture.lens, planned, even)

    def _planned(self, lens: Lens, size: tuple[int, int], even: bool) -> _Viewed:
        exact = lens.to(torch.float64)
        side = min(size) if self._look.view == "square" else max(size)
        if self._theta_max_deg is not None:
            exact = exact.with_theta_max(math.radians(self._theta_max_deg))
        fov_deg, view_size = self._look.shape(exact, size, side)
        height, width = self._size or view_size
        if even:
            height, width = (max(2, n - n % 2) for n in (height, width))
        view = self._look.make((height, width), fov_deg)
        whole = exact.with_theta_max(None)
        # Without a θ_max in the file, the lens ends at the picture's sides, and corners see more.
        if self._theta_max_deg is None and bool((exact.theta_max - reach(whole)).abs() < 1e-5):
            exact = whole
        self._said.add(f"{fov_deg:.4g}° across, {in_px((height, width))}")
        remap = view.at(exact, size)
        return _Viewed(remap.sampler(), remap.camera)


def _undistorted(
    file: "File", calibrations: "Calibrations", target: Path, views: _Views, broken: "Broken"
) -> tuple[Path, Lens | None]:
    """Undistorts a picture or a video; returns its new path and the camera of the view. If a video
    is cut off, the frames before are written."""
    from darswin.utils import video
    from darswin.utils.image import BrokenImageError, write_image, written_as

    pictures = file.pictures(calibrations)
    first = next(pictures)
    viewed = views.of(first, even=file.is_video)
    if not file.is_video:
        target = written_as(target)
        write_image(target, viewed.sampler(first.image))
        return target, viewed.camera

    def frames() -> "Iterator[np.ndarray]":
        yield viewed.sampler(first.image)
        try:
            for picture in pictures:
                yield views.of(picture, even=True).sampler(picture.image)
        except BrokenImageError as error:
            broken.errors.append(with_flags(error))

    if target.suffix.lower() not in video.WRITTEN:
        target = target.with_name(f"{target.name}.mp4")
    video.write_frames(target, frames(), video.frame_rate(file.name))
    return target, viewed.camera


def _write_lens(folder: Path, written: dict[str, Lens | None]) -> None:
    """Writes the calibration of the new pictures: one for all, or a table of their cameras."""
    cameras: dict[str, Any] = {
        name: darswin.lens.to_dict(lens) for name, lens in written.items() if lens is not None
    }
    if cameras:
        first, *others = cameras.values()
        same = all(other == first for other in others)
        replace_file(folder / LENS, json.dumps(first if same else cameras, indent=1))
