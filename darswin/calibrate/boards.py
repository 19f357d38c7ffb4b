"""Calibration boards, and their corners in pictures."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Self

import cv2
import numpy as np

from darswin.calibrate.inputs import CalibrationError
from darswin.utils.image import with_channels
from darswin.utils.nearest import did_you_mean
from darswin.utils.parameters import check, naming

Kind = Literal["chessboard", "charuco", "april"]

LEAST_SIDE = 16  # px: smaller pictures show nothing
SIDE = 1200  # px, to which larger pictures are reduced at first
RING = 1.5  # px: smaller ones around a corner show nothing
UNLIKE = 0.3  # of the range of light; right corners have 0.15 at most
MOST_CHANGE = 0.7  # of a step between corners to the next, in steps; a rim of 125° has 0.5


@dataclass(frozen=True)
class Board:
    """A flat board with known corners; `chessboard`, `charuco` and `april_grid` make one.

    Attributes:
        columns, rows: of the grid of corners. square: the side of a square or a tag, in metres or
            any unit of length. other: the side of a marker in a ChArUco board's squares, or the gap
            between tags. dictionary: OpenCV's name of the markers, such as "4X4_50". first_tag:
            the number with which AprilTags begin.
    """

    kind: Kind
    columns: int
    rows: int
    square: float
    other: float = 0.0
    dictionary: str = ""
    first_tag: int = 0

    @classmethod
    def chessboard(cls, columns: int, rows: int, square: float) -> Self:
        """A chessboard with `columns` × `rows` inner corners."""
        _check(columns, rows, 3, square=square)
        return cls("chessboard", columns, rows, square)

    @classmethod
    def charuco(
        cls, columns: int, rows: int, square: float, marker: float, dictionary: str = "4X4_250"
    ) -> Self:
        """A board of `columns` × `rows` squares with markers in the white ones, as OpenCV draws it.
        The square at the upper left is black, or white as in boards of OpenCV before 4.6."""
        _check(columns, rows, 3, square=square, marker=marker)
        check("marker", marker, marker < square, f"below the square of {square:g}")
        _dictionary(dictionary, columns * rows // 2)
        return cls("charuco", columns - 1, rows - 1, square, marker, dictionary)

    @classmethod
    def april_grid(
        cls, columns: int, rows: int, tag: float, gap: float, dictionary: str = "APRILTAG_36h11",
        first_tag: int = 0,
    ) -> Self:  # fmt: skip
        """A grid of `columns` × `rows` AprilTags with the side `tag` and a `gap` between them. They
        count up from `first_tag` at the upper left, or the lower left as Kalibr draws them."""
        _check(columns, rows, 1, square=tag, gap=gap)
        check("first_tag", first_tag, type(first_tag) is int and first_tag >= 0, "0 or more")
        _dictionary(dictionary, first_tag + columns * rows)
        return cls("april", 2 * columns, 2 * rows, tag, gap, dictionary, first_tag)

    @property
    def points(self) -> np.ndarray:
        """(K, 2): the corners, row by row, x along columns and y along rows; in float64."""
        place = np.arange(max(self.columns, self.rows), dtype=np.float64)
        pair, second = np.divmod(place, 2)
        april = pair * (self.square + self.other) + second * self.square
        place = april if self.kind == "april" else place * self.square
        return np.stack(np.meshgrid(place[: self.columns], place[: self.rows]), -1).reshape(-1, 2)

    @property
    def markers(self) -> range:
        """The numbers of the markers."""
        cells = (self.columns + 1) * (self.rows + 1) // 2
        count = self.columns * self.rows // 4 if self.kind == "april" else cells
        return range(self.first_tag, self.first_tag + count)

    @property
    def reach(self) -> float:
        """The distance around a corner without edges of other corners."""
        if self.kind == "chessboard":
            return 0.4 * self.square
        if self.kind == "charuco":
            return (self.square - self.other) / 2
        return min(self.square / (_dictionary(self.dictionary).markerSize + 2), self.other / 2)


def misfit(board: Any, text: str) -> CalibrationError:
    """The error of corners that do not fit a board or its points, with what to ask about it."""
    text += " Are the board and the order of its corners right?"
    if isinstance(board, Board) and board.kind == "april":
        tags = f"from `first_tag` {board.first_tag} to {board.markers[-1]}, `gap` {board.other:g}"
        text += f" Its AprilTags are taken to run {tags}."
    return naming(CalibrationError(text), "first_tag", "gap")


def find_corners(picture: np.ndarray, board: Board) -> np.ndarray:
    """The corners of a board in a picture.

    Args:
        picture: (H, W), (H, W, 1) grey or (H, W, 3) RGB, uint8.

    Returns:
        (K, 2) px, float64, in the order of `board.points`; NaN where a corner was not found. All
        are NaN if the picture does not show the board, or shows its corners in a wrong order.
    """
    if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8:
        raise TypeError("a picture must be an array of uint8")
    if picture.ndim not in (2, 3) or np.atleast_3d(picture).shape[2] not in (1, 3):
        raise ValueError(f"a picture must be (H, W), (H, W, 1) or (H, W, 3), got {picture.shape}")
    grey = grey_of(picture)
    find = {"chessboard": _chessboards, "charuco": _charuco, "april": _tags}[board.kind]
    for grid in find(grey, board) if min(grey.shape) >= LEAST_SIDE else ():
        grid = _refined(grey, grid, board)
        least = max(8, 0.9 * np.isfinite(grid).sum())
        # Markers tell each corner, so single wrong ones can be left out.
        while (odd := wrong(grid, board)).any() and board.kind != "chessboard":
            grid[odd == odd.max()] = np.nan
        if np.isfinite(grid).sum() >= least and not odd.any():
            return grid.reshape(-1, 2)
    return np.full(board.points.shape, np.nan)


def shown_instead(picture: np.ndarray, board: Board) -> str:
    """What a picture without the board shows in its place, in words; "" if nothing is known."""
    grey, _ = next(_scales(grey_of(picture)))
    if board.kind == "chessboard":
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        there, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
        rows, columns = sorted(meta.shape) if there else (3, 3)
        known = {rows, columns} in ({3}, {board.columns, board.rows})
        return "" if known else f"{columns}x{rows} inner corners"
    if np.isfinite(find_corners(grey[:, ::-1], board)).any():
        return "it mirrored, flip them first"
    name, seen = board.dictionary, _numbers(grey, board.dictionary)
    if sum(number in board.markers for number in seen) < max(4, 0.75 * len(seen)):
        # 36H11 is another name of 36h11.
        found = {name: _numbers(grey, name) for name in _names() if "H" not in name}
        most = max(map(len, found.values()))
        if most < 4:
            return ""
        # The larger sets of a kind contain the smaller ones, and find more that is no marker.
        near = [name for name, of in found.items() if len(of) > 0.75 * most]
        name = min(near, key=lambda n: (n != board.dictionary, len(_dictionary(n).bytesList)))
        seen = found[name]
    said = f"markers {seen[0]} to {seen[-1]} of {name}"
    if name != board.dictionary:
        return said
    outside = sum(number not in board.markers for number in seen)
    if outside > (0 if board.kind == "april" else len(seen) / 2):
        said += f", but the board has {board.markers[0]} to {board.markers[-1]}"
        begins = board.kind == "april" and seen[-1] - seen[0] < len(board.markers)
        return said + f": is its first tag {seen[0]}?" * begins
    why = "the markers are too small or cut off, or columns and rows are swapped"
    if board.kind == "april":
        why = "columns and rows are swapped, or the gap is a ratio in place of a length"
    return f"{said}, as the board has them, but no corners of it: maybe {why}"


def wrong(grid: np.ndarray, board: Board) -> np.ndarray:
    """(rows, columns): how often each of the corners (rows, columns, 2) px disagrees with its
    neighbours. As a smooth lens shows a board, it is not mirrored, and steps along rows and columns
    change little from one to the next."""
    odd = np.full(grid.shape[:2], int(_turn(grid) < 0))
    for steps, marks in _steps(grid, board, odd):
        px, change = (np.linalg.norm(s, axis=-1) for s in (steps, np.diff(steps, axis=0)))
        bad = change > MOST_CHANGE * np.minimum(px[1:], px[:-1])
        for k in range(3):
            marks[k : k + len(bad)] += bad
    return odd


def pixels_per_unit(grid: np.ndarray, board: Board) -> np.ndarray:
    """(rows, columns): the smallest length, px, of the board's unit of length from each corner to
    its neighbours; NaN without neighbours."""
    least = np.full(grid.shape[:2], np.nan)
    for steps, part in _steps(grid, board, least):
        px = np.linalg.norm(steps, axis=-1)
        part[1:] = np.fmin(part[1:], px)
        part[:-1] = np.fmin(part[:-1], px)
    return least


def edge_width(picture: np.ndarray, corners: np.ndarray, board: Board) -> float:
    """px, of the edges at the corners of a board: 2 where they are sharp, and 2.5 σ where they are
    blurred by a Gaussian."""
    grey = grey_of(picture).astype(np.float64)
    reach = pixels_per_unit(_shaped(corners, board), board).ravel() * board.reach
    widths = []
    for (x, y), half in zip(corners, np.clip(reach, 2, 15), strict=True):
        if np.isfinite((x, half)).all():
            rows, columns = (slice(max(0, int(at - half)), int(at + half) + 2) for at in (y, x))
            patch = grey[rows, columns]
            widths.append(np.ptp(patch) / max(np.hypot(*np.gradient(patch)).max(), 1e-9))
    return float(np.median(widths))


def _scales(grey: np.ndarray) -> Iterator[tuple[np.ndarray, float]]:
    """The picture as detectors should try it, and its scale."""
    for scale, contrast in ((1, False), (1, True), (2, False), (2, True), (0.5, True)):
        scale *= min(1.0, SIDE / max(grey.shape))
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        tried = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=way)
        yield cv2.createCLAHE(4.0, (8, 8)).apply(tried) if contrast else tried, scale


def _chessboards(grey: np.ndarray, board: Board) -> Iterator[np.ndarray]:
    """Grids of corners that might be the board."""
    older = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for detect, flags in (
        (cv2.findChessboardCornersSB, cv2.CALIB_CB_EXHAUSTIVE),
        (cv2.findChessboardCorners, older),
    ):
        for tried, scale in _scales(grey):
            try:
                there, corners = detect(tried, (board.columns, board.rows), flags=flags)
            except cv2.error:  # the older detector fails on some noise
                continue
            if not there:
                continue
            grid = _shaped(corners.astype(np.float64), board)
            # The outer ends of a smaller board's squares are no corners, a whole line of them.
            if (~_are_saddles(tried, grid)).sum() < min(board.rows, board.columns) / 2:
                # A chessboard looks the same from its other end, but is never mirrored.
                yield ((grid if _turn(grid) > 0 else grid[:, ::-1]) + 0.5) / scale - 0.5


def _are_saddles(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """(rows, columns): True if two opposite squares at a corner are darker than the others."""
    across, down = (0.35 * np.gradient(grid, axis=axis) for axis in (1, 0))
    both, other = across + down, across - down
    places = np.array([grid + aside for aside in (both, -both, other, -other)], np.float32)
    x, y = places.reshape(4, -1, 2).transpose(2, 0, 1)
    a, b, c, d = cv2.remap(grey, x, y, cv2.INTER_LINEAR).reshape(4, *grid.shape[:2])
    return (np.maximum(a, b) < np.minimum(c, d)) | (np.minimum(a, b) > np.maximum(c, d))


def _charuco(grey: np.ndarray, board: Board) -> Iterator[np.ndarray]:
    size = board.columns + 1, board.rows + 1
    drawn = cv2.aruco.CharucoBoard(size, board.square, board.other, _dictionary(board.dictionary))
    for white_first in (False, True):
        drawn.setLegacyPattern(white_first)
        detect = cv2.aruco.CharucoDetector(drawn).detectBoard
        yield _shaped(_collected(grey, detect, range(len(board.points)), 1), board)


def _tags(grey: np.ndarray, board: Board) -> Iterator[np.ndarray]:
    """The grids for tags with a border of one bit, or two as Kalibr's, which count from the upper
    or the lower left, and whose first corner is any of the four."""
    rows, columns = board.rows // 2, board.columns // 2
    parameters, found = cv2.aruco.DetectorParameters(), []
    for parameters.markerBorderBits in (1, 2):
        detector = cv2.aruco.ArucoDetector(_dictionary(board.dictionary), parameters)
        found.append(_collected(grey, detector.detectMarkers, board.markers, 4))
    tags = max(found, key=lambda corners: np.isfinite(corners).sum())
    for turn in range(4):
        # A tag's corners run clockwise: upper left, upper right, lower right, lower left.
        cells = np.roll(tags, turn, 1)[:, [0, 1, 3, 2]].reshape(rows, columns, 2, 2, 2)
        for way in (cells, cells[::-1]):
            yield _shaped(way.swapaxes(1, 2), board)


def _collected(
    grey: np.ndarray, detect: Callable[..., tuple], which: range, each: int
) -> np.ndarray:
    """(count, each, 2) px: what a detector finds of some markers at all scales, else NaN."""
    found = np.full((len(which), each, 2), np.nan)
    for tried, scale in _scales(grey):
        corners, numbers, *_ = detect(tried)
        seen = () if numbers is None else zip(numbers.ravel(), corners, strict=True)
        for number, corner in seen:
            if number in which and np.isnan(found[number - which[0]]).any():
                found[number - which[0]] = (corner.reshape(each, 2) + 0.5) / scale - 0.5
        if not np.isnan(found).any():
            break
    return found


def _numbers(grey: np.ndarray, name: str) -> list[int]:
    """The numbers of the markers of a set that a picture shows, in order."""
    parameters, found = cv2.aruco.DetectorParameters(), list[list[int]]()
    # Kalibr draws the tags of its only set with a border of two bits.
    for parameters.markerBorderBits in (1, 2) if name == "APRILTAG_36h11" else (1,):
        detect = cv2.aruco.ArucoDetector(_dictionary(name), parameters).detectMarkers
        numbers = detect(grey)[1]
        found.append([] if numbers is None else [int(n) for n in numbers.ravel()])
    most: list[int] = max(found, key=len)
    return sorted(most)


def _refined(grey: np.ndarray, grid: np.ndarray, board: Board) -> np.ndarray:
    """The grid with each corner where the gradients around it meet, in a window without edges of
    other corners; NaN where squares meet elsewhere."""
    room = _room(grid, board)
    scale = 2 if np.fmin.reduce(room, axis=None) * board.reach < 6 else 1
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    best, end = grid.copy(), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
    for at in zip(*np.nonzero(np.isfinite(room)), strict=True):
        window = int(np.clip(room[at] * board.reach * scale, 2, 12))
        place = ((grid[at] + 0.5) * scale - 0.5).astype(np.float32)[None]
        moved = cv2.cornerSubPix(large, place, (window, window), (-1, -1), end)[0]
        moved = (moved + 0.5) / scale - 0.5
        if np.linalg.norm(moved - grid[at]) < 0.3 * room[at] * board.square:
            best[at] = moved
    if board.kind != "april":  # whose corners are not between squares
        radius = 0.875 * board.reach * room
        best[(radius > RING) & (_unlike(grey, best, radius) > UNLIKE)] = np.nan
    return best


def _room(grid: np.ndarray, board: Board) -> np.ndarray:
    """(rows, columns): the smallest distance, px, between the sides of cells with the board's unit
    of length around each corner, which is less than their length if they are slanted."""
    least = pixels_per_unit(grid, board)
    (down, _), (across, _) = _steps(grid, board, least)
    across, (rows, columns) = across.swapaxes(0, 1), least.shape
    for i, j in np.ndindex(2, 2):
        a, b = across[i : rows - 1 + i], down[:, j : columns - 1 + j]
        area = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        part = least[i : rows - 1 + i, j : columns - 1 + j]
        np.fmin(part, area / np.linalg.norm([a, b], axis=-1).max(0), out=part)
    return least


def _unlike(grey: np.ndarray, grid: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(rows, columns): how unlike the light is on opposite sides of each corner, at a radius px, as
    a part of its range. It is alike where four squares meet, and not beside it."""
    turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = radius[..., None, None] * np.stack((np.cos(turn), np.sin(turn)), -1)
    x, y = np.moveaxis(grid[:, :, None] + ring, -1, 0).astype(np.float32).reshape(2, -1, 32)
    light = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    light = light.astype(np.float64).reshape(*radius.shape, 32)
    apart = np.abs(light - np.roll(light, 16, -1)).mean(-1)
    return apart / np.ptp(light, axis=-1).clip(1)


