"""`darswin lens calibrate`: from pictures of a board to a calibration."""

import json
import math
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch

import darswin.lens
from darswin.cli.arguments import check_out
from darswin.lens.base import Lens
from darswin.lens.files.load import Calibration, reach
from darswin.lens.files.save import format_of, is_held
from darswin.utils.exif import TURNS
from darswin.utils.files import replace_file
from darswin.utils.parameters import check, with_flags
from darswin.utils.words import counted, in_px

if TYPE_CHECKING:
    import numpy as np

    from darswin.calibrate import Board, CalibratedLens
    from darswin.cli.pictures import Broken, File

Format = Literal["darswin", "opencv", "colmap", "kalibr"]
Kind = Literal["chessboard", "charuco", "april"]
LEAST = 3  # pictures
BLURRED = 4.0, 1.6  # px, and by the median of all boards: the width of edges
TRIED = 5  # pictures that are looked at again to say what is wrong
LISTED = 10  # pictures that are named
FRAMES, OF = 40, 5  # of a video; frames of which the sharpest is taken
UNKNOWN = 1200  # frames, for videos that do not say how many they have


def calibrate(
    pictures: Sequence[str] = (), *, board: str, square: float, kind: Kind = "chessboard",
    marker: float | None = None, gap: float | None = None, dictionary: str | None = None,
    model: str = "auto", out: str = "camera.json", picture: str | None = None,
    report: str | None = None, format: Format | None = None, square_pixels: bool | None = None,
    theta_max_deg: float | None = None, first_tag: int | None = None,
) -> None:  # fmt: skip
    """Makes the calibration of a camera from pictures of a board, for any field of view to 250°.

    It takes 10 to 20 pictures, or a video, in which the board is tilted, at several distances, and
    everywhere in the picture, also at its rim. Pixels are those that the camera stores, as in all
    calibrations. Pictures that cannot be read are named at the end; all others are used.

    Args:
        pictures: pictures, videos, and folders of them. Of each of 40 equal parts of a video, the
            sharpest of five frames is taken: hold the board still now and then.
        board: columns and rows, e.g. 9x6: a chessboard's inner corners, a ChArUco board's squares,
            or the tags of a grid.
        square: the side of a square, or of a tag, in metres or any other unit of length.
        kind: the kind of the board.
        marker: the side of a ChArUco board's markers, in the same unit.
        gap: the gap between AprilTags, in the same unit.
        dictionary: the markers, as OpenCV names them. The default is 4X4_250 for ChArUco boards and
            APRILTAG_36h11 for AprilTags.
        first_tag: the number of the first AprilTag, at the upper left, or at the lower left as
            Kalibr draws them. The default is 0.
        model: the lens model, a name of darswin.lens.MODELS; or auto: of many that the file can
            hold, the simplest of those that predict left-out pictures best.
        out: the calibration to write.
        picture: a figure to write: the corners, what they miss, how sure the lens is, and the
            pictures whose corners are farthest off.
        report: a JSON file to write with all that was found.
        format: the format of the calibration, as for `darswin lens convert`.
        square_pixels: whether the camera's pixels are square. The default is to find the ratio of
            their sides if left-out pictures then fit better; false always finds it.
        theta_max_deg: the largest incident angle of the lens, in degrees. The default is that of
            the image circle, if the pictures have one, or else of the picture's sides.
    """
    # These import OpenCV and the models; other commands of `lens` do not need them.
    from darswin.calibrate import CalibrationError
    from darswin.calibrate import calibrate as calibrate_corners
    from darswin.calibrate.doubts import out_of_reach
    from darswin.cli.pictures import files_at
    from darswin.utils.progress import Progress

    given = {"marker": marker, "gap": gap, "dictionary": dictionary, "first_tag": first_tag}
    made = _board(kind, board, square, **given)
    if model != "auto" and model not in darswin.lens.MODELS:
        raise ValueError(f"--model: {darswin.lens.base.unknown_model(model)}")
    if picture is not None:
        from darswin.viz.plot import figure_format

        figure_format(picture)
    if theta_max_deg is not None:
        check("theta_max_deg", theta_max_deg, 0 < theta_max_deg <= 180, "above 0, at most 180")
    files = files_at(pictures)
    names = [file.name for file in files]
    outs = {"out": out, "picture": picture, "report": report}
    check_lens_out(out, names, format)
    for option in ("picture", "report"):
        check_out(outs[option], names, option)
    written = [os.path.realpath(file) for file in outs.values() if file is not None]
    if len({*written}) < len(written):
        raise ValueError("--out, --picture and --report must be different files")
    if not files:
        raise ValueError("missing pictures: give pictures or videos of a board, or folders of them")
    with Progress("corners", len(files)) as progress:
        seen = _look(files, made, progress)
    if len(seen.names) < LEAST:
        total = counted(seen.total, "picture")
        few = f"{len(seen.names)} of {total} with the board of --board {board}"
        why = "; ".join([f"{few}: {LEAST} are needed, and 10 to 20 are better", *seen.doubts])
        raise ValueError("\n".join([why, *seen.broken.errors]))
    with Progress("calibrate") as progress:
        try:
            found = calibrate_corners(
                seen.corners, made, seen.brightest.shape[:2], model, names=seen.names,
                square_pixels=square_pixels, accept=lambda lens: is_held(lens, out, format),
                progress=lambda step: setattr(progress, "step", step),
            )  # fmt: skip
        except CalibrationError as error:
            raise ValueError("\n".join([str(error), *seen.doubts, *seen.broken.errors])) from error
    lens = _within(seen.brightest, found.lens, theta_max_deg)
    # Its reach is compared with the image circle, not with the picture's sides.
    before, after = (out_of_reach(found.supported, one) for one in (found.lens, lens))
    doubts = [*seen.doubts, *(text for text in found.doubts if text not in before), *after]
    print(_summary(found, seen, doubts))
    try:
        write_lens(lens, out, format, supported=found.supported)
    except ValueError as error:  # the format holds none of the lenses
        write_lens(lens, f"{out}.json", "darswin", supported=found.supported)
        raise ValueError(f"{with_flags(error)}; this one is in {out}.json") from error
    if picture is not None:
        from darswin.viz.calibration import draw_calibration
        from darswin.viz.plot import save_figure

        save_figure(draw_calibration(found, lens, seen.read), picture)
        print(picture)
    if report is not None:
        entries = found.to_dict() | {"lens": darswin.lens.to_dict(lens), "no_board": seen.without}
        entries["doubts"] = doubts
        replace_file(report, json.dumps(entries, indent=1))
        print(report)
    seen.broken.report()


