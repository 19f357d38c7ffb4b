"""The sizes of the maps of an encoder, by stage, with timm's accessors."""

from collections.abc import Sequence
from typing import Any

from darswin.models.stages import StageSizes
from darswin.views.base import Pair


class FeatureInfo(list[dict[str, Any]]):
    """A list with one dict per stage, and timm's accessors.

    Keys:
        num_chs: D, the width of the stage's map.
        reduction: the number of pixels that a token spans along its longer side. They are pixels of
            the image, or of the view if the model makes one. DarSwin counts samples of the polar
            grid instead, because the number of pixels depends on the lens and the ring.
        module: the stage's name in the model.
        map_size: (R, A) of a polar map, (H, W) of any other map.
    """

    def get(self, key: str, idx: int | Sequence[int] | None = None) -> Any:
        """The values of a key for one stage (an int), several stages, or all of them (None)."""
        if isinstance(idx, int):
            return self[idx][key]
        return [self[k][key] for k in (range(len(self)) if idx is None else idx)]

    def channels(self, idx: int | Sequence[int] | None = None) -> Any:
        """The widths D of the stages' maps."""
        return self.get("num_chs", idx)

    def reduction(self, idx: int | Sequence[int] | None = None) -> Any:
        """The number of pixels that a token of each stage spans; see `FeatureInfo`."""
        return self.get("reduction", idx)

    def module_name(self, idx: int | Sequence[int] | None = None) -> Any:
        """The stages' names in the model."""
        return self.get("module", idx)


def feature_info(stages: Sequence[StageSizes], embed_dim: int, patch: Pair) -> FeatureInfo:
    """The sizes of stages. A token of the first one spans `patch`; the width doubles per stage."""
    infos = FeatureInfo()
    for sizes in stages:
        merged = zip(patch, stages[0].map_size, sizes.map_size, strict=True)
        infos.append(
            dict(
                num_chs=embed_dim * 2**sizes.index,
                reduction=max(span * before // after for span, before, after in merged),
                module=f"stages.{sizes.index}",
                map_size=sizes.map_size,
            )
        )
    return infos


def take_indices(count: int, indices: int | Sequence[int] | None) -> list[int]:
    """Numbers of the chosen ones of `count` stages: the last ones for an int, all for None."""
    if isinstance(indices, int):
        chosen: Sequence[int] = range(count)[-indices:] if 0 < indices <= count else ()
    else:
        chosen = range(count) if indices is None else indices
    if not chosen or not all(-count <= i < count for i in chosen):
        raise ValueError(f"indices must name some of {count} stages, got {indices}")
    return [i % count for i in chosen]
