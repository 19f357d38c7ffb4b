"""Boards and their corners, in rendered pictures through several lenses."""

import functools
import math

import cv2
import numpy as np
import pytest
from calibrate_boards import Renderer
from helpers import refused, slow_but

from darswin.calibrate import Board, boards, find_corners
from darswin.calibrate.boards import edge_width, misfit, pixels_per_unit, shown_instead, wrong
from darswin.calibrate.circle import image_circle
from darswin.lens import Equidistant, Lens, Perspective

CHESSBOARD = Board.chessboard(9, 6, 0.025)
BOARDS = {
    "chessboard": CHESSBOARD,
    "charuco": Board.charuco(7, 5, 0.03, 0.022),
    "april": Board.april_grid(4, 3, 0.03, 0.009),
}


@functools.cache
def camera(fov: float, size: tuple[int, int] = (480, 480), **look) -> Renderer:
    half = math.radians(fov / 2)
    radius = min(size) / 2 - 4
    lens: Lens = Equidistant(radius / half, half, image_size=size)
    if fov <= 90:
        # The sides of the picture are fov wide, and its corners wider.
        reach = math.atan(math.sqrt(2) * math.tan(half))
        lens = Perspective(min(size) / 2 / math.tan(half), reach, image_size=size)
    return Renderer(lens, samples=2, **look)


def shots(view: Renderer, board: Board, count: int = 1, seed: int = 1):
    """Pictures of a board in random poses, and its true corners in each."""
    rng = np.random.default_rng(seed)
    for pose in view.poses(board, count, rng):
        yield view.picture(board, pose, rng), view.corners(board, pose)


@pytest.mark.parametrize(("kind", "fov", "usual", "share"), slow_but(
    [*(("chessboard", fov, 0.12, 1.0) for fov in (60, 150, 200, 220)),
     ("charuco", 90, 0.2, 0.75), ("charuco", 200, 0.2, 0.7),
     ("april", 90, 0.3, 0.9), ("april", 220, 0.3, 0.9)],
    ("chessboard", 60, 0.12, 1.0), ("chessboard", 220, 0.12, 1.0), ("charuco", 200, 0.2, 0.7),
    ("april", 220, 0.3, 0.9),
))  # fmt: skip
def test_corners_are_found_where_they_are(kind, fov, usual, share):
    board, count, off = BOARDS[kind], 0, []
    for picture, true in shots(camera(fov), board, 3):
        found = find_corners(picture, board)
        assert found.shape == true.shape and found.dtype == np.float64
        # A chessboard looks the same from its other end.
        ways = (found, found[::-1]) if kind == "chessboard" else (found,)
        best = min([np.linalg.norm(way - true, axis=1) for way in ways], key=np.nanmedian)
        off.extend(best[np.isfinite(best)])
        count += len(true)
    assert len(off) >= share * count and np.median(off) < usual


@pytest.mark.parametrize("kind", ["charuco", "april"])
def test_a_board_with_markers_keeps_its_numbers_if_seen_in_part_and_is_never_mirrored(kind):
    board, found_some = BOARDS[kind], 0
    for picture, true in shots(camera(120, (360, 360)), board, 3, seed=3):
        # A hand lies on a part of the board.
        middle = np.nanquantile(true[:, 0], 0.6)
        covered = picture.copy()
        covered[:, int(middle) :] = 90
        found = find_corners(covered, board)
        assert np.isnan(found[true[:, 0] > middle + 3]).all()
        if (seen := np.isfinite(found[:, 0])).any():
            assert np.median(np.linalg.norm(found - true, axis=1)[seen]) < 0.4
            found_some += 1
    assert found_some >= 2
    assert np.isfinite(find_corners(picture, board)).sum() > 20
    assert np.isnan(find_corners(picture[:, ::-1], board)).all()


def test_grids_of_kalibr_are_read():
    """A grid as Kalibr draws it: a border of two bits, and tag 0 at the lower left."""
    tag, gap, columns, rows = 60, 18, 4, 3
    board = Board.april_grid(columns, rows, float(tag), float(gap))
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    picture = np.full((rows * 78 + 60, columns * 78 + 60), 230, np.uint8)
    for row, column in np.ndindex(rows, columns):
        number, y, x = (rows - 1 - row) * columns + column, 30 + row * 78, 30 + column * 78
        drawn = cv2.aruco.generateImageMarker(markers, number, tag, borderBits=2)
        picture[y : y + tag, x : x + tag] = drawn
    true = board.points + 29.5
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    np.testing.assert_allclose(find_corners(picture, board), true, atol=0.5)
    turned = np.array(picture.shape[::-1]) - 1 - true
    picture = np.ascontiguousarray(picture[::-1, ::-1])  # upside down
    np.testing.assert_allclose(find_corners(picture, board), turned, atol=0.5)


