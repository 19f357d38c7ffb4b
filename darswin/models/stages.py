"""The sizes of the stages, and their blocks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from torch import nn

from darswin.layers.transformer import Block, Stage
from darswin.ops.checks import check_pair

Pair = tuple[int, int]


@dataclass(frozen=True)
class StagePlan:
    """Sizes of a stage: its number, from 0, its map (R, A), its windows, the shift of its odd
    blocks, and the merging that leads to it."""

    index: int
    map_size: Pair
    window: Pair
    shift: Pair
    merge: Pair | None

    def shift_of(self, block: int) -> Pair:
        """The shift of the windows of a block: every second block has one."""
        return self.shift if block % 2 else (0, 0)


def plan_stages(
    rings: int,
    sectors: int,
    count: int,
    variant: Literal["A", "RA"],
    window: Pair,
    merges: Sequence[Pair] | None = None,
) -> list[StagePlan]:
    """The stages' sizes; ValueError where a window or a merging does not divide its map.

    `merges` are those before each stage but the first; None means those of the variant.

    A window keeps its number of tokens when an axis runs out. DarSwin-A merges 4 along azimuth,
    once the ring is used up along the radius; it shifts by a quarter window along azimuth, or,
    where one window spans the ring, by half along the radius. DarSwin-RA merges 2×2 and shifts by
    half the window along both axes. There is no shift along an axis that one window spans. Swin's
    sizes, with rows and columns for rings and sectors, are those of DarSwin-RA.
    """
    if merges is not None and len(merges) != count - 1:
        raise ValueError(
            f"merges must have one entry for each stage but the first, {count - 1}, got {merges}"
        )
    plans: list[StagePlan] = []
    size, merge = (rings, sectors), None
    for stage in range(count):
        if stage > 0:
            choices = merges[stage - 1 : stage] if merges else _merges_of(variant, size)
            merge = _merging(size, choices, stage)
            size = (size[0] // merge[0], size[1] // merge[1])
        fitted = _fit_window(window, size)
        if size[0] % fitted[0] or size[1] % fitted[1]:
            raise ValueError(
                f"stage {stage + 1}: window {fitted} must divide the map, {size}; "
                "choose other sizes"
            )
        plans.append(StagePlan(stage, size, fitted, _shift(size, fitted, variant), merge))
    return plans


def _merges_of(variant: str, size: Pair) -> Sequence[Pair]:
    return [(2, 2)] if variant == "RA" else [(1, 4), (4, 1)] if size[1] < 4 else [(1, 4)]


def _merging(size: Pair, choices: Sequence[Pair], stage: int) -> Pair:
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


def make_stages(
    plans: Sequence[StagePlan],
    embed_dim: int,
    depths: Sequence[int],
    num_heads: Sequence[int],
    *,
    attention: Callable[[int, int, StagePlan, int], nn.Module],
    downsample: Callable[[int, Pair], nn.Module],
    mlp_ratio: float,
    drop_path_rate: float,
) -> nn.ModuleList:
    """The stages; their width doubles, and stochastic depth rises from block to block.

    Args:
        attention: the width, heads, plan and number of a block → its attention.
        downsample: the width before and (m_r, m_φ) → what begins every stage but the first.
        drop_path_rate: of the last block; it rises linearly from 0.
    """
    stages = nn.ModuleList()
    before, last = 0, max(sum(depths) - 1, 1)
    for plan, depth, heads in zip(plans, depths, num_heads, strict=True):
        dim = embed_dim * 2**plan.index
        merging = downsample(dim // 2, plan.merge) if plan.merge else nn.Identity()
        blocks = [
            Block(
                dim,
                attention(dim, heads, plan, block),
                mlp_ratio=mlp_ratio,
                drop_path=drop_path_rate * (before + block) / last,
            )
            for block in range(depth)
        ]
        stages.append(Stage(merging, blocks))
        before += depth
    return stages
