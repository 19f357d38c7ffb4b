"""`darswin lens calibrate`: from pictures of a board to a calibration."""

import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch

import darswin.lens
from darswin.cli.arguments import check_out
from darswin.lens.base import Lens
from darswin.lens.files.load import reach
from darswin.utils.files import replace_file
from darswin.utils.parameters import check

if TYPE_CHECKING:
    from darswin.calibrate import Board, Calibration

Format = Literal["darswin", "opencv", "colmap", "kalibr"]
Kind = Literal["chessboard", "charuco", "april"]
LEAST = 3  # pictures
BLURRED = 4.0, 1.6  # px, and by the median of all boards: the width of edges
TRIED = 5  # pictures that are looked at again to say what is wrong
DICTIONARIES = {"charuco": "4X4_250", "april": "APRILTAG_36h11"}


def calibrate(
    pictures: Sequence[str] = (), *, board: str, square: float, kind: Kind = "chessboard",
    marker: float | None = None, gap: float | None = None, dictionary: str | None = None,
    model: str = "auto", out: str = "camera.json", picture: str | None = None,
    report: str | None = None, format: Format | None = None,
) -> None:  # fmt: skip
    """Makes the calibration of a camera from pictures of a board, for any field of view to 250°.

    It takes 10 to 20 pictures in which the board is tilted, at several distances, and everywhere in
    the picture, also at its rim. Pixels are those that the camera stores, as in all calibrations.

    Args:
        pictures: pictures, and folders of them.
        board: columns and rows, e.g. 9x6: a chessboard's inner corners, a ChArUco board's squares,
            or the tags of a grid.
        square: the side of a square, or of a tag, in metres or any other unit of length.
        kind: the kind of the board.
        marker: the side of a ChArUco board's markers, in the same unit.
        gap: the gap between AprilTags, in the same unit.
        dictionary: the markers, as OpenCV names them. The default is 4X4_250 for ChArUco boards and
            APRILTAG_36h11 for AprilTags.
        model: the lens model, a name of darswin.lens.MODELS; or auto for the one of many that
            predicts left-out pictures best.
        out: the calibration to write.
        picture: a figure to write: the corners, what they miss, how sure the lens is.
        report: a JSON file to write with all that was found.
        format: the format of the calibration, as for `darswin lens convert`.
    """
    # These import OpenCV and the models; other commands of `lens` do not need them.
    from darswin.calibrate import calibrate as found_by
    from darswin.cli.predict import check_paths, pictures_and_videos
    from darswin.utils.progress import Progress

    made = _board(kind, board, square, marker, gap, dictionary)
    if model != "auto" and model not in darswin.lens.MODELS:
        raise ValueError(f"--model: {darswin.lens.base.unknown_model(model)}")
    if picture is not None:
        from darswin.viz.plot import figure_format

        figure_format(picture)
    check_paths(pictures)
    names = [file.name for file in pictures_and_videos(pictures) if not file.is_video]
    for option, file in (("out", out), ("picture", picture), ("report", report)):
        check_out(file, names, option)
    if not names:
        raise ValueError("missing pictures: give pictures of a board, or folders of them")
    with Progress("corners", len(names)) as progress:
        seen = _Seen(names, made, progress)
    if len(seen.names) < LEAST:
        raise ValueError(_why(seen, made, board))
    with Progress("calibrate") as progress:
        found = found_by(
            seen.corners, made, seen.size, model, names=seen.names,
            progress=lambda step: setattr(progress, "step", step),
        )  # fmt: skip
    lens = _within(seen.circle(), found.lens)
    print(_summary(found, seen, lens))
    write_lens(lens, out, format)
    if picture is not None:
        from darswin.viz.calibration import draw_calibration
        from darswin.viz.plot import save_figure

        save_figure(draw_calibration(found, seen.corners, lens), picture)
        print(picture)
    if report is not None:
        entries = found.to_dict() | {"lens": darswin.lens.to_dict(lens), "no_board": seen.without}
        replace_file(report, json.dumps(entries, indent=1, ensure_ascii=False))
        print(report)


def write_lens(lens: Lens, out: str, format: Format | None, note: str = "") -> None:
    """Writes the lens and prints what was written."""
    written = darswin.lens.save(lens, out, format)
    degrees = math.degrees(lens.theta_max.item())
    if written != "darswin" and bool(
        (lens.theta_max - reach(lens.with_theta_max(None))).abs() > 1e-6
    ):
        note += f"; {written} files have no θ_max: read it with --theta_max_deg {degrees:.2f}"
    print(f"{out}: {written}, {type(lens).__name__} up to {degrees:.2f}°{note}")


def _board(
    kind: Kind, board: str, square: float, marker: float | None, gap: float | None,
    dictionary: str | None,
) -> "Board":  # fmt: skip
    from darswin.calibrate import Board

    sides = re.fullmatch(r"\s*(\d{1,3})\s*[x×X*,]\s*(\d{1,3})\s*", board)
    least = {"chessboard": 2, "charuco": 3, "april": 1}[kind]
    in_range = sides is not None and all(least <= int(n) <= 100 for n in sides.groups())
    check("board", board, in_range, f"columns and rows from {least} to 100, such as 9x6")
    columns, rows = (int(n) for n in sides.groups()) if sides else (0, 0)
    needed = {"charuco": ("marker", marker), "april": ("gap", gap)}
    for of, (name, value) in needed.items():
        if (value is None) == (kind == of):
            are = "the side of the markers" if of == "charuco" else "the gap between tags"
            raise ValueError(f"--kind {of}, and no other, needs --{name}: {are}")
    check("square", square, 0 < square < math.inf, "positive")
    if kind == "chessboard":
        if dictionary is not None:
            raise ValueError("a chessboard has no --dictionary")
        return Board.chessboard(columns, rows, square)
    make = Board.charuco if kind == "charuco" else Board.april_grid
    return make(columns, rows, square, needed[kind][1] or 0.0, dictionary or DICTIONARIES[kind])