def test_grids_may_begin_with_another_tag():
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    drawn = cv2.aruco.GridBoard((2, 2), 60.0, 18.0, known, np.arange(30, 34))
    picture = cv2.GaussianBlur(drawn.generateImage((198, 198), marginSize=30), (0, 0), 0.7)
    board = Board.april_grid(2, 2, 60.0, 18.0, first_tag=30)
    assert [*board.markers] == [*range(30, 34)]
    np.testing.assert_allclose(find_corners(picture, board), board.points + 29.5, atol=1.0)
    for first in (0, 29):
        other = Board.april_grid(2, 2, 60.0, 18.0, first_tag=first)
        assert np.isnan(find_corners(picture, other)).all()
        said = f"but the board has {first} to {first + 3}: is its first tag 30?"
        assert shown_instead(picture, other) == f"markers 30 to 33 of APRILTAG_36h11, {said}"
        assert f"from `first_tag` {first} to {first + 3}, `gap` 18" in str(misfit(other, ""))


def test_corners_between_slanted_squares_are_where_edges_cross_or_not_found():
    """Squares of 40 px, sheared until their edges meet at 27°: as at the rim of a fisheye."""
    board = Board.chessboard(5, 4, 40.0)
    y, x = np.mgrid[:200, :240]
    cells = ((x // 40 + y // 40) % 2 * 200 + 25).astype(np.uint8)
    slant = np.array([[1.0, 0.8, 0.0], [0.25, 0.7, 20.0]])
    true = (board.points + 39.5) @ slant[:, :2].T + slant[:, 2]
    picture = cv2.warpAffine(cells, slant, (420, 230), borderValue=225)
    grid = true.reshape(4, 5, 2)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8)
    start = grid + np.random.default_rng(0).uniform(-1, 1, grid.shape)
    np.testing.assert_allclose(boards._refined(picture, start, board), grid, atol=0.2)
    # On an edge beside a corner, opposite sides are unlike.
    start[1, 2] += 0.3 * (grid[1, 3] - grid[1, 2])
    found = boards._refined(picture, start, board)
    assert np.isnan(found[1, 2]).all() or np.linalg.norm(found - grid, axis=-1)[1, 2] < 0.2
    radius = np.full((4, 5), 5.0)
    assert boards._unlike(picture, grid, radius).max() < 0.15
    moved = grid + 0.25 * (grid[1, 3] - grid[1, 2])
    assert boards._unlike(picture, moved, radius).min() > 0.3


@pytest.mark.parametrize(("rows", "white_first"), [(5, False), (5, True), (6, False), (6, True)])
def test_charuco_boards_may_begin_with_a_white_square(rows, white_first):
    drawn = cv2.aruco.CharucoBoard((7, rows), 1.0, 0.7, cv2.aruco.getPredefinedDictionary(2))
    drawn.setLegacyPattern(white_first)
    picture = cv2.GaussianBlur(drawn.generateImage((420, 60 * rows)), (0, 0), 0.7)
    picture = cv2.copyMakeBorder(picture, 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    board = Board.charuco(7, rows, 60.0, 42.0)
    np.testing.assert_allclose(find_corners(picture, board), board.points + 89.5, atol=0.5)


@pytest.fixture(scope="module")
def one() -> tuple[np.ndarray, np.ndarray]:
    """A picture of the chessboard, and its true corners."""
    return next(shots(camera(150, (360, 360)), CHESSBOARD))


def test_pictures_may_be_grey_coloured_or_turned_and_the_board_never_mirrored(one):
    picture, _ = one
    first = find_corners(picture, CHESSBOARD)
    for same in (picture[..., None], np.repeat(picture[..., None], 3, 2)):
        np.testing.assert_allclose(find_corners(same, CHESSBOARD), first, atol=1e-6)
    for turned in (np.rot90(picture), picture[::-1, ::-1], picture[:, ::-1], picture.T):
        grid = find_corners(np.ascontiguousarray(turned), CHESSBOARD).reshape(6, 9, 2)
        across, down = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
        assert (across[..., 0] * down[..., 1] > across[..., 1] * down[..., 0]).all()


@pytest.mark.parametrize("damage", slow_but(
    ["covered", "cut", "no board", "blurred", "another"], "cut", "no board", "blurred"
))  # fmt: skip
def test_a_board_that_is_not_there_or_not_whole_is_not_found(one, damage):
    board = Board.chessboard(8, 7, 0.025) if damage == "another" else CHESSBOARD
    picture, corners = one[0].copy(), one[1]
    x, y = corners[20].astype(int)
    if damage == "covered":
        picture[y - 20 : y + 20, x - 20 : x + 20] = 128
    elif damage == "cut":
        picture[:, int(np.median(corners[:, 0])) :] = 0
    elif damage == "no board":
        picture[:] = np.linspace(0, 255, picture.shape[1]).astype(np.uint8)
    elif damage == "blurred":
        picture = cv2.GaussianBlur(picture, (0, 0), 12)
    assert np.isnan(find_corners(picture, board)).all()


@pytest.mark.parametrize("change", ["mirrored", "exchanged", "off", "skipped"])
def test_a_wrong_order_is_noticed(one, change):
    grid = one[1].reshape(6, 9, 2).copy()
    assert not wrong(grid, CHESSBOARD).any()
    if change == "mirrored":
        grid = grid[:, ::-1]
    elif change == "exchanged":
        grid[2, [3, 4]] = grid[2, [4, 3]]
    elif change == "off":
        grid[3, 3] += 0.6 * (grid[3, 4] - grid[3, 3])
    else:
        grid[:, 5:] += grid[:, 5:6] - grid[:, 4:5]
    odd = wrong(grid, CHESSBOARD)
    assert odd.any()
    assert change != "off" or np.unravel_index(odd.argmax(), odd.shape) == (3, 3)


@pytest.mark.parametrize("fov", [60, 150, 250])
def test_true_corners_are_never_wrong(fov):
    for name, board in BOARDS.items():
        for pose in camera(fov).poses(board, 4, np.random.default_rng(2)):
            grid = camera(fov).corners(board, pose).reshape(board.rows, board.columns, 2)
            assert not wrong(grid, board).any(), name


def test_points_are_in_the_unit_of_the_square():
    expected = [[x, y] for y in (0, 2) for x in (0, 2, 4)]
    np.testing.assert_array_equal(Board.chessboard(3, 3, 2.0).points[:6], expected)
    np.testing.assert_array_equal(Board.charuco(4, 3, 2.0, 1.0).points, expected)
    expected = [[x, y] for y in (0, 2) for x in (0, 2, 2.5, 4.5)]
    np.testing.assert_array_equal(Board.april_grid(2, 1, 2.0, 0.5).points, expected)


@pytest.mark.parametrize(("make", "error", "said"), [
    (lambda: Board.chessboard(1, 6, 0.1), ValueError, "`columns` must be from 3 to 100, got 1"),
    (lambda: Board.chessboard(9, 6.0, 0.1), TypeError, "`rows` must be a whole number"),
    (lambda: Board.chessboard(9, 6, 0.0), ValueError, "`square` must be positive, got 0"),
    (lambda: Board.charuco(9, 6, 0.1, 0.1), ValueError, "`marker` must be below the square"),
    (lambda: Board.charuco(9, 6, 0.1, 0.05, "4X4_5"), ValueError, "did you mean 4X4_50"),
    (lambda: Board.charuco(20, 20, 0.1, 0.05, "4X4_50"), ValueError, "200 markers or more"),
    (lambda: Board.april_grid(6, 6, 0.1, 0.1, first_tag=-1), ValueError, "`first_tag` must be 0"),
    (lambda: Board.april_grid(6, 6, 0.1, 0.1, first_tag=560), ValueError, "596 markers or more"),
    (lambda: find_corners(np.zeros((9, 9)), CHESSBOARD), TypeError, "array of uint8"),
    (lambda: find_corners(np.zeros((9, 9, 4), np.uint8), CHESSBOARD), ValueError,
     r"\(H, W, 3\), got \(9, 9, 4\)"),
])  # fmt: skip
def test_wrong_arguments(make, error, said):
    refused(said, make, error=error)


@pytest.mark.parametrize("size", slow_but(
    [((480, 480),), ((400, 640),), ((640, 400),), ((480, 500),)], ((400, 640),)
))  # fmt: skip
def test_the_image_circle_is_that_of_the_lens(size):
    half, x, y = math.radians(100), size[1] / 2 + 6.0, size[0] / 2 - 4.0
    view = Renderer(Equidistant(205 / half, half, center=(x, y), image_size=size), samples=2)
    pictures = [picture for picture, _ in shots(view, CHESSBOARD, 3, seed=0)]
    np.testing.assert_allclose(image_circle(pictures), (x, y, 205), atol=1.5)
    # A board at the rim of a dark picture does not move it.
    dark = [(picture * 0.3).astype(np.uint8) for picture in pictures]
    np.testing.assert_allclose(image_circle(dark), (x, y, 205), atol=2.5)


def test_a_circle_that_is_cut_and_dented_is_found_and_none_where_none_is():
    y, x = np.mgrid[:480, :748]
    picture = np.where(np.hypot(x - 380.0, y - 236.0) < 290, 220, 6).astype(np.uint8)
    picture[100:300, 90:130] = picture[330:420, 600:700] = picture[430:480, 250:560] = 8
    np.testing.assert_allclose(image_circle([picture]), (380, 236, 290), atol=1.5)
    framed = np.zeros((300, 400), np.uint8)
    framed[40:-40, 40:-40] = 120
    for picture in (next(shots(camera(80), CHESSBOARD, seed=0))[0], framed, 0 * framed):
        assert image_circle([picture]) is None


def test_edges_are_as_wide_as_their_blur():
    widths = []
    for blur in (0.5, 1.0, 2.0):
        view = camera(90, (360, 360), blur=blur, noise=0.5)
        widths.append(edge_width(*next(shots(view, CHESSBOARD, seed=4)), CHESSBOARD))
    assert 1.4 < widths[0] < 2.2 and 2.3 < widths[1] < 3.3 and widths[2] > 3.8


@pytest.mark.parametrize("board", [Board.chessboard(5, 4, 0.5), Board.april_grid(2, 2, 1.0, 0.3)])
def test_pixels_per_unit_are_those_to_the_nearest_neighbour(board):
    grid = np.random.default_rng(0).uniform(0, 100, (board.rows, board.columns, 2))
    grid[1, 2] = np.nan
    points = board.points.reshape(grid.shape)
    least = np.full(grid.shape[:2], np.nan)
    for row, column in np.ndindex(least.shape):
        for y, x in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if 0 <= y < board.rows and 0 <= x < board.columns:
                px, units = (math.dist(of[row, column], of[y, x]) for of in (grid, points))
                least[row, column] = np.fmin(least[row, column], px / units)
    np.testing.assert_allclose(pixels_per_unit(grid, board), least)


def test_small_pictures_show_nothing():
    small = Board.chessboard(3, 3, 1.0), Board.charuco(4, 3, 1.0, 0.5)
    for size in ((0, 0), (0, 9), (1, 1), (3, 3), (40, 2), (15, 15), (16, 16), (17, 90)):
        picture = np.random.default_rng(1).integers(0, 256, size).astype(np.uint8)
        for board in (*small, Board.april_grid(1, 1, 1.0, 0.3)):
            assert np.isnan(find_corners(picture, board)).all()
        assert image_circle([picture]) is None and image_circle([0 * picture]) is None


@pytest.mark.slow
def test_markers_that_do_not_fit_the_board_are_told():
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    drawn = cv2.aruco.GridBoard((6, 4), 0.04, 0.012, known).generateImage((620, 420), marginSize=20)
    for board, said in (
        (Board.april_grid(6, 4, 0.04, 0.3), "the gap is a ratio"),
        (Board.april_grid(4, 6, 0.04, 0.012), "columns and rows are swapped"),
        (Board.april_grid(6, 4, 0.04, 0.012, dictionary="APRILTAG_25h9"), "of APRILTAG_36h11"),
        (Board.april_grid(3, 3, 0.04, 0.012), "markers 0 to 23 of APRILTAG_36h11"),
    ):
        assert np.isnan(find_corners(drawn, board)).all()
        shown = shown_instead(drawn, board)
        assert shown.startswith("markers 0 to 23 of APRILTAG_36h11") and said in shown
    # The smallest set of markers is named.
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    drawn = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.022, known).generateImage((400, 300))
    for dictionary, named in (("5X5_250", "4X4_50"), ("4X4_250", "4X4_250")):
        board = Board.charuco(6, 8, 0.03, 0.022, dictionary=dictionary)
        assert f"markers 0 to 23 of {named}" in shown_instead(drawn, board)
