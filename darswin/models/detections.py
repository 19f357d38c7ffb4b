"""Detections of networks behind views, moved to the pixels of the images."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.boxes import Instances
from darswin.boxes.arrays import like, to_numpy
from darswin.boxes.turned import as_turned
from darswin.models.prepared import Prepared
from darswin.utils.parameters import naming
from darswin.utils.tasks import DETECTOR_TASKS
from darswin.views import PixelView, Remap, View
from darswin.views.remap import tensor_like

NAMES = ("boxes", "scores", "labels")
# What tells the form of results, in networks of Ultralytics and in configurations of transformers.
_TOLD = ("task", "names", "kpt_shape", "model_type", "id2label")
_OBJECTS = ("boxes", "bboxes", "xyxy", "pred_instances")  # of what other libraries find


def find_detections(results: Any) -> list[Mapping[str, Tensor]] | None:
    """The detections for each picture if a network's results are some, or None.

    They are a dict of boxes, scores and labels with a batch axis, or a list of dicts without it, as
    torchvision returns them. Of a dict with the number of things, such as `num_dets`, only so many
    rows.
    """
    if isinstance(results, Mapping) and _has_boxes(results):
        if results["boxes"].dim() == 2:
            return [results]
        from darswin.frames.recognise import counts_in  # needs the compiled part of frames

        pictures = len(results["boxes"])
        count = counts_in(results, pictures)
        stops = [None] * pictures if count is None else count.reshape(-1).tolist()
        values = {
            name: value for name, value in results.items()
            if isinstance(value, Tensor) and value.dim() > 1 and len(value) == pictures
        }  # fmt: skip
        return [{name: v[k][: stops[k]] for name, v in values.items()} for k in range(pictures)]
    is_list = isinstance(results, (list, tuple)) and len(results) > 0
    return list(results) if is_list and all(map(_has_boxes, results)) else None


def _outputs(results: Any) -> dict[str, Tensor]:
    """The tensors that results begin with, by their names or numbers."""
    if isinstance(results, (list, tuple)):
        results = dict(enumerate(results))
    if not isinstance(results, Mapping):
        return {"0": results} if isinstance(results, Tensor) else {}
    outputs = {str(name): of for name, of in results.items() if isinstance(of, Tensor)}
    return outputs or (_outputs(next(iter(results.values()))) if results else {})


def _has_boxes(result: Any) -> bool:
    """True for a dict of boxes, scores and labels; TypeError if they are no tensors."""
    if not (isinstance(result, Mapping) and set(NAMES) <= set(result)):
        return False
    for name in NAMES:
        if not isinstance(result[name], Tensor):
            raise TypeError(f"{name} of detections must be a tensor, got {type(result[name])}")
    return True


def decode_detections(
    results: Any, pictures: Tensor, network: nn.Module, word: str | None, threshold: float
) -> list[Mapping[str, Tensor]] | None:
    """The detections in raw results that have a form of `darswin predict --network`, without their
    gradients; None if they are none of a detector.

    Args:
        pictures: (B, C, H, W), which the network has seen. network: its attributes may tell what
            its results are. word: the form that the user says. threshold: the lowest score.

    Raises:
        ValueError: they look like those of a detector, but have several forms or no known one.
    """
    outputs, leaves = _outputs(results), pytree.tree_leaves(results)
    says = (network, getattr(network, "config", None))
    told = {name: getattr(by, name) for by in says for name in _TOLD if hasattr(by, name)}
    tables = [of for of in outputs.values() if of.dim() == 3 and of.is_floating_point()]
    objects = [leaf for leaf in leaves if not isinstance(leaf, Tensor)]
    is_detector = any(hasattr(leaf, name) for leaf in objects for name in _OBJECTS)
    is_detector |= told.get("task") in DETECTOR_TASKS
    if word == "numbers" or not (tables or is_detector or word):
        return None
    from darswin.frames.forms import decode, grids  # need the compiled part of frames
    from darswin.frames.recognise import Network, form_of, names_of

    size = (pictures.shape[2], pictures.shape[3])
    sides = {side for table in tables for side in table.shape[1:]}
    is_detector |= not sides.isdisjoint(grids(size))
    if torch.compiler.is_compiling():  # values are not known, and detections are refused later
        return [{}] * len(pictures) if is_detector else None
    count = len(pictures)
    quarter = (size[0] // 4, size[1] // 4)
    protos = [of for of in leaves if isinstance(of, Tensor) and of.shape[2:] == quarter]
    if len(protos) == 1 and all(of is not protos[0] for of in outputs.values()):
        outputs["protos"] = protos[0]
    arrays = {name: to_numpy(of.float() if of.is_floating_point() else of)
              for name, of in outputs.items()}  # fmt: skip
    batched = [name for name, of in arrays.items() if of.shape[:1] == (count,)]
    try:
        known = Network(arrays, size, told, max(names_of(told), default=-1) + 1, batched)
        if (form := form_of(known, word)) is not None:
            _, found = decode(form, arrays, count, size, threshold)
            found = [of.merged(inside=1.0) if form.overlaps else of for of in found]
            return [_tensors(of, pictures) for of in found]
        if is_detector:
            raise ValueError("they look like those of a detector, but are of no known form")
    except ValueError as error:
        shapes = ", ".join(str(tuple(of.shape)) for of in outputs.values()) or "no tensors"
        text = f"the network's results are {shapes}: {error}. `boxes` makes detections of them"
        text += ", and eval() of the network may help" * network.training
        text += "; with form='numbers' they are returned as they are"
        raise naming(ValueError(text), "boxes") from error
    return None


def in_picture(remap: Remap, tiles: Sequence[Instances]) -> Instances:
    """The detections in a view, or in each of its tiles, in the picture, the best first.

    Those of several tiles are merged, and what the picture does not show is left out. Boxes are cut
    at the borders of the view first.

    Args:
        remap: of the view.
        tiles: for each tile, its detections with scores and labels, in px of the tile.

    Returns:
        Instances without masks. `more` gets "visible", "cut", "view" of several tiles, "rays" if
        the view uses the lens, and "source" (K, 2): of each detection, its tile and its row there,
        by which masks can follow.
    """
    parts = []
    for number, (tile, detections) in enumerate(zip(remap.tiles, tiles, strict=True)):
        source = np.stack((np.full(len(detections), number), np.arange(len(detections))), 1)
        part = detections.with_columns(source=source).through(
            tile.to_image, tile.size, cut=tile.view_size,
            rays=tile.rays if tile.view.uses_lens else None,
        )  # fmt: skip
        parts.append(part[part.more["visible"] > 0])
    detections = Instances.joined(parts)
    if len(parts) > 1:
        merged = detections.merged()
        if "rays" not in merged.more:
            return merged
        there = np.nan_to_num(remap.rays_of_image(as_turned(merged.boxes)[:, :2] - 0.5))
        is_cut = merged.more["cut"][:, None]  # and perhaps joined: its middle is another one
        return merged.with_columns(rays=np.where(is_cut, there, merged.more["rays"]))
    # A network knows best which of its own boxes are one instance.
    return detections[np.argsort(-detections.scores, kind="stable")]


def detections_to_images(
    detections: Sequence[Mapping[str, Tensor]], view: View, prepared: Prepared
) -> list[dict[str, Tensor]]:
    """Moves the detections of the pictures that a view shows to the pixels of the images.

    Args:
        detections: for each picture, boxes (K, 4 or 5), scores (K,) and labels (K,); and optionally
            masks (K, 1, H', W'), of the view, of a whole fraction of it, or of each box alone,
            keypoints (K, P, 3), and other tensors (K, ...), which stay as they are. Values of
            another length are left out. The coordinates are those of `darswin.boxes`.

    Returns:
        For each image, the same dicts, as `in_picture` says, the best first; with "visible" (K,),
        the share of each box that the image shows, "cut" (K,), whether the border of the view cuts
        it, and "rays" (K, 3), the directions of the middles of the boxes of the view, in the
        camera's frame, unless the view ignores the lens. Masks are resampled to the image.
        Keypoints that the image does not show are NaN.

    Raises:
        ValueError: boxes, scores and labels do not fit together, or the view is polar.
    """
    if not isinstance(view, PixelView):
        raise ValueError("boxes cannot come back from a polar image: choose another view")
    if prepared.remaps is None:
        raise ValueError("detections cannot come back inside a graph: compile the network alone")
    results = []
    for k in range(len(detections) // view.count):
        remap = prepared.remaps[min(k, len(prepared.remaps) - 1)]
        tiles = [_rows(tile) for tile in detections[k * view.count : (k + 1) * view.count]]
        moved = in_picture(remap, [*map(_instances, tiles)])
        names = [name for name in tiles[0] if all(name in tile for tile in tiles)]
        starts = np.cumsum([0, *(len(tile["boxes"]) for tile in tiles)])
        tile_of, row_of = moved.more["source"].T
        rows = torch.from_numpy(starts[tile_of] + row_of)
        result = {name: torch.cat([tile[name] for tile in tiles]) for name in names}
        result = {name: column[rows.to(column.device)] for name, column in result.items()}
        in_view = result["boxes"]
        if (points := result.get("keypoints")) is not None:  # scores keep their gradients
            places = tensor_like(points, moved.keypoints[..., :2])
            result["keypoints"] = torch.cat((places, points[..., 2:].to(places)), -1)
        better = tensor_like(result["scores"], moved.scores)  # of the parts of the thing
        result["scores"] = torch.where(result["scores"] < better, better, result["scores"])
        for name, column in {"boxes": moved.boxes, **moved.more}.items():
            if name not in ("source", "view"):
                result[name] = tensor_like(result.get(name, result["boxes"]), column)
        result["cut"] = result["cut"] > 0
        if "masks" in result:
            masks = _whole_masks(result["masks"], in_view, remap.view_size)
            result["masks"] = _masks_in_image(masks, torch.from_numpy(tile_of), remap)
        results.append(result)
    return results


def _tensors(found: Instances, like: Tensor) -> dict[str, Tensor]:
    """The columns of detections on the device of a tensor."""
    masks = None if found.masks is None else found.masks[:, None]
    columns = dict(boxes=found.boxes, scores=found.scores, keypoints=found.keypoints, masks=masks)
    known = {name: tensor_like(like, of) for name, of in columns.items() if of is not None}
    return known | {"labels": torch.as_tensor(found.labels, dtype=torch.long, device=like.device)}


def _rows(detections: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of one picture that have a row for each box; ValueError if some lack rows."""
    boxes, scores, labels = (detections[name] for name in NAMES)
    count = len(boxes)
    are_boxes = boxes.shape in ((count, 4), (count, 5))
    if not are_boxes or scores.shape != (count,) or labels.shape != (count,):
        shapes = ", ".join(f"{name} {tuple(detections[name].shape)}" for name in NAMES)
        raise ValueError(
            f"detections must be boxes (K, 4 or 5), scores (K,), labels (K,), got {shapes}"
        )
    shape = tuple(detections["keypoints"].shape) if "keypoints" in detections else (count, 0, 2)
    if shape[0] == count and (len(shape) != 3 or shape[2] not in (2, 3)):
        raise ValueError(f"keypoints must have shape (K, P, 2 or 3), got {shape}")
    return {
        name: value for name, value in detections.items()
        if isinstance(value, Tensor) and value.dim() and len(value) == count
    }  # fmt: skip