def check_lens_out(out: str | None, inputs: Iterable[str], format: Format | None = None) -> None:
    """`check_out` of a calibration, which may replace a calibration, but no other file."""
    check_out(out, inputs)
    if out is None:
        return
    if os.path.isfile(out) and os.path.getsize(out):
        try:
            Calibration.read(out)
        except ValueError as error:
            raise ValueError(
                f"--out {out} would replace a file that is no calibration: give a new name"
            ) from error
    format_of(out, format)


def write_lens(
    lens: Lens, out: str, format: Format | None, note: str = "", supported: float | None = None
) -> None:
    """Writes the lens and prints what was written; `supported` is that of `save`."""
    written = darswin.lens.save(lens, out, format, supported=supported)
    degrees = math.degrees(lens.theta_max.item())
    if supported is not None and written == "darswin":
        note += f"; {supported_part(supported, lens)}"
    if written != "darswin" and bool(
        (lens.theta_max - reach(lens.with_theta_max(None))).abs() > 1e-6
    ):
        note += f"; {written} files have no θ_max: read it with --theta_max_deg {degrees:.2f}"
    print(f"{out}: {written}, {type(lens).__name__} up to {degrees:.2f}°{note}")


def supported_part(supported: float, lens: Lens) -> str:
    """How far corners support a lens, in words."""
    part, whole = (math.degrees(angle) for angle in (supported, lens.theta_max.item()))
    return f"corners support it up to {min(part, whole):.2f}° of {whole:.2f}°"


