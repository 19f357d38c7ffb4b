"""What goes wrong in a calibration, as corners: each mishap takes a good rig and a generator, and
gives the corners and the board that a user would calibrate from. `python
tests/calibrate/mishaps.py` prints what is said of all of them."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from rigs import Rig, board, f64, ray_errors, rig, true_lens, turn
from torch import Tensor

from darswin.calibrate import CalibrationError, calibrate
from darswin.calibrate.doubts import Note

SIZE = (960, 1000)


class Given(NamedTuple):
    """What is calibrated from: corners (P, K, 2) and board (K, 2); options of `calibrate`."""

    corners: Tensor
    board: Tensor
    options: Mapping[str, Any] = MappingProxyType({})


def seen(lens, solid, rotations, translations, noise=0.1, generator=None) -> Tensor:
    """The corners of solid boards, (K, 3) or one for each pose."""
    pixels = lens.project_points(solid @ rotations.mT + translations[:, None])
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=f64)
    inside = ((pixels > 2) & (pixels < torch.tensor([997.0, 957.0]))).all(-1, keepdim=True)
    return torch.where(inside, pixels, math.nan)


def flat(points: Tensor) -> Tensor:
    return torch.nn.functional.pad(points, (0, 1))


def zoomed(first: float, last: float, shift: float = 0.0, sudden: bool = True):
    """The scale and the centre change, at once in the middle or little by little."""

    def change(true: Rig, g) -> Given:
        count = len(true.corners)
        step = torch.linspace(0, 1, count, dtype=f64)
        step = (step > 0.5).to(f64) if sudden else step
        scale = (first + (last - first) * step)[:, None, None]
        corners = (true.corners - true.lens.center) * scale + true.lens.center
        return Given(corners + shift * step[:, None, None], true.board)

    return change


def other_camera(model: str, fov: float | None, part: int):
    """The first pictures are those of another camera, of the same field of view for None."""

    def change(true: Rig, g) -> Given:
        other = true_lens(model, fov or 2 * math.degrees(true.lens.theta_max.item()), seed=9)
        corners = seen(other, flat(true.board), true.rotations, true.translations, 0.1, g)
        corners[part:] = true.corners[part:]
        return Given(corners, true.board)

    return change


def unsteady(scale: float, shift: float, roll: float = 0.0):
    """Each picture is scaled, shifted and rolled a little, as stabilisers do."""

    def change(true: Rig, g) -> Given:
        a, x, y, r = torch.randn(4, len(true.corners), 1, generator=g, dtype=f64)
        apart = true.corners - true.lens.center
        turned = torch.stack((-apart[..., 1], apart[..., 0]), -1)
        moved = (1 + scale * a[..., None]) * apart + roll * r[..., None] * turned
        return Given(moved + true.lens.center + shift * torch.stack((x, y), -1), true.board)

    return change


def again(poses: list[int], times: int, jitter: float = 1e-4):
    """Bursts: some poses only, each many times, with hands that shake a little."""

    def change(true: Rig, g) -> Given:
        which = torch.tensor(poses).repeat_interleave(times)
        small = turn(jitter * torch.randn(len(which), 3, generator=g, dtype=f64))
        moved = 0.1 * jitter * torch.randn(len(which), 3, generator=g, dtype=f64)
        turns, places = true.rotations[which] @ small, true.translations[which] + moved
        return Given(seen(true.lens, flat(true.board), turns, places, 0.1, g), true.board)

    return change


def parallel(tilt: float, nearest=0.2, farthest=0.5, spread=0.3, noise=0.1):
    """Boards that are parallel to the sensor, up to a tilt in degrees."""

    def change(true: Rig, g) -> Given:
        u = torch.rand(15, 6, generator=g, dtype=f64) - 0.5
        lean = torch.nn.functional.normalize(u[:, 3:5], dim=1) * math.radians(tilt)
        turns = turn(torch.cat((lean * (u[:, 5:] + 0.5), 3 * u[:, 5:]), 1))
        depth = nearest + (farthest - nearest) * (u[:, 2:3] + 0.5)
        place = torch.cat((spread * u[:, :2], depth), 1)
        middle = flat(true.board - true.board.mean(0))
        return Given(seen(true.lens, middle, turns, place, noise, g), true.board)

    return change


def solid(shape: Callable[[Tensor, Tensor], Tensor], vary: bool = False):
    """The board is bent by shape(x, y) metres, x and y from -1 to 1; by another part each time."""

    def change(true: Rig, g) -> Given:
        x, y = ((true.board - true.board.mean(0)) / (true.board - true.board.mean(0)).amax(0)).T
        part = torch.randn(len(true.corners), 1, generator=g, dtype=f64) if vary else torch.ones(1)
        height = part * shape(x, y)
        places = torch.cat((true.board.expand(*height.shape, 2), height[..., None]), -1)
        return Given(seen(true.lens, places, true.rotations, true.translations, 0.1, g), true.board)

    return change


def corners(move: Callable[[Tensor, Tensor, torch.Generator], Tensor]):
    """The corners (P, K, 2) are moved in the picture; they come with those from the centre."""
    return lambda true, g: Given(move(true.corners, true.corners - true.lens.center, g), true.board)


def believed(change: Callable[[Tensor], Tensor], **options):
    """The board is another one than is said: the points that are believed."""
    return lambda true, g: Given(true.corners, change(true.board), options)


def only(choose: Callable[[Tensor], Tensor]):
    """Corners that are not chosen are not seen."""
    return corners(lambda c, apart, g: torch.where(choose(apart)[..., None], c, math.nan))


def pictures(count: int):
    return lambda true, g: Given(true.corners[:count], true.board)


def some(c: Tensor, changed: Tensor, which: slice) -> Tensor:
    out = c.clone()
    out[which] = changed[which]
    return out


def tailed(c, apart, g):
    normal = torch.randn(c.shape, generator=g, dtype=f64)
    chi = torch.randn(*c.shape[:2], 2, generator=g, dtype=f64).square().mean(-1, keepdim=True)
    return c + 0.3 * normal / chi.sqrt()


def outliers(part: float, px: float):
    def move(c, apart, g):
        odd = torch.rand(*c.shape[:2], 1, generator=g) < part
        return torch.where(odd, c + px * torch.randn(c.shape, generator=g, dtype=f64), c)

    return corners(move)


def rolling(px: float):
    """Rows are read one after the other while the camera moves."""

    def move(c, apart, g):
        way = px * torch.randn(len(c), 1, 2, generator=g, dtype=f64)
        return c + way * (c[..., 1:] / SIZE[0] - 0.5)

    return corners(move)


def ordered(change: Callable[[Tensor], Tensor], which: slice = slice(None)):
    """Corners come in another order: change takes grids (P, 6, 9, 2)."""
    return corners(lambda c, apart, g: some(c, change(c.unflatten(1, (6, 9))).flatten(1, 2), which))


def at_one_distance(true: Rig, g) -> Given:
    middle = true.board.mean(0)
    ray = torch.nn.functional.normalize(true.translations + true.rotations[..., :2] @ middle, dim=1)
    places = 0.25 * ray - true.rotations[..., :2] @ middle
    return Given(seen(true.lens, flat(true.board), true.rotations, places, 0.1, g), true.board)


def not_square(ratio: float, **options):
    def change(true: Rig, g) -> Given:
        c = true.corners.clone()
        c[..., 1] = (c[..., 1] - 480) * ratio + 480
        return Given(c, true.board, options)

    return change


MIRROR, WIDTH, LAST = torch.tensor([[-1.0, 1.0], [999.0, 0.0], [999.0, 959.0]], dtype=f64)
MISHAPS: dict[str, Callable[[Rig, torch.Generator], Given]] = {
    "two cameras, alike": other_camera("KannalaBrandt", None, 7),
    "two cameras, 5 % apart": zoomed(1.0, 1.05, 8.0),
    "two cameras, one picture": other_camera("Equisolid", 120, 1),
    "zoom changed by 1 %": zoomed(1.0, 1.01),
    "zoom changed by 5 %": zoomed(1.0, 1.05),
    "focus drifts by 1 %": zoomed(1.0, 1.01, sudden=False),
    "lens refitted, 6 px": zoomed(1.0, 1.0, 6.0),
    "stabiliser, 5 px": unsteady(0.0, 5.0),
    "stabiliser, 1 px, 0.5 %": unsteady(0.005, 1.0, 0.005),
    "half resized by 2 %": corners(lambda c, a, g: some(c, 0.98 * c, slice(0, None, 2))),
    "half cut and enlarged": corners(lambda c, a, g: some(c, 1.3 * a + 480, slice(0, None, 2))),
    "one picture mirrored": corners(lambda c, a, g: some(c, c * MIRROR + WIDTH, slice(3, 4))),
    "one picture upside down": corners(lambda c, a, g: some(c, LAST - c, slice(3, 4))),
    "all in one burst": again([2], 15),
    "one burst and two more": lambda true, g: Given(
        torch.cat((again([2], 12)(true, g).corners, true.corners[:2])), true.board),
    "three bursts": again([1, 4, 7], 6),
    "three bursts, by hand": again([1, 4, 7], 6, 2e-3),
    "tilt below 3°": parallel(3.0),
    "no tilt": parallel(0.0),
    "tilt below 3°, one distance": parallel(3.0, 0.25, 0.25),
    "tilt below 8°, in the middle": parallel(8.0, 0.3, 0.5, 0.05),
    "wrong square": believed(lambda b: 1.3 * b),
    "columns and rows swapped": believed(lambda b: board(6, 9)),
    "wrong gap between tags": believed(lambda b: b + 0.006 * (b / 0.06 + 1e-6).floor()),
    "stretched by 1 %": believed(lambda b: b * torch.tensor([1, 1.01])),
    "sheared by 1 %": believed(lambda b: b + 0.01 * b.flip(1) * torch.tensor([1, 0])),
    "bent by 1 mm": solid(lambda x, y: 1e-3 * x**2),
    "bent by 3 mm": solid(lambda x, y: 3e-3 * x**2),
    "twisted by 2 mm": solid(lambda x, y: 2e-3 * x * y),
    "waves of 1 mm": solid(lambda x, y: 1e-3 * torch.sin(5 * x)),
    "paper in a hand, 2 mm": solid(lambda x, y: 2e-3 * x**2, vary=True),
    "pixels 1 % not square": not_square(1.01),
    "pixels 1 % not square, held": not_square(1.01, square_pixels=True),
    "no rim": only(lambda apart: apart.norm(dim=-1) < 220),
    "a half of the picture": only(lambda apart: apart[..., 0] < -20),
    "one distance": at_one_distance,
    "three pictures": pictures(3),
    "four pictures": pictures(4),
    "a third of the corners": only(lambda apart: torch.arange(54) % 9 < 3),
    "corners mirrored in half": ordered(lambda c: c.flip(2), slice(0, None, 2)),
    "corners by columns": ordered(lambda c: c.swapaxes(1, 2).reshape(c.shape)),
    "a column skipped in half": ordered(
        lambda c: torch.cat((c[:, :, 1:], c[:, :, :1] * math.nan), 2), slice(0, None, 2)),
    "rolling shutter, 4 px": rolling(4.0),
    "noise of 2 px": outliers(1.0, 2.0),
    "heavy tails": corners(tailed),
    "a tenth of corners off by 10 px": outliers(0.1, 10.0),
    "corners drawn outwards": corners(
        lambda c, a, g: c + 2e-3 * a * (a.norm(dim=-1, keepdim=True) > 250)),
    "behind a pane": corners(
        lambda c, a, g: c + 3 * torch.exp(-((c - 300) / 150).square().sum(-1, keepdim=True))),
    "a wrong model": lambda true, g: Given(true.corners, true.board, {"model": "Stereographic"}),
}  # fmt: skip


def shown(corners: Tensor) -> Tensor:
    """The corners in the picture; NaN for the others."""
    there = ((corners >= 0) & (corners <= LAST)).all(-1, keepdim=True)
    return torch.where(there, corners, math.nan)


def case(name: str, fov: float, seed: int) -> tuple[Rig, Given]:
    """A rig of 15 pictures, and what a mishap makes of it."""
    true = rig(true_lens("KannalaBrandt", fov, seed=seed), 15, noise=0.1, seed=seed)
    given = MISHAPS[name](true, torch.Generator().manual_seed(seed))
    if "square" in name and "pixels" in name:
        affine = torch.tensor([[[1, 0], [0, 1.01]]], dtype=f64)
        center = true.lens.center + torch.tensor([0, 0.01]) * (true.lens.center - 480)
        true = true._replace(lens=true.lens.replace(affine=affine, center=center))
    return true, given._replace(corners=shown(given.corners))


def outcome(name: str, fov: float, seed: int) -> tuple[float, str, str]:
    """Degrees that 95 % of the rays miss at most, "error", "looks wrong", "note" or "", and why."""
    true, given = case(name, fov, seed)
    options = {"model": "KannalaBrandt"} | given.options
    try:
        found = calibrate(given.corners, given.board, SIZE, **options)
    except CalibrationError as error:
        return math.nan, "error", str(error)
    off = ray_errors(found.lens, true.lens, best=True).quantile(0.95).item()
    loud = [text for text in found.doubts if not isinstance(text, Note)]
    kind = "looks wrong" if loud else "note" * bool(found.doubts)
    return off, kind, "; ".join(loud or found.doubts)


if __name__ == "__main__":
    for name in MISHAPS:
        for fov, seed in ((60, 3), (100, 1), (120, 4), (190, 2)):
            off, kind, why = outcome(name, fov, seed)
            silent = "SILENT" * (off > 0.2 and kind in ("note", ""))
            print(f"{name:31} {fov:3}° {off:8.3f}° {silent or kind:12} {why:.90}", flush=True)
