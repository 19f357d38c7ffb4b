"""Detections of networks behind views, carried back to the pixels of the images."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from darswin import boxes as of_boxes
from darswin.lens.pixels import OUTSIDE
from darswin.utils.tables import read_table
from darswin.views import PolarGrid, Prepared, View

NAMES = ("boxes", "scores", "labels")


def find_detections(results: Any) -> list[Mapping[str, Tensor]] | None:
    """The detections for each picture if a network's results are some, or None.

    They are a dict of boxes, scores and labels with a batch axis, or a list of dicts without it, as
    torchvision returns them.
    """
    if isinstance(results, Mapping) and _has_boxes(results):
        if results["boxes"].dim() == 2:
            return [results]
        pictures = len(results["boxes"])
        values = {
            name: value for name, value in results.items()
            if isinstance(value, Tensor) and value.dim() > 1 and len(value) == pictures
        }  # fmt: skip
        return [{name: value[k] for name, value in values.items()} for k in range(pictures)]
    is_list = isinstance(results, (list, tuple)) and len(results) > 0
    return list(results) if is_list and all(map(_has_boxes, results)) else None


def _has_boxes(found: Any) -> bool:
    """True for a dict of boxes, scores and labels; TypeError if they are no tensors."""
    if not (isinstance(found, Mapping) and set(NAMES) <= set(found)):
        return False
    for name in NAMES:
        if not isinstance(found[name], Tensor):
            raise TypeError(f"{name} of detections must be a tensor, got {type(found[name])}")
    return True


def detections_to_images(
    found: Sequence[Mapping[str, Tensor]], view: View, prepared: Prepared
) -> list[dict[str, Tensor]]:
    """Carries the detections of the pictures that a view shows to the pixels of the images.

    Args:
        found: for each picture, boxes (K, 4), scores (K,) and labels (K,); and optionally masks
            (K, 1, H', W') and keypoints (K, P, 3), and other tensors (K, ...), which stay as they
            are. Values of another length are left out. The coordinates are torchvision's.

    Returns:
        For each image, the same dicts. The boxes are those of what the image shows of the ellipses
        inside them, and those of several tiles are merged, the best first. "visible" (K,) is the
        share of the area of each ellipse that the image shows, and boxes that it does not show are
        left out. "rays" (K, 3) are the
        directions of the middles in the camera's frame, unless the view ignores the lens. Masks
        are resampled to the image. Keypoints that the image does not show are NaN.

    Raises:
        ValueError: boxes, scores and labels do not fit together, the view is polar, or there are
            masks of tiles.
    """
    images = [found[k : k + view.count] for k in range(0, len(found), view.count)]
    if isinstance(prepared.points, PolarGrid):
        raise ValueError("boxes cannot come back from a polar image: choose another view")
    points = _tables(_landing(prepared), view.count)
    rays = _tables(None if prepared.rays is None else prepared.rays.movedim(1, -1), view.count)
    results = []
    for k, tiles in enumerate(images):
        own_points, own_rays = (of[min(k, len(of) - 1)] for of in (points, rays))
        carried = [
            _carried(part, prepared.size, own_points[tile], own_rays[tile])
            for tile, part in enumerate(tiles)
        ]
        joined = {name: torch.cat([part[name] for part in carried]) for name in carried[0]}
        if "masks" in joined:
            joined["masks"] = _masks_in_image(joined["masks"], view, prepared, k)
        if prepared.points is None:  # the picture is the image
            joined["boxes"] = of_boxes.clip(joined["boxes"], prepared.size)
        seen = joined["visible"] > 0
        joined = {name: value[seen] for name, value in joined.items()}
        if view.count > 1:
            kept = of_boxes.merge(*(joined[name] for name in NAMES))
            joined = {name: value[kept] for name, value in joined.items()}
        results.append(joined)
    return results


def _masks_in_image(masks: Tensor, view: View, prepared: Prepared, image: int) -> Tensor:
    """Masks (K, 1, H', W') of one picture in the pixels of its image, (K, 1, H, W)."""
    if view.count > 1:
        raise ValueError("masks of tiles cannot come back: choose a view of one picture")
    if isinstance(prepared.back, Tensor):
        number, around = min(image, len(prepared.back) - 1), prepared.around
        if around is not None and len(around) > 1:
            around = around[number : number + 1]
        prepared = prepared._replace(back=prepared.back[number : number + 1], around=around)
    height, width = prepared.size
    in_image = view.back(masks.reshape(1, -1, *masks.shape[-2:]), prepared)
    return in_image.view(*masks.shape[:-2], height, width)


def _landing(prepared: Prepared) -> Tensor | None:
    """The points at which a view reads the images, also beside them; NaN where no ray lands."""
    if prepared.points is None:
        return None
    assert isinstance(prepared.points, Tensor)
    return torch.where(prepared.points == OUTSIDE, torch.nan, prepared.points)


def _tables(values: Tensor | None, count: int) -> Any:
    """Values of the pixels of n tiles below each other, (N, n·H', W', K), as N × n arrays (H', W',
    K); None if the view is the image."""
    if values is None:
        return [[None] * count]
    return values.detach().double().cpu().unflatten(1, (count, -1)).numpy()


def _carried(
    found: Mapping[str, Tensor],
    size: tuple[int, int],
    points: np.ndarray | None,
    rays: np.ndarray | None,
) -> dict[str, Tensor]:
    """The detections of one picture whose pixels show points (k·H', k·W', 2) of the image (H, W)
    along rays (H', W', 3)."""
    boxes, scores = found["boxes"], found["scores"]
    count = len(boxes)
    if boxes.shape != (count, 4) or scores.shape != (count,) or found["labels"].shape != (count,):
        shapes = ", ".join(f"{name} {tuple(found[name].shape)}" for name in NAMES)
        raise ValueError(f"detections must be boxes (K, 4), scores (K,), labels (K,), got {shapes}")
    if not boxes.is_floating_point():
        boxes = boxes.float()
    kept = {
        name: value for name, value in found.items()
        if isinstance(value, Tensor) and value.dim() and len(value) == count
    }  # fmt: skip
    if points is None:  # the picture is the image
        whole = boxes.isfinite().all(1).to(boxes)
        return kept | dict(boxes=boxes, visible=whole)
    assert rays is not None
    height, width = rays.shape[:2]
    reads = points.shape[0] // height
    boxes = of_boxes.clip(boxes, (height, width))
    outside = (boxes[:, 2:] <= boxes[:, :2]).any(1, keepdim=True)
    boxes = torch.where(outside, torch.nan, boxes)

    def to_image(pixels: np.ndarray) -> np.ndarray:
        return read_table(points, (pixels + 0.5) * reads - 0.5)

    carried, visible = of_boxes.carry(boxes, to_image, size)
    moved = dict(boxes=carried, visible=visible)
    if "keypoints" in kept:
        places = of_boxes.carry_points(kept["keypoints"][..., :2], to_image)
        sides = places.new_tensor(size[::-1])
        outside = ((places < 0) | (places > sides)).any(-1, keepdim=True)
        places = torch.where(outside, torch.nan, places)
        moved["keypoints"] = torch.cat((places, kept["keypoints"][..., 2:]), -1)
    middle = boxes.detach().double().cpu().unflatten(1, (2, 2)).mean(1).numpy() - 0.5
    inside = np.clip(middle, 0, [width - 1, height - 1])
    ray = torch.from_numpy(read_table(rays, inside)).to(boxes)
    return kept | moved | dict(rays=F.normalize(ray, dim=1))
