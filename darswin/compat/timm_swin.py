"""Swin as timm has it."""

import math
from collections.abc import Mapping

from torch import Tensor

from darswin.compat.checkpoint import Source, count_blocks, read_state, refused
from darswin.models.swin import Swin


def load_timm_swin(source: Source, **options) -> Swin:
    """timm's `SwinTransformer` from its state dict, in eval mode: the same outputs.

    Args:
        source: a state dict or a file of one, as `darswin.compat.read_state`.
        options: constructor arguments that no shape tells: `image_size` where it is not 64.

    Raises:
        ValueError: keys or shapes that are not those of timm's Swin.
    """
    state = read_state(source)
    with refused("timm's Swin"):
        settings = _settings(state)
    model = Swin(**(settings | options))
    ours = model.state_dict()
    converted = {}
    for key, value in state.items():
        if key.endswith(("attn_mask", "relative_position_index")):
            continue  # the operator needs neither
        key = key.replace("layers.", "stages.").replace("head.fc.", "head.")
        if key.endswith(".relative_position_bias_table"):
            key = key.replace("relative_position_bias_table", "position_bias.table")
            value = bias_table(value, ours.get(key))
        converted[key] = value
    with refused("timm's Swin"):
        model.load_state_dict(converted)
    return model.eval()


def bias_table(rows: Tensor, ours: Tensor | None) -> Tensor:
    """Swin's table ((2·M_r-1)·(2·M_φ-1), heads), as `RelativeTable` has it, if they fit."""
    if ours is None or ours[0].numel() != rows.shape[0]:
        return rows
    return rows.T.reshape(-1, *ours.shape[1:])


def table_window(rows: Tensor) -> tuple[int, int]:
    """The square window of Swin's table."""
    side = (math.isqrt(rows.shape[0]) + 1) // 2
    return side, side


def _settings(state: Mapping[str, Tensor]) -> dict:
    """Constructor arguments, from keys and shapes."""
    depths = count_blocks(state, "layers.{}.blocks.{}.norm1.weight")
    tables = [
        state[f"layers.{stage}.blocks.0.attn.relative_position_bias_table"]
        for stage in range(len(depths))
    ]
    embed_dim, in_chans, patch_size, _ = state["patch_embed.proj.weight"].shape
    hidden = state["layers.0.blocks.0.mlp.fc1.weight"].shape[0]
    return dict(
        num_classes=state["head.fc.weight"].shape[0] if "head.fc.weight" in state else 0,
        in_chans=in_chans,
        embed_dim=embed_dim,
        depths=depths,
        num_heads=[table.shape[1] for table in tables],
        patch_size=patch_size,
        window=table_window(tables[0]),
        mlp_ratio=hidden / embed_dim,
    )
