"""The weights of the baselines: timm's Swin, and the DAT that its authors released in 2022."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from darswin.compat.checkpoint import Source, count_blocks, load_as, read_state
from darswin.models.dat import DAT
from darswin.models.swin import Swin


def load_timm_swin(source: Source, **options) -> Swin:
    """timm's `SwinTransformer` from its state dict, in eval mode and with the same outputs.

    Args:
        source: a state dict, or the path of its file: safetensors, or what `torch.save` wrote, of
            which no code is executed.
        options: constructor arguments that cannot be read from the state dict: `image_size`, if it
            is not 64. That of most weights of timm is 224.

    Raises:
        ValueError: the keys or shapes are not those of timm's Swin, or image_size does not fit.
    """

    def convert(key: str, value: Tensor, model: Swin) -> tuple[str, Tensor]:
        key = key.replace("layers.", "stages.").replace("head.fc.", "head.")
        if key.endswith(".relative_position_bias_table"):
            key = key.replace("relative_position_bias_table", "position_bias.table")
            value = _table(value, key, model)
        return key, value

    def make(state: Mapping[str, Tensor]) -> Swin:
        try:
            return Swin(**(_swin(state) | options))
        except ValueError as error:
            if "image_size" in options:
                raise
            text = "give image_size, which is 64 here, as image_size=224: weights do not say it"
            raise ValueError(f"{error}; {text}") from error

    return load_as("timm's Swin", source, make, convert)


def load_dat(source: Source, **options) -> DAT:
    """The released DAT of CVPR 2022 from its state dict, in eval mode and with the same outputs.

    The later models of the released code, DAT++, have other layers and are refused.

    Args:
        source: a state dict, or the path of its file: safetensors, or what `torch.save` wrote, of
            which no code is executed.
        options: constructor arguments that cannot be read from the state dict: `offset_range`, if
            it is not 2; and `image_size`, if it is not 64 and no block is deformable.

    Raises:
        ValueError: the keys or shapes are not those of DAT.
    """
    state = _joined(read_state(source))
    return load_as("DAT", state, lambda state: DAT(**(_dat(state) | options)), _convert_dat)


def _table(rows: Tensor, name: str, model: Swin) -> Tensor:
    """A Swin table ((2·M_r-1)·(2·M_φ-1), heads) in the shape of `RelativeTable`, if it fits."""
    ours = model.state_dict().get(name)
    if ours is None or ours[0].numel() != rows.shape[0]:
        return rows
    return rows.T.reshape(-1, *ours.shape[1:])


def _window(rows: Tensor) -> tuple[int, int]:
    """The square window that a Swin table belongs to."""
    side = (math.isqrt(rows.shape[0]) + 1) // 2
    return side, side


def _swin(state: Mapping[str, Tensor]) -> dict:
    """The constructor arguments, read from the keys and shapes."""
    depths = count_blocks(state, "layers.{}.blocks.{}.norm1.weight")
    tables = [
        state[f"layers.{stage}.blocks.0.attn.relative_position_bias_table"]
        for stage in range(len(depths))
    ]
    embed_dim, in_chans, patch_size, _ = state["patch_embed.proj.weight"].shape
    return dict(
        num_classes=state["head.fc.weight"].shape[0] if "head.fc.weight" in state else 0,
        in_chans=in_chans,
        embed_dim=embed_dim,
        depths=depths,
        num_heads=[table.shape[1] for table in tables],
        patch_size=patch_size,
        window=_window(tables[0]),
        mlp_ratio=state["layers.0.blocks.0.mlp.fc1.weight"].shape[0] / embed_dim,
    )


# New names for the first parts of keys, and for parts of the keys of a block.
_RENAMED = {
    "patch_proj.0": "patch_embed.proj",
    "patch_proj.1.norm": "patch_embed.norm",
    "cls_norm.norm": "norm",
    "cls_head": "head",
}
_RENAMED_IN_BLOCKS = {
    "attns": "attn",
    "mlps": "mlp",
    "chunk.linear1": "fc1",
    "chunk.linear2": "fc2",
    "relative_position_bias_table": "position_bias.table",
    "rpe_table": "position_bias.table",
    "proj_qkv": "qkv",
    "proj_q": "q",
    "proj_kv": "kv",
    "proj_out": "proj",
    "conv_offset.0": "around",
    "conv_offset.1.norm": "norm",
    "conv_offset.3": "offset",
}


def _convert_dat(key: str, value: Tensor, model: DAT) -> tuple[str, Tensor]:
    name = _renamed(key)
    if key.endswith("relative_position_bias_table"):
        return name, _table(value, name, model)
    if value.shape[2:] == (1, 1) and not key.startswith("patch_proj"):
        return name, value.flatten(1)  # a 1 × 1 convolution is a linear layer
    return name, value


def _joined(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state dict with the projections to keys and to values joined into one."""
    joined = {}
    for key, value in state.items():
        other = state.get(key.replace(".proj_k.", ".proj_v."))
        if ".proj_k." in key and other is not None:
            joined[key.replace("proj_k", "proj_kv")] = torch.cat((value, other))
        elif ".proj_v." not in key:
            joined[key] = value
    return joined