def _board(kind: Kind, board: str, square: float, **given: Any) -> "Board":
    from darswin.calibrate import Board

    least = 1 if kind == "april" else 3
    found = re.fullmatch(r"\s*(\d{1,3})\s*[x×X*,]\s*(\d{1,3})\s*", board)
    sides = [int(side) for side in found.groups()] if found else [0]
    in_range = all(least <= side <= 100 for side in sides)
    check("board", board, in_range, f"columns and rows from {least} to 100, such as 9x6")
    check("square", square, 0 < square < math.inf, "positive")
    needed = {"chessboard": "", "charuco": "marker", "april": "gap"}[kind]
    if needed and given[needed] is None:
        raise ValueError(f"--kind {kind} needs --{needed}")
    given = {name: value for name, value in given.items() if value is not None}
    known = {"charuco": {"marker", "dictionary"}, "april": {"gap", "dictionary", "first_tag"}}
    if needless := given.keys() - known.get(kind, set()):
        raise ValueError(f"--kind {kind} has no --{min(needless)}")
    make: Any = Board.april_grid if kind == "april" else getattr(Board, kind)
    return make(*sides, square, **given)


class _Seen(NamedTuple):
    """What pictures show: the names and corners of those with the board; the names of those
    without; the brightest levels, (H, W, 1); doubts; errors of pictures that cannot be read; and
    the frames of videos by their names, (H, W, 1)."""

    names: list[str]
    corners: "np.ndarray"
    without: list[str]
    brightest: "np.ndarray"
    doubts: list[str]
    broken: "Broken"
    frames: dict[str, "np.ndarray"]

    def read(self, name: str) -> "np.ndarray":
        """The picture of a name as stored, (H, W, 3), RGB."""
        from darswin.utils.image import read_stored

        return self.frames[name].repeat(3, 2) if name in self.frames else read_stored(name)

    @property
    def total(self) -> int:
        return len(self.names) + len(self.without)


def _pictures(
    files: Sequence["File"], broken: "Broken", progress: Any
) -> Iterator[tuple[str, "np.ndarray", int]]:
    """The names of pictures and of frames, their grey levels upright, and their orientations."""
    import cv2

    from darswin.utils.image import read_oriented
    from darswin.utils.video import frame_count, read_frames

    for progress.done, (name, is_video) in enumerate(files):
        with broken.skipped():
            if not is_video:
                yield name, *read_oriented(name, 1)
                continue
            step = (frame_count(name) or UNKNOWN) // (FRAMES * OF)
            frames = read_frames(name, 1, max(1, step))
            while some := list(islice(frames, OF)):
                best = max(some, key=lambda frame: cv2.Laplacian(frame.image, cv2.CV_64F).var())
                yield f"{name}, frame {best.number}", best.image, best.orientation


