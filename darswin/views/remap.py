"""A view bound to one camera: the map between the camera's pictures and what the view shows."""

from collections.abc import Callable, Sequence
from functools import cached_property, wraps
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from darswin.boxes import Instances
from darswin.boxes.arrays import PointMap, table_of
from darswin.lens import Lens
from darswin.ops import _module
from darswin.ops.checks import check_pair, tensor_there
from darswin.utils.arrays import as_tensor
from darswin.utils.tasks import IGNORE
from darswin.views.base import Pair, PerChannel, check_images, check_lens, form_of_frames
from darswin.views.floor import on_floor
from darswin.views.orientation import Vector

if TYPE_CHECKING:
    from darswin.frames import Plan, Sampler

Points = TypeVar("Points", np.ndarray, Tensor)
Value = TypeVar("Value")

_ROUNDING = 1e-3  # px: a point that is this little beyond the edge of a picture is on it
_NUDGE = 1e-3  # px, more than the rounding of points in float32


def tensor_like(like: Tensor, values: np.ndarray) -> Tensor:
    """The values as a tensor on the device of another one, in its floating type or else float32."""
    dtype = like.dtype if like.is_floating_point() else torch.float32
    return torch.as_tensor(values, dtype=dtype, device=like.device)


def _kept(function: Callable[["Remap"], Value]) -> "cached_property[Value]":
    """A property that is computed once: without gradients, but so that they can flow through it
    later, also if it is first used in inference mode."""

    @wraps(function)
    def compute(remap: "Remap") -> Value:
        with torch.inference_mode(False), torch.no_grad():
            return function(remap)

    return cached_property(compute)