def _renamed(key: str) -> str:
    for theirs, ours in _RENAMED.items():
        if key.startswith(f"{theirs}."):
            return ours + key.removeprefix(theirs)
    parts = key.split(".")
    if parts[0] == "down_projs":
        # Merging is the last layer of a stage there and the first layer here.
        layer = "proj" if parts[2] == "0" else "norm"
        return f"stages.{int(parts[1]) + 1}.downsample.{layer}.{parts[-1]}"
    if parts[0] != "stages" or len(parts) < 5:
        return key
    _, stage, part, index = parts[:4]
    rest = ".".join(parts[4:])
    if part == "layer_norms":
        block, second = divmod(int(index), 2)
        return f"stages.{stage}.blocks.{block}.norm{second + 1}.{rest.removeprefix('norm.')}"
    for theirs, ours in _RENAMED_IN_BLOCKS.items():
        if rest == theirs or rest.startswith(f"{theirs}."):
            rest = ours + rest.removeprefix(theirs)
            break
    return f"stages.{stage}.blocks.{index}.{_RENAMED_IN_BLOCKS.get(part, part)}.{rest}"


def _dat(state: Mapping[str, Tensor]) -> dict:
    """The constructor arguments, read from the keys and shapes."""
    depths = count_blocks(state, "stages.{}.mlps.{}.chunk.linear1.weight")
    embed_dim, in_chans, patch_size, _ = state["patch_proj.0.weight"].shape
    heads, groups, blocks, found = [], [], [], {}
    for stage, depth in enumerate(depths):
        kinds = ""
        for block in range(depth):
            attn = f"stages.{stage}.attns.{block}"
            if f"{attn}.rpe_table" in state:
                table = state[f"{attn}.rpe_table"]
                channels = state[f"{attn}.conv_offset.0.weight"].shape[0]
                stage_heads, stage_groups = table.shape[0], embed_dim * 2**stage // channels
                found["image_size"] = tuple(
                    (side + 1) // 2 * patch_size * 2**stage for side in table.shape[1:]
                )
                kinds += "D"
            else:
                table = state[f"{attn}.relative_position_bias_table"]
                stage_heads, stage_groups = table.shape[1], 1
                found["window"] = _window(table)
                kinds += "S" if f"{attn}.attn_mask" in state else "L"
        heads.append(stage_heads)
        groups.append(stage_groups)
        blocks.append(kinds)
    return found | dict(
        num_classes=state["cls_head.weight"].shape[0] if "cls_head.weight" in state else 0,
        in_chans=in_chans,
        embed_dim=embed_dim,
        depths=depths,
        num_heads=heads,
        blocks=blocks,
        groups=groups,
        patch_size=patch_size,
        mlp_ratio=state["stages.0.mlps.0.chunk.linear1.weight"].shape[0] / embed_dim,
    )