def _steps(
    grid: np.ndarray, board: Board, out: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For columns and for rows: the steps between corners, px per unit of length, along axis 0; and
    a view of `out`, (rows, columns), that fits them."""
    points = _shaped(board.points, board)
    yield np.diff(grid, axis=0) / np.diff(points[..., 1:], axis=0), out
    across = np.diff(grid, axis=1) / np.diff(points[..., :1], axis=1)
    yield across.swapaxes(0, 1), out.T


def _turn(grid: np.ndarray) -> float:
    """Above 0 if a grid's rows and columns run as on the board, and below 0 if it is mirrored."""
    (ax, ay), (bx, by) = np.diff(grid, axis=1)[:-1].T, np.diff(grid, axis=0)[:, :-1].T
    return float(np.nansum(ax * by - ay * bx))


def grey_of(picture: np.ndarray) -> np.ndarray:
    """(H, W): a picture without colours."""
    return np.ascontiguousarray(with_channels(np.atleast_3d(picture), 1)[..., 0])


def _shaped(corners: np.ndarray, board: Board) -> np.ndarray:
    return corners.reshape(board.rows, board.columns, 2)


def _names() -> list[str]:
    """OpenCV's sets of markers."""
    return [known.removeprefix("DICT_") for known in dir(cv2.aruco) if known.startswith("DICT_")]


def _dictionary(name: str, least: int = 0) -> cv2.aruco.Dictionary:
    """OpenCV's set of markers; ValueError for an unknown one, or fewer than `least` markers."""
    if name not in _names():
        raise ValueError(f"there is no dictionary {name!r}{did_you_mean(name, _names())}")
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    many = len(markers.bytesList)
    check("dictionary", name, many >= least, f"one of {least} markers or more, not of {many}")
    return markers


def _check(columns: int, rows: int, least: int, **sides: float) -> None:
    for name, value in (("columns", columns), ("rows", rows)):
        if type(value) is not int:
            raise TypeError(f"`{name}` must be a whole number, got {type(value).__name__}")
        check(name, value, least <= value <= 100, f"from {least} to 100")
    for name, side in sides.items():
        check(name, side, 0 < side < math.inf, "positive")
