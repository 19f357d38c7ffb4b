"""The sizes of the stages: maps, windows, shifts and merging."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from darswin.ops.checks import check_pair
from darswin.views.base import Pair


@dataclass(frozen=True)
class StageSizes:
    """The sizes of a stage. Its odd blocks have the shift; the merging is its first layer."""

    index: int
    map_size: Pair
    window: Pair
    shift: Pair
    merge: Pair | None

    def windows(self, block: int) -> dict[str, Any]:
        """The options of the attention of a block; every second block has shifted windows."""
        shift = self.shift if block % 2 else (0, 0)
        return dict(map_size=self.map_size, window=self.window, shift=shift)


def stage_sizes(
    rings: int,
    sectors: int,
    count: int,
    variant: Literal["A", "RA"],
    window: Pair,
    merges: Sequence[Pair] | None = None,
) -> list[StageSizes]:
    """The sizes of all stages; ValueError if a window or a merging does not divide its map.

    If the map is shorter than the window along one axis, the window becomes longer along the other
    axis and keeps its number of tokens. DarSwin-A merges 4 tokens along azimuth, or along the
    radius if the ring has less than 4. It shifts by a quarter of the window along azimuth, or by
    half the window along the radius if the window spans the ring. DarSwin-RA and Swin merge 2×2
    tokens and shift by half the window, except along an axis that the window spans.
    """
    window = check_pair("window", window, lowest=1)
    if merges is not None and len(merges) != count - 1:
        raise ValueError(
            f"merges must have one entry for each stage but the first, {count - 1}, got {merges}"
        )
    stages: list[StageSizes] = []
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
        stages.append(StageSizes(stage, size, fitted, _shift(size, fitted, variant), merge))
    return stages


def _merging(size: Pair, choices: Sequence[Pair], stage: int) -> Pair:
    """The first one of the choices that divides the map."""
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