class Remap:
    """The map between the pictures of one camera and what a view shows of them.

    `view.at(lens, size)` makes it. What depends on the lens alone is computed once, when it is
    first used, in float64; no gradient reaches the lens. Points are pixels, x and y, and their
    centres are whole numbers; boxes have the coordinates of `darswin.boxes`. Arrays give arrays,
    and tensors give tensors.

    A view of several tiles has a map for each of them, in `tiles`. Points and boxes belong to one
    tile; pictures and maps are those of all tiles.

    Attributes:
        view: the `PixelView`. size: (H, W) of the camera's pictures. view_size: (H', W') of the
            view, or of a tile.

    Raises:
        TypeError: the lens is missing, and the view uses one.
        ValueError: there are several lenses, or the lens belongs to pictures of another size.
    """

    def __init__(self, view: Any, lens: Lens | None, size: Pair):
        self.view, self.size = view, check_pair("size", size, 1)
        self.view_size = view.size or self.size
        self._given = lens
        if (view.uses_lens or lens is not None) and len(check_lens(lens, self.size)) != 1:
            raise ValueError(f"a view is bound to one lens, got {len(lens or ())}")

    @_kept
    def lens(self) -> Lens | None:
        """The lens of the pictures, in float64 on the CPU, or None."""
        if self._given is None:
            return None
        return self._given.detach().to("cpu", torch.float64)._map(torch.clone)

    @property
    def some_lens(self) -> Lens:
        """The lens; TypeError if it is None."""
        if self.lens is None:
            raise TypeError("rays need the lens of the pictures, but it is None")
        return self.lens

    @_kept
    def tiles(self) -> Sequence["Remap"]:
        """A map for each picture that the view shows. Without tiles, that is the map itself."""
        if self.view.count == 1:
            return [self]
        return [Remap(tile, self._given, self.size) for tile in self.view.tiles]

    @_kept
    def camera(self) -> Lens | None:
        """The lens of the view's picture, if it is that of a camera."""
        return self.view.camera(self._given, self.size)

    @property
    def mirrored(self) -> bool:
        """Whether the view swaps left and right."""
        return self.view.turn.mirrored

    # -- points and boxes ---------------------------------------------------------------------

    def to_view(self, points: Points) -> Points:
        """Pixels (..., 2) of the picture → pixels (..., 2) of the view, also beyond its edges; NaN
        where no ray lands. ValueError for points of another shape."""
        return self._moved(points, lambda p: self._one.to_view(p, self.lens, self.size))

    def to_image(self, points: Points) -> Points:
        """Pixels (..., 2) of the view → pixels (..., 2) of the picture; NaN where it shows nothing:
        no ray lands, or it ends. ValueError for points of another shape."""

        def move(pixels: Tensor) -> Tensor:
            points = self._one.to_image(pixels, self.lens, self.size)
            sides = tensor_there(self.size[::-1], points)
            beyond = (points + 0.5 - sides / 2).abs() > sides / 2 + _ROUNDING
            return torch.where(beyond.any(-1, keepdim=True), torch.nan, points)

        return self._moved(points, move)

    def rays(self, points: Points) -> Points:
        """Pixels (..., 2) of the view → unit vectors (..., 3) in the camera's frame, NaN where the
        view shows nothing."""
        return self._moved(points, lambda p: self._one.to_rays(p, self.some_lens, self.size))

    def rays_of_image(self, points: Points) -> Points:
        """`rays` of pixels (..., 2) of the picture."""
        return self._moved(points, lambda p: self.some_lens.unproject_points(p, self.size))

    def boxes_to_image(self, boxes: Any) -> tuple[Any, Any, Any]:
        """Boxes (K, 4 or 5) of the view → boxes of the picture, by the ellipses inside them.

        Boxes are cut at the edges of the view first, unless they are turned, and those without an
        area are NaN. `darswin.boxes.Instances.through` moves all that belongs to them.

        Returns:
            Boxes (K, 4 or 5), NaN if nothing is shown; the shares that are shown, (K,); and the
            directions of the middles of the boxes of the view in the camera's frame, (K, 3) unit
            vectors, 0 where no ray lands, or None without a lens.
        """
        return self._boxes(boxes, self.to_image, (self.view_size, self.size), self.rays)

    def boxes_to_view(self, boxes: Any) -> tuple[Any, Any, Any]:
        """Boxes (K, 4 or 5) of the picture → boxes of the view, as `boxes_to_image` back."""
        sizes = self.size, self.view_size
        return self._boxes(boxes, self.to_view, sizes, self.rays_of_image)

    def floor(self, boxes: Any, height: float, up: Vector, radius: float = 0.0) -> Any:
        """Where the objects in boxes (K, 4) of a level view stand on the floor, (K, 2) in metres.

        The origin is below the camera. y is ahead: along the level part of the optical axis, or of
        the picture's top if the axis is within 10° of the vertical. x is to the right of it.

        Args:
            height: of the camera above the floor, m.
            up: the direction away from gravity in the camera's frame. The view is level with it.
            radius: of the objects, which are upright cylinders, m. 0 finds their nearest points.

        Returns:
            NaN for a box without an area, and where its lower side is not below the horizon, or at
            the lower edge of the view, where an object may be cut.

        Raises:
            ValueError: a number is out of its range, or the view is not level with `up`.
        """
        return on_floor(self, boxes, height, up, radius)

    def _boxes(
        self, boxes: Any, points_map: PointMap, sizes: tuple[Pair, Pair], rays: PointMap
    ) -> tuple[Any, Any, Any]:
        table = table_of(boxes.detach() if isinstance(boxes, Tensor) else boxes)
        rays_of = None if self.lens is None else rays
        moved = Instances(table).through(points_map, sizes[1], cut=sizes[0], rays=rays_of)
        columns = moved.boxes, moved.more["visible"], moved.more.get("rays")
        if not isinstance(boxes, Tensor):
            return columns
        there, visible, of_rays = columns
        rays_there = None if of_rays is None else tensor_like(boxes, of_rays)
        return tensor_like(boxes, there), tensor_like(boxes, visible), rays_there

    def _moved(self, points: Points, move: Callable[[Tensor], Tensor]) -> Points:
        if (shape := tuple(np.shape(points)))[-1:] != (2,):
            raise ValueError(f"points must have shape (..., 2), got {shape}")
        if not isinstance(points, Tensor):
            array = np.asarray(points)
            moved = move(as_tensor(array, torch.float64)[None])[0]
            return moved.numpy().astype(np.result_type(array, np.float32), copy=False)
        moved = move(points[None].to("cpu", torch.float64))[0]
        return moved.to(points.device, torch.promote_types(points.dtype, torch.float32))

    @property
    def _one(self) -> Any:
        """The view, which must be of one picture."""
        if self.view.count > 1:
            raise ValueError("points and boxes belong to one tile: use a map of remap.tiles")
        return self._bound

    @_kept
    def _bound(self) -> Any:
        return self.view if self.lens is None else self.view.for_lens(self.lens, self.size)

    # -- pictures and maps --------------------------------------------------------------------

    def __call__(self, picture: Points) -> Points:
        """What the view shows of a picture; 0 where it shows nothing.

        Args:
            picture: an array (H, W) or (H, W, C), of up to 16 bits or in floating point; or a
                tensor (B, C, H, W), through which gradients flow. Ids are for `target`.

        Returns:
            (H', W') or (H', W', C), of the picture's dtype, n tiles as (n, H', W', …); of a tensor
            the result of `view.see`, (B·n, C, H', W').

        Raises:
            TypeError: the picture is neither an array nor a tensor, or has integers of more bits.
            ValueError: it has another size.
        """
        if isinstance(picture, Tensor):
            images = check_images(picture)
            self._check_size("picture", tuple(images.shape[2:]))
            return self.view.see(images, self._prepared)
        if not isinstance(picture, np.ndarray):
            kind = type(picture).__name__
            raise TypeError(f"the picture must be an array or a tensor, got {kind}")
        if picture.dtype.kind in "iu" and picture.itemsize > 2:
            raise TypeError(f"a picture of {picture.dtype} would be mixed: remap.target moves ids")
        picture = np.asarray(picture, picture.dtype.newbyteorder("="))  # else OpenCV misreads it
        self._check_size("picture", picture.shape[:2])
        if not picture.size:  # no channels, which neither OpenCV nor torch takes
            return self(np.zeros((*self.size, 1), picture.dtype))[..., :0]
        return self.view.picture(picture, self)

    def _check_size(self, name: str, shape: tuple[int, ...]) -> None:
        if shape != self.size:
            raise ValueError(f"the {name} must be (H, W) = {self.size}, got {shape}")

    def sampled(self, picture: np.ndarray) -> np.ndarray:
        """`remap(picture)` by points: compiled for uint8 and float32, else through torch."""
        planes = np.ascontiguousarray(np.atleast_3d(picture))
        if picture.dtype in (np.uint8, np.float32) and _module.LACK is None:
            from darswin.frames.compiled import frames

            supersampling = self.points.shape[1] // self.view_size[1]
            seen = frames.read(planes, self.points, supersampling)
        else:
            images = as_tensor(planes).movedim(2, 0)[None]
            images = images if images.is_floating_point() else images.float()
            seen = self.view.see(images, self._prepared).movedim(1, -1).numpy()
            seen = (seen if picture.dtype.kind == "f" else seen.round()).astype(picture.dtype)
        tiles = (self.view.count,) if self.view.count > 1 else ()
        return seen.reshape(*tiles, *self.view_size, *picture.shape[2:])

    def sampler(
        self, output: Literal["uint8", "image"] = "uint8", *, mean: PerChannel | None = None,
        std: PerChannel | None = None,
    ) -> "Sampler":  # fmt: skip
        """A `darswin.frames.Sampler` of the camera's frames; arguments: see `plan`."""
        from darswin.frames.sampler import Sampler

        return Sampler(self.plan(output, mean=mean, std=std))

    def plan(
        self, output: Literal["uint8", "image"] = "uint8", *, mean: PerChannel | None = None,
        std: PerChannel | None = None,
    ) -> "Plan":  # fmt: skip
        """The points at which the camera's frames are read, for `darswin.frames.Sampler`.

        Args:
            output: "uint8" or "image", see `Plan`.
            mean, std: the normalization of "image"; the default is the view's.
        """
        from darswin.frames.plan_files import check_size  # the compiled module
        from darswin.frames.plans import Plan

        check_size(self.size)
        form = form_of_frames(self.view, output, mean, std)
        supersampling = self.points.shape[1] // self.view_size[1]
        return Plan.of_points(
            self.points, self.size, **form, tiles=self.view.count, supersampling=supersampling
        )

    @_kept
    def points(self) -> np.ndarray:
        """The points of the picture at which the view is read, (k·H', k·W', 2), k² for each pixel;
        tiles are below each other. `OUTSIDE` where the view shows nothing.

        Raises:
            ValueError: the view sees nothing of the picture.
        """
        return self._bound.points_read(self.lens, self.size)

    def target(self, target: np.ndarray) -> np.ndarray:
        """A map of labels or distances in the view: each pixel takes the nearest, never a mixture.

        If two pixels are equally near, the side alternates from pixel to pixel, so that the map is
        not shifted relative to the picture.

        Args:
            target: (H, W), of the picture.

        Returns:
            (H', W'), n tiles as (n, H', W'), of the same dtype. It is `IGNORE` (255) in uint8, and
            0 in others, where the view shows nothing.

        Raises:
            ValueError: the target has another shape.
        """
        self._check_size("target", target.shape)
        if self.view.count > 1:
            return np.stack([tile.target(target) for tile in self.tiles])
        x, y = np.moveaxis(np.rint(self._target_points), -1, 0)
        height, width = self.size
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        target = np.asarray(target, target.dtype.newbyteorder("="))
        index = np.where(inside, y * width + x, 0).astype(np.intp)
        missing = target.dtype.type(IGNORE if target.dtype == np.uint8 else 0)
        return np.where(inside, target.ravel()[index], missing)

    @_kept
    def _target_points(self) -> np.ndarray:
        points = self._bound.points_of_target(self.lens, self.size)
        return points + aside(self.view_size) @ self.view.turn.matrix

    def back(self, maps: Points) -> Points:
        """A map of a network for the view → the pixels of the picture; 0 unless `shown`.

        Args:
            maps: a tensor (B·n, K, h, w) or an array (K, h, w), n tiles (n, K, h, w), also of a
                fraction of the view's size. Maps of integers take the nearest value.

        Returns:
            (B, K, H, W), or an array (K, H, W).

        Raises:
            ValueError: the maps have another number of dimensions.
        """
        form, least = ("(B, K, h, w)", 4) if isinstance(maps, Tensor) else ("(K, h, w)", 3)
        if not least <= len(maps.shape) <= 4:
            raise ValueError(f"maps must have shape {form}, got {tuple(maps.shape)}")
        if isinstance(maps, Tensor):
            return self.view.back(maps, self._prepared)
        planes = as_tensor(maps.reshape(self.view.count, *maps.shape[-3:]))
        return self.view.back(planes, self._prepared)[0].numpy()

    @property
    def shown(self) -> np.ndarray:
        """The pixels of the picture that the view shows, (H, W)."""
        shown = self._prepared.shown
        return np.ones(self.size, bool) if shown is None else shown[0].numpy()

    @_kept
    def _prepared(self) -> Any:
        return self._bound.prepare(self.lens, self.size)


