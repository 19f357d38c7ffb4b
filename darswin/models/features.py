"""What a model's stages are, and which of them are asked for, as timm's models have it."""

from collections.abc import Sequence
from typing import Any

from darswin.models.stages import Pair, StagePlan


class FeatureInfo(list[dict[str, Any]]):
    """A dict for each stage, and timm's accessors.

    Keys:
        num_chs: D of the stage's map.
        reduction: how many px a token spans along its longer side. They are px of the image; of the
            undistorted view in `SwinUndis`; in DarSwin samples of the polar grid, as a token there
            spans as many px of the image as its lens and its ring say.
        module: the stage's name in the model.
        map_size: (R, A) where the map is polar, else (H, W).
    """

    def get(self, key: str, idx: int | Sequence[int] | None = None) -> Any:
        """What a key holds: of one stage, of several, or, without `idx`, of all."""
        if isinstance(idx, int):
            return self[idx][key]
        return [self[k][key] for k in (range(len(self)) if idx is None else idx)]

    def channels(self, idx: int | Sequence[int] | None = None) -> Any:
        """D of the stages' maps."""
        return self.get("num_chs", idx)

    def reduction(self, idx: int | Sequence[int] | None = None) -> Any:
        """How many px a token spans; see `FeatureInfo` for whose px."""
        return self.get("reduction", idx)

    def module_name(self, idx: int | Sequence[int] | None = None) -> Any:
        """The stages' names."""
        return self.get("module", idx)


def feature_info(plans: Sequence[StagePlan], embed_dim: int, patch: Pair) -> FeatureInfo:
    """What the stages of these plans are.

    Args:
        embed_dim: D of the first; it doubles at each. patch: what a token of the first spans.
    """
    first = plans[0].map_size
    spans = [
        [p * whole // part for p, whole, part in zip(patch, first, plan.map_size, strict=True)]
        for plan in plans
    ]
    return FeatureInfo(
        dict(
            num_chs=embed_dim * 2**plan.index,
            reduction=max(span),
            module=f"stages.{plan.index}",
            map_size=plan.map_size,
        )
        for plan, span in zip(plans, spans, strict=True)
    )


def take_indices(count: int, indices: int | Sequence[int] | None) -> list[int]:
    """The numbers of the stages that `indices` names, of `count`: the last so many for an int, all
    for None; those of a sequence may count from the end.

    Raises:
        ValueError: a stage that there is not, or none at all.
    """
    if isinstance(indices, int):
        taken = list(range(count - indices, count)) if 0 < indices <= count else []
    elif indices is None:
        taken = list(range(count))
    else:
        taken = [i % count for i in indices if -count <= i < count]
        taken = taken if len(taken) == len(indices) else []
    if not taken:
        raise ValueError(f"indices must name some of {count} stages, got {indices}")
    return taken
