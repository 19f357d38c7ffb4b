"""Detections of networks behind views, carried back to the pixels of the images."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from darswin import boxes as of_boxes
from darswin.models.prepared import Prepared
from darswin.views import PixelView, Remap, View

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
        found: for each picture, boxes (K, 4 or 5), scores (K,) and labels (K,); and optionally
            masks (K, 1, H', W') and keypoints (K, P, 3), and other tensors (K, ...), which stay as
            they are. Values of another length are left out. The coordinates are those of
            `darswin.boxes`.

    Returns:
        For each image, the same dicts. The boxes are those of what the image shows of the ellipses
        inside them, and those of several tiles are merged, the best first. "visible" (K,) is the
        share of the area of each ellipse that the image shows, and boxes that it does not show are
        left out. "rays" (K, 3) are the directions of the middles of the boxes of the view, in the
        camera's frame, unless the view ignores the lens. Masks are resampled to the
        image, those of tiles too. Keypoints that the image does not show are NaN.

    Raises:
        ValueError: boxes, scores and labels do not fit together, or the view is polar.
    """
    if not isinstance(view, PixelView):
        raise ValueError("boxes cannot come back from a polar image: choose another view")
    if prepared.remaps is None:
        raise ValueError("detections cannot come back inside a graph: compile the network alone")
    results = []
    for k in range(len(found) // view.count):
        remap = prepared.remaps[min(k, len(prepared.remaps) - 1)]
        tiles = found[k * view.count : (k + 1) * view.count]
        carried = [_carried(part, tile) for part, tile in zip(tiles, remap.tiles, strict=True)]
        of_all = [name for name in carried[0] if all(name in part for part in carried)]
        joined = {name: torch.cat([part[name] for part in carried]) for name in of_all}
        counts = [len(part["boxes"]) for part in carried]
        sources = torch.arange(view.count).repeat_interleave(torch.tensor(counts))
        joined["sources"] = sources.to(joined["boxes"].device)
        seen = joined["visible"] > 0
        joined = {name: value[seen] for name, value in joined.items()}
        if view.count > 1:
            kept = of_boxes.merge(*(joined[name] for name in NAMES))
            joined = {name: value[kept] for name, value in joined.items()}
        sources = joined.pop("sources")
        if "masks" in joined:
            joined["masks"] = _masks_in_image(joined["masks"], sources, remap)
        results.append(joined)
    return results


def _masks_in_image(masks: Tensor, sources: Tensor, remap: Remap) -> Tensor:
    """Masks (K, 1, H', W') of the tiles `sources` (K,) in the pixels of the image, (K, 1, H, W)."""
    in_image = masks.new_zeros(*masks.shape[:-2], *remap.size)
    for number in sources.unique().tolist():
        mine = sources == number
        maps = masks[mine].reshape(1, -1, *masks.shape[-2:]).cpu()
        in_image[mine] = remap.tiles[number].back(maps).view_as(in_image[mine]).to(masks)
    return in_image


def _carried(found: Mapping[str, Tensor], remap: Remap) -> dict[str, Tensor]:
    """The detections of one picture in the pixels of the image."""
    boxes, scores = found["boxes"], found["scores"]
    count = len(boxes)
    are_boxes = boxes.shape in ((count, 4), (count, 5))
    if not are_boxes or scores.shape != (count,) or found["labels"].shape != (count,):
        shapes = ", ".join(f"{name} {tuple(found[name].shape)}" for name in NAMES)
        raise ValueError(
            f"detections must be boxes (K, 4 or 5), scores (K,), labels (K,), got {shapes}"
        )
    kept = {
        name: value for name, value in found.items()
        if isinstance(value, Tensor) and value.dim() and len(value) == count
    }  # fmt: skip
    moved = remap.boxes_to_image(boxes)
    kept |= dict(boxes=moved.boxes, visible=moved.visible)
    if remap.view.uses_lens:
        kept["rays"] = moved.rays
    if "keypoints" in kept:
        places = of_boxes.carry_points(kept["keypoints"][..., :2], remap.to_image)
        kept["keypoints"] = torch.cat((places, kept["keypoints"][..., 2:]), -1)
    return kept