class Remaps(Sequence[Remap]):
    """The maps of N lenses, each made when it is first used."""

    def __init__(self, view: Any, lens: Lens | None, size: Pair):
        self._view, self._lens, self._size = view, lens, size
        self._made: dict[int, Remap] = {}

    def __len__(self) -> int:
        return 1 if self._lens is None else len(self._lens)

    def __getitem__(self, number: Any) -> Any:
        if not 0 <= number < len(self):
            raise IndexError(f"there are {len(self)} lenses, got number {number}")
        if number not in self._made:
            lens = None if self._lens is None else self._lens[number]
            self._made[number] = Remap(self._view, lens, self._size)
        return self._made[number]


def aside(size: Pair) -> np.ndarray:
    """The offset of each pixel, before the nearest label is chosen, (H', W', 2) px.

    An even reduction puts every centre halfway between two pixels. If all took the upper one, the
    whole target would be shifted. So neighbours move in opposite directions. Pixels at mirrored
    places do so too, so that the target of a mirrored picture is mirrored.
    """

    def along(side: int) -> np.ndarray:
        sign = (-1.0) ** np.arange(side // 2)
        return _NUDGE * np.concatenate((-sign, np.zeros(side % 2), sign[::-1]))

    return np.stack(np.meshgrid(along(size[1]), along(size[0])), -1)