class _Seen:
    """What the pictures show.

    Attributes: names, corners, widths: of the pictures with the board, and of its edges (px);
    without: the other pictures; size: (H, W) of all; brightest: the maximum of those with it.
    """

    def __init__(self, files: Sequence[str], board: "Board", progress: Any):
        import numpy as np

        from darswin.calibrate import find_corners
        from darswin.calibrate.boards import edge_width
        from darswin.utils.image import read_stored

        self.names: list[str] = []
        self.without: list[str] = []
        self.corners: Any = []
        self.widths: list[float] = []
        brightest = read_stored(files[0], 1)
        for name in files:
            image = read_stored(name, 1)
            if brightest.shape != image.shape:
                (one, other) = (f"{a.shape[1]}×{a.shape[0]}" for a in (brightest, image))
                raise ValueError(
                    f"all pictures must have one size: {files[0]} has {one} (W×H) px, {name} has "
                    f"{other}"
                )
            corners = find_corners(image, board)
            if np.isfinite(corners).any():
                brightest = np.maximum(brightest, image) if self.names else image
                self.names.append(name)
                self.corners.append(corners)
                self.widths.append(edge_width(image, corners, board))
            else:
                self.without.append(name)
            progress.done += 1
        self.brightest, self.size = brightest, (brightest.shape[0], brightest.shape[1])
        self.corners = np.array(self.corners)

    def circle(self) -> tuple[float, float, float] | None:
        from darswin.calibrate.boards import image_circle

        return image_circle([self.brightest])

    def doubts(self) -> list[str]:
        least, times = BLURRED
        usual = sorted(self.widths)[len(self.widths) // 2]
        blurred = [
            f"{name} ({width:.1f} px)"
            for name, width in zip(self.names, self.widths, strict=True)
            if width > max(least, times * usual)
        ]
        said = [f"blurred, by the width of edges: {', '.join(blurred)}"] if blurred else []
        return said + ([f"no board found in {', '.join(self.without)}"] if self.without else [])


def _within(circle: tuple[float, float, float] | None, lens: Lens) -> Lens:
    """The lens with the θ_max of the image circle, if the pictures have one."""
    if circle is None:
        return lens
    x, y, radius = circle
    around = torch.linspace(0, 2 * math.pi, 64, dtype=torch.float64)
    rim = torch.stack((x + radius * around.cos(), y + radius * around.sin()), -1)
    theta = lens.with_theta_max(None).unproject_pixels(rim)[0].nanmedian().item()
    return lens.with_theta_max(theta) if math.isfinite(theta) else lens


def _summary(found: "Calibration", seen: _Seen, lens: Lens) -> str:
    used, total = int(found.used.sum()), len(seen.names) + len(seen.without)
    corners = int((found.weights > 0.1).sum())
    rows = [
        ("pictures", f"{used} of {total}"),
        ("corners", f"{corners} of {found.weights.numel()}"),
        ("noise", f"{found.sigma:.3f} px along x and y"),
        ("left out", f"{found.left_out:.3f} px in pictures that were left out"),
        ("supported", f"up to {math.degrees(found.supported):.1f}° from the axis"),
        *(("looks wrong", doubt) for doubt in [*seen.doubts(), *found.doubts]),
    ]
    lines = [f"{name:<16}{text}" for name, text in rows]
    if found.models:
        lines.append(f"{'model':<16}{'left out, px':>12}{'fitted, px':>12}")
    for name, left_out, error, reason in found.models:
        lines.append(f"{name:<16}" + (reason or f"{left_out:>12.3f}{error:>12.3f}"))
    return "\n".join(lines)


def _why(seen: _Seen, board: "Board", given: str) -> str:
    """Why too few pictures show the board."""
    import cv2
    import numpy as np

    from darswin.calibrate import find_corners
    from darswin.utils.image import read_stored

    said = f"{len(seen.names)} of {len(seen.names) + len(seen.without)} pictures show the board"
    again = [read_stored(name, 1) for name in seen.without[:TRIED]]
    if board.kind != "chessboard":
        if any(np.isfinite(find_corners(image[:, ::-1], board)).any() for image in again):
            return f"{said}: the pictures are mirrored, flip them first"
    else:
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        sizes: Counter = Counter()
        for image in again:
            there, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
            sizes.update([tuple(sorted(meta.shape, reverse=True))] if there else [])
        if sizes and (size := max(sizes, key=lambda size: (sizes[size], size))) > (3, 3):
            return f"{said} of --board {given}: they show {size[0]}x{size[1]} inner corners"
    none = f", not {', '.join(seen.without)}" if seen.names and seen.without else ""
    return f"{said}{none}: {LEAST} are needed, and 10 to 20 are better"
