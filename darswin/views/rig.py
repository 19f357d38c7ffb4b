"""A view bound to a rig: the map between the pictures of several cameras and the view."""

import itertools
import math
import warnings
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from darswin.lens.rig import Rig
from darswin.ops import _module
from darswin.utils.arrays import as_tensor
from darswin.utils.parameters import check
from darswin.utils.tasks import IGNORE
from darswin.views.base import Pair, PerChannel, View, form_of_frames
from darswin.views.remap import Remap, aside
from darswin.views.rig_reads import (
    Frames,
    Reads,
    Seam,
    Seen,
    checked,
    corners,
    grid,
    read_at,
    reads_of,
    see,
)

if TYPE_CHECKING:
    from darswin.frames import Sampler
    from darswin.frames.rig_plans import RigPlan

_ONE_SURFACE = 1.1  # the largest ratio of depths of neighbours on one surface
_ONE_PLACE = 1e-6  # m
_RIM = 0.02  # of the room of a camera: at the rim, pixels mix with what is beyond
_GREY = (4, 251)  # of 8 bits: what is darker or lighter says nothing about gains


class Middles(NamedTuple):
    """The pixels (K,) of a view that one camera shows best. In its picture, row by row: the pixels
    nearest to their middles, (K,), and the upper left ones of the four around, (K,); the places
    (2, K) from there to the right and down; and the cosines (K,) of the rays to its axis."""

    mine: np.ndarray
    nearest: np.ndarray
    first: np.ndarray
    shares: np.ndarray
    cosines: np.ndarray


