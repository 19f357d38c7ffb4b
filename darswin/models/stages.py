"""The sizes of the stages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from darswin.ops.checks import check_pair

Pair = tuple[int, int]


@dataclass(frozen=True)
class StagePlan:
    """The sizes of a stage; the shift is that of its odd blocks, the merging leads to it."""

    index: int
    map_size: Pair
    window: Pair
    shift: Pair
    merge: Pair | None

    def windows(self, block: int) -> dict[str, Any]:
        """The options of a block's attention: every second block has shifted windows."""
        shift = self.shift if block % 2 else (0, 0)
        return dict(map_size=self.map_size, window=self.window, shift=shift)


def plan_stages(
    rings: int,
    sectors: int,
    count: int,
    variant: Literal["A", "RA"],
    window: Pair,
    merges: Sequence[Pair] | None = None,
) -> list[StagePlan]:
    """The stages' sizes; ValueError where a window or a merging does not divide its map.

    A window keeps its number of tokens when an axis runs out. DarSwin-A merges 4 along azimuth,
    once the ring is used up along the radius; it shifts by a quarter window along azimuth, or,
    where one window spans the ring, by half along the radius. DarSwin-RA, and so Swin, merges 2×2
    and shifts by half the window along both axes, but not along an axis that one window spans.
    """
    if merges is not None and len(merges) != count - 1:
        raise ValueError(
            f"merges must have one entry for each stage but the first, {count - 1}, got {merges}"
        )
    plans: list[StagePlan] = []
    size, merge = (rings, sectors), None
    for stage in range(count):
        if stage > 0:
            usual = [(2, 2)] if variant == "RA" else [(1, 4), (4, 1)] if size[1] < 4 else [(1, 4)]
            merge = _merging(size, merges[stage - 1 : stage] if merges else usual, stage)
            size = (size[0] // merge[0], size[1] // merge[1])
        fitted = _fit_window(window, size)
        if size[0] % fitted[0] or size[1] % fitted[1]:
            raise ValueError(
                f"stage {stage + 1}: window {fitted} must divide the map, {size}; "
                "choose other sizes"
            )
        plans.append(StagePlan(stage, size, fitted, _shift(size, fitted, variant), merge))
    return plans


def _merging(size: Pair, choices: Sequence[Pair], stage: int) -> Pair:
    """The first merging of the choices that divides the map."""
    for merge in choices:
        merge = check_pair("merges", merge, lowest=1)
        if size[0] % merge[0] == 0 and size[1] % merge[1] == 0:
            return merge
    raise ValueError(
        f"stage {stage + 1}: a map of {size} cannot be merged by {choices[-1]}; "
        "choose other sizes, or fewer stages"
    )


def _fit_window(window: Pair, size: Pair) -> Pair:
    tokens = window[0] * window[1]
    if window[1] > size[1]:
        return (min(size[0], tokens // size[1]), size[1])
    if window[0] > size[0]:
        return (size[0], min(size[1], tokens // size[0]))
    return window


def _shift(size: Pair, window: Pair, variant: str) -> Pair:
    along_r = window[0] // 2 if size[0] > window[0] else 0
    along_phi = window[1] // 2 if size[1] > window[1] else 0
    if variant == "RA":
        return along_r, along_phi
    return (0, window[1] // 4) if size[1] > window[1] else (along_r, 0)