def _look(files: Sequence["File"], board: "Board", progress: Any) -> _Seen:
    import numpy as np

    from darswin.calibrate import find_corners
    from darswin.calibrate.boards import edge_width, shown_instead
    from darswin.calibrate.doubts import Note
    from darswin.cli.pictures import Broken
    from darswin.utils.image import as_stored

    corners: dict[str, np.ndarray] = {}
    widths: dict[str, float] = {}
    without: dict[str, str] = {}  # the board, and what they show instead
    known: dict[int, str] = {}
    first, brightest, broken = "", np.zeros((1, 1, 1), np.uint8), Broken()
    doubts: list[str] = []
    names, frames = {file.name for file in files}, dict[str, np.ndarray]()
    for name, upright, orientation in _pictures(files, broken, progress):
        image = as_stored(upright, orientation)
        if not known:
            first, brightest = name, np.zeros_like(image)
        if brightest.shape != image.shape:
            one, other = (in_px(a.shape[:2]) for a in (brightest, image))
            raise ValueError(
                f"all pictures must have one size: {first} has {one}, {name} has {other}"
            )
        if (same := known.setdefault(hash(image.tobytes()), name)) is not name:
            doubts.append(Note(f"{name} shows the same as {same}, and is left out"))
            continue
        # Mirrored by the camera, whose pictures the others turn back.
        way = slice(None, None, -1 if sum(TURNS[orientation]) % 2 else 1)
        places = find_corners(image[:, way], board)
        if np.isnan(places).all():
            without[name] = shown_instead(image[:, way], board) if len(without) < TRIED else ""
            continue
        frames |= {name: image} if name not in names else {}
        widths[name] = edge_width(image[:, way], places, board)
        brightest = np.maximum(brightest, image)
        if way.step < 0:  # a board is symmetric
            places = places.reshape(board.rows, -1, 2)[:, ::-1].reshape(-1, 2)
            places = (image.shape[1] - 1, 0) + places * (-1, 1)
        corners[name] = places
    if without:
        words, tried = f"no board found in {_listed(without)}", [*without.values()][:TRIED]
        counts = Counter(filter(None, tried)).items()
        instead, count = max(counts, key=lambda item: item[::-1], default=("", 0))
        # Beside pictures with the board, others may show a part of it.
        if instead and (len(corners) < LEAST or 2 * count > len(tried)):
            words += f": they show {instead}"
        doubts.append((Note if len(without) <= len(corners) else str)(words))
    least = max(BLURRED[0], BLURRED[1] * float(np.median([*widths.values()] or [0])))
    if blurred := [f"{name} ({px:.1f} px)" for name, px in widths.items() if px > least]:
        doubts.append(f"blurred, by the width of edges: {_listed(blurred)}")
    found = np.array([*corners.values()])
    return _Seen([*corners], found, [*without], brightest, doubts, broken, frames)


def _listed(names: Collection[str]) -> str:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join([*names][:LISTED]) + more


def _within(brightest: "np.ndarray", lens: Lens, degrees: float | None) -> Lens:
    """The lens with this θ_max, or that of the image circle, if the pictures have one."""
    from darswin.calibrate.circle import image_circle

    if degrees is not None:
        limit = lens.with_theta_max(None).theta_max.item()
        return lens.with_theta_max(min(math.radians(degrees), limit))
    if (circle := image_circle([brightest])) is None:
        return lens
    x, y, radius = circle
    around = torch.linspace(0, 2 * math.pi, 64, dtype=torch.float64)
    rim = torch.stack((x + radius * around.cos(), y + radius * around.sin()), -1)
    theta = lens.with_theta_max(None).unproject_pixels(rim)[0].nanmedian().item()
    return lens.with_theta_max(theta) if math.isfinite(theta) else lens


def _summary(found: "CalibratedLens", seen: _Seen, doubts: Sequence[str]) -> str:
    from darswin.calibrate.doubts import Note

    corners = int((found.weights > 0.1).sum())
    rows = [
        ("pictures", f"{int(found.used.sum())} of {seen.total}"),
        ("corners", f"{corners} of {found.weights.numel()}"),
        ("noise", f"{found.noise:.3f} px, the root mean square distance of corners"),
        ("left out", f"{found.left_out:.3f} px, the same in pictures that were left out"),
        ("supported", f"up to {math.degrees(found.supported):.1f}° from the axis"),
        ("unsure", f"{math.degrees(found.unsure):.2g}° of the rays up to there"),
        *(("note" if isinstance(doubt, Note) else "looks wrong", doubt) for doubt in doubts),
    ]
    lines = [f"{name:<16}{text}" for name, text in rows]
    if found.models:
        lines.append(f"{'model':<16}{'left out, px':>12}{'fitted, px':>12}")
    for name, left_out, error, reason in found.models:
        lines.append(f"{name:<16}" + (reason or f"{left_out:>12.4g}{error:>12.4g}"))
    return "\n".join(lines)