class RigRemap:
    """The map between the pictures of a rig's cameras and what a view shows of them together.

    `view.at(rig)` makes it. Each point of a pixel is read from the camera that sees it farthest
    from θ_max and from the border of its picture, or from several, and a pixel is the mean of its
    points. Their number follows the ratio of the scales. Outer pixels extend to the borders.

    Frames are a list in the order of `rig.names`, or a mapping from names, which then decide.

    Args:
        view: a `GroundView`, a `CameraView`, or a view of rays, in the rig's level frame: x right,
            y down, z ahead. Without `fov`, a view of rays shows as much as its kind usually has.
        seam: "hard" reads each point from one camera; "narrow" mixes two in the middle of their
            overlap, and "wide" all cameras that see it.
        gain: whether each camera gets one factor, from where the frames overlap; see `gains`.
        distance: m, of what the view shows from the middle of the rig. None is infinity: right if
            the cameras are at one place. A `GroundView` has its own.

    Attributes:
        view_size: (H', W') of the view. sources: for each camera its own `Remap`, with which points
            and boxes move.

    Raises:
        TypeError: the view follows one lens.
        ValueError: an argument is out of range, no camera sees anything of the view, or a camera is
            not above the ground of a `GroundView`.
    """

    def __init__(
        self, view: Any, rig: Rig, *, seam: Seam = "hard", gain: bool = False,
        distance: float | None = None,
    ):  # fmt: skip
        check("seam", repr(seam), seam in get_args(Seam), f"one of {', '.join(get_args(Seam))}")
        if distance is not None:
            is_right = not view.is_surface and rig.spread < distance < math.inf
            check("distance", distance, is_right, "above the distances of the cameras from their "
                  "middle, and left out for a GroundView")  # fmt: skip
        self.view, self.rig = view.in_rig(), rig
        self.seam, self.gain, self.distance = seam, gain, distance
        self.view_size: Pair = self.view.size
        self.sources: dict[str, Remap] = {}
        for name, camera in rig.cameras.items():
            height = camera.pose[:3, 3] @ rig.up
            if view.is_surface and height <= 0:
                raise ValueError(
                    f"camera {name} is {height:.3g} m above the ground, which passes through the "
                    "rig's origin: rig.raised(height) lowers the origin to the ground"
                )
            seen = self.view.of_camera(camera, rig, distance)
            self.sources[name] = Remap(seen, camera.lens, camera.size)

    # -- points -------------------------------------------------------------------------------

    def to_image(self, points: Any) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2) of the view → the number of the camera that shows each best, (...), -1
        for none; and its pixels there, (..., 2), NaN for none."""
        flat = np.asarray(points, np.float64).reshape(-1, 2)
        seen, shape = see(self.view, self.rig, self.distance, flat), np.shape(points)
        best = np.where(seen.room.max(0) >= 0, seen.room.argmax(0), -1)
        pixels = np.where(best[:, None] >= 0, seen.pixels[best, np.arange(len(flat))], np.nan)
        return best.reshape(shape[:-1]), pixels.reshape(shape)

    def to_view(self, points: Any, source: int | str = 0) -> Any:
        """Pixels (..., 2) of a camera's picture, by its number or name → pixels of the view, also
        beyond its edges; NaN where it does not show them."""
        return self.source(source).to_view(points)

    def source(self, source: int | str) -> Remap:
        """The map of one camera, by its number or its name."""
        name = source if isinstance(source, str) else self.rig.names[source]
        self.rig[name]  # KeyError for an unknown one
        return self.sources[name]

    @cached_property
    def shown(self) -> np.ndarray:
        """The pixels of the view that show something of a picture, (H', W')."""
        return np.bincount(self.reads.pixels, minlength=self._count).reshape(self.view_size) > 0

    @property
    def seen_by(self) -> np.ndarray:
        """Whether each of the n cameras sees each pixel of the view, (n, H', W')."""
        return self._seen.room.reshape(-1, *self.view_size) >= 0

    # -- frames -------------------------------------------------------------------------------

    def __call__(self, frames: Frames) -> Any:
        """What the view shows of frames; 0 where it shows nothing.

        Args:
            frames: arrays (H, W) or (H, W, C), of up to 16 bits or in floating point, all of one
                type; or tensors (B, C, H, W), through which gradients flow.

        Returns:
            (H', W') or (H', W', C), of the frames' dtype; of tensors (B, C, H', W').

        Raises:
            TypeError, ValueError: frames are missing, unknown, of other sizes or of unequal types.
        """
        frames = checked(frames, self.rig)
        gains = self.gains(frames) if self.gain else None
        if isinstance(frames[0], Tensor):
            return self._mixed([View.floating(self.view, f, torch.float32) for f in frames], gains)
        is_plain = frames[0].dtype == np.uint8 and frames[0].shape[2:] in ((), (1,), (3,))
        if is_plain and _module.LACK is None:
            return (self._sampler if gains is None else self.sampler(gains=gains))(frames)
        kind = frames[0].dtype
        planes = [as_tensor(np.atleast_3d(f)).movedim(2, 0)[None] for f in frames]
        planes = [p if p.is_floating_point() else p.float() for p in planes]
        picture = self._mixed(planes, gains)[0].movedim(0, -1).numpy()
        if kind.kind != "f":
            picture = picture.round().clip(0, np.iinfo(kind).max)
        return picture.astype(kind).reshape(*self.view_size, *frames[0].shape[2:])

    def target(self, targets: Frames) -> np.ndarray:
        """Maps of labels in the view: a pixel takes the nearest of its best camera, no mixture.

        Args:
            targets: arrays (H, W), as `frames`.

        Returns:
            (H', W'), of the same dtype. It is `IGNORE` (255) in uint8, and 0 in others, where the
            view shows nothing.
        """
        targets = checked(targets, self.rig, maps=True)
        kind = targets[0].dtype.newbyteorder("=")
        picture = np.full(self._count, IGNORE if kind == np.uint8 else 0, kind)
        for target, middles in zip(targets, self._middles, strict=True):
            picture[middles.mine] = target.ravel().take(middles.nearest)
        return picture.reshape(self.view_size)

    def depth(
        self, depths: Frames, to: Literal["distance", "z"] = "distance",
        of: Literal["distance", "z"] = "z",
    ) -> np.ndarray:  # fmt: skip
        """The distances of what the view shows, without surfaces that stand nowhere.

        1/z of a picture without distortion is linear on a plane: it is interpolated where four
        neighbours are within 10 % of each other; else the nearest counts.

        Args:
            depths: arrays (H, W) in floating point, in any unit; infinite for the sky; unknown if
                NaN or not above 0.
            to: what is wanted: distances along rays, or z along the axis of the view.
            of: what the arrays hold: z along the axis of each camera, or distances along rays.

        Returns:
            (H', W') float32, NaN where nothing is known.

        Raises:
            ValueError: the cameras are at different places, so that their distances are not those
                of the view.
        """
        for name, kind in (("to", to), ("of", of)):
            check(name, repr(kind), kind in ("distance", "z"), "distance or z")
        if self.view.is_surface or self.rig.spread > _ONE_PLACE:
            raise ValueError("distances are those of a view if all cameras are at its place")
        depths = checked(depths, self.rig, maps=True)
        distances = np.full(self._count, np.nan, np.float32)
        for depth, middles in zip(depths, self._middles, strict=True):
            flat, width = depth.ravel().astype(np.float32, copy=False), depth.shape[1]
            (right, lower), steps = middles.shares, (0, 1, width, width + 1)
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b, c, d = (1 / flat[step:].take(middles.first) for step in steps)
                least = np.minimum(np.minimum(a, b), np.minimum(c, d))
                most = np.maximum(np.maximum(a, b), np.maximum(c, d))
                upper = a + (b - a) * right
                mixed = upper + (c + (d - c) * right - upper) * lower
                nearest = flat.take(middles.nearest)
                nearest[~(nearest > 0)] = np.nan
                # Not at infinity, nor where a depth is unknown.
                one_surface = (least > 0) & (most <= _ONE_SURFACE * least) & (most < np.inf)
                far = np.where(one_surface, 1 / mixed, nearest)
                distances[middles.mine] = far / middles.cosines if of == "z" else far
        if to == "z":
            axis = getattr(self.view, "direction", (0.0, 0.0, 1.0))
            rays = self.view.places(torch.from_numpy(self._grid)[None])[0].numpy()
            distances *= rays @ np.array(axis)
        return distances.reshape(self.view_size)

    # -- where cameras overlap ----------------------------------------------------------------

    def overlaps(self, frames: Frames) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
        """What two cameras show where both see the view, for each pair that overlaps.

        Returns:
            By the names of a pair: the pixels of the view, (K, 2) x and y; and their values, (2, K,
            C) float32, from the frames of both.
        """
        values = []
        for frame, pixels in zip(checked(frames, self.rig), self._seen.pixels, strict=True):
            images = frame
            if isinstance(frame, np.ndarray):
                images = as_tensor(np.atleast_3d(frame)).movedim(2, 0)[None]
            read = read_at(images.detach().float(), np.nan_to_num(pixels))
            values.append(read.flatten(0, 1).T.cpu().numpy())
        shown = self._seen.room >= _RIM
        pairs = {}
        for a, b in itertools.combinations(range(len(values)), 2):
            both = np.flatnonzero(shown[a] & shown[b])
            if len(both):
                names, width = self.rig.names, self.view_size[1]
                places = np.stack((both % width, both // width), -1)
                pairs[names[a], names[b]] = places, np.stack((values[a][both], values[b][both]))
        return pairs

    def gains(self, frames: Frames) -> np.ndarray:
        """The factors (n,) of the cameras that make their frames equally bright where they overlap.

        The product of all factors is 1. Of frames of 8 bits, values near 0 and 255 do not count. A
        camera that overlaps with no other has the factor 1.
        """
        names = self.rig.names
        rows, goals = [np.ones(len(names))], [0.0]
        for (a, b), (_, (first, second)) in self.overlaps(frames).items():
            inside = np.ones(first.shape[:1], bool)
            if checked(frames, self.rig)[0].dtype in (np.uint8, torch.uint8):
                both = np.concatenate((first, second), 1)
                inside = np.all((both >= _GREY[0]) & (both <= _GREY[1]), axis=1)
            sums = first[inside].sum(dtype=np.float64), second[inside].sum(dtype=np.float64)
            if min(sums) > 0:
                row, weight = np.zeros(len(names)), math.sqrt(inside.sum())
                row[names.index(a)], row[names.index(b)] = weight, -weight
                rows.append(row)
                goals.append(weight * math.log(sums[1] / sums[0]))
        return np.exp(np.linalg.lstsq(np.array(rows), np.array(goals))[0])

    def disagreement(self, frames: Frames) -> tuple[dict[tuple[str, str], float], np.ndarray]:
        """How much cameras differ where they overlap, after `gain`: a check of poses and lenses.

        Returns:
            The mean difference of each pair, in units of the frames; and the largest at each pixel
            of the view, (H', W') float32, NaN where fewer than two cameras see it.
        """
        picture, means = np.full(self._count, np.nan, np.float32), {}
        factors = self.gains(frames) if self.gain else np.ones(len(self.rig))
        gains = dict(zip(self.rig.names, factors.astype(np.float32), strict=True))
        for pair, (places, (first, second)) in self.overlaps(frames).items():
            apart = np.abs(first * gains[pair[0]] - second * gains[pair[1]]).mean(1)
            means[pair] = float(apart.mean())
            at = places @ (1, self.view_size[1])
            picture[at] = np.fmax(picture[at], apart)
        return means, picture.reshape(self.view_size)

    # -- programs -----------------------------------------------------------------------------

    def sampler(
        self, output: Literal["uint8", "image"] = "uint8", *, gains: Any = None,
        mean: PerChannel | None = None, std: PerChannel | None = None,
    ) -> "Sampler":  # fmt: skip
        """A `darswin.frames.Sampler` of the cameras' frames; arguments: see `plan`."""
        from darswin.frames.sampler import Sampler

        return Sampler(self.plan(output, gains=gains, mean=mean, std=std))

    def plan(
        self, output: Literal["uint8", "image"] = "uint8", *, gains: Any = None,
        mean: PerChannel | None = None, std: PerChannel | None = None,
    ) -> "RigPlan":  # fmt: skip
        """The points at which the cameras' frames are read, for `darswin.frames.Sampler`.

        Args:
            output, mean, std: see `Remap.plan`.
            gains: (n,), a factor for each camera, such as those of `gains`.
        """
        from darswin.frames.plan_files import check_size
        from darswin.frames.rig_plans import RigPlan  # the compiled module

        sizes, reads = [check_size(c.size) for c in self.rig.cameras.values()], self.reads
        factors = np.asarray(np.ones(len(sizes)) if gains is None else gains, np.float32)
        columns, rows, right, lower = corners(reads.points, np.array(sizes)[reads.sources].T)
        return RigPlan(
            counts=np.bincount(reads.pixels, minlength=self._count)
            .astype(np.uint16).reshape(self.view_size),
            sources=reads.sources, columns=columns.astype(np.int16), rows=rows.astype(np.int16),
            right=right.astype(np.float32), lower=lower.astype(np.float32),
            weights=reads.weights * factors[reads.sources], sizes=tuple(sizes),
            names=self.rig.names, **form_of_frames(self.view, output, mean, std),
        )  # fmt: skip

    # -- of the rig alone ---------------------------------------------------------------------

    @property
    def _count(self) -> int:
        return math.prod(self.view_size)

    @property
    def _grid(self) -> np.ndarray:
        return grid(np.arange(self._count), self.view_size, 1)

    @cached_property
    def _seen(self) -> Seen:
        """What the cameras see of the middles of all pixels."""
        seen = see(self.view, self.rig, self.distance, self._grid)
        shows = [bool((room >= 0).any()) for room in seen.room]
        if not any(shows):
            raise ValueError(f"no camera sees anything of the view {self.view}")
        if self.rig.spread > _ONE_PLACE and not all(shows):
            names = [n for n, k in zip(self.rig.names, shows, strict=True) if not k]
            warnings.warn(f"the view shows nothing of {', '.join(names)}", stacklevel=4)
        return seen

    @cached_property
    def reads(self) -> Reads:
        """The points at which the frames are read."""
        with torch.inference_mode(False), torch.no_grad():
            return reads_of(self.view, self.rig, self._seen, self.seam, self.distance)

    @cached_property
    def _sampler(self) -> "Sampler":
        return self.sampler()

    @cached_property
    def _middles(self) -> list[Middles]:
        """Where each camera shows the middles of pixels that it shows best."""
        found = []
        for number, (remap, points) in enumerate(
            zip(self.sources.values(), self._seen.pixels, strict=True)
        ):
            room = self._seen.room
            mine = np.flatnonzero((room.argmax(0) == number) & (room[number] >= 0))
            nudged = points[mine] + aside(self.view_size).reshape(-1, 2)[mine]
            x, y = np.rint(nudged.clip(0, np.array(remap.size[::-1]) - 1)).astype(np.intp).T
            columns, rows, _, _ = corners(points[mine], remap.size)
            # Beyond the middles of outer pixels, planes go on.
            shares = (points[mine] - np.stack((columns, rows), 1)).astype(np.float32).T
            cosines = remap.rays_of_image(points[mine])[:, 2].astype(np.float32)
            nearest, first = (r * remap.size[1] + c for r, c in ((y, x), (rows, columns)))
            found.append(Middles(mine, nearest, first, shares, cosines))
        return found

    def _mixed(self, images: list[Tensor], gains: np.ndarray | None) -> Tensor:
        """The view of images (B, C, H, W) in floating point: (B, C, H', W')."""
        reads = self.reads
        mixed = images[0].new_zeros(*images[0].shape[:2], self._count)
        for number, image in enumerate(images):
            mine = np.flatnonzero(reads.sources == number)
            factor = 1.0 if gains is None else gains[number]
            weights = torch.from_numpy(reads.weights[mine] * np.float32(factor)).to(image)
            values = read_at(image, reads.points[mine]) * weights
            mixed = mixed.index_add(
                2, torch.from_numpy(reads.pixels[mine]).to(image.device), values
            )
        return mixed.unflatten(2, self.view_size)

    def __repr__(self) -> str:
        return f"RigRemap({self.view}, {self.rig})"