def _instances(detections: Mapping[str, Tensor]) -> Instances:
    columns: dict[str, Any] = {
        name: detections[name].detach().to("cpu", torch.float64).numpy()
        for name in ("boxes", "scores", "labels", "keypoints") if name in detections
    }  # fmt: skip
    return Instances(**columns)


def _whole_masks(masks: Tensor, boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Masks (K, 1, H', W') of views, also if they are given for each box alone."""
    from darswin.frames.forms import whole_masks  # needs the compiled part of frames

    planes = to_numpy(masks.flatten(0, -3).float())
    whole = whole_masks(planes, to_numpy(boxes.double()), size)
    return masks if whole is planes else like(masks, whole).view(*masks.shape[:-2], *size)


def _masks_in_image(masks: Tensor, tiles: Tensor, remap: Remap) -> Tensor:
    """Masks (K, 1, H', W') of `tiles` (K,) in the pixels of the image, (K, 1, H, W)."""
    in_image = masks.new_zeros(*masks.shape[:-2], *remap.size)
    for number in tiles.unique().tolist():
        of_tile = (tiles == number).to(masks.device)
        maps = masks[of_tile].reshape(1, -1, *masks.shape[-2:]).cpu()
        in_image[of_tile] = remap.tiles[number].back(maps).view_as(in_image[of_tile]).to(masks)
    return in_image
