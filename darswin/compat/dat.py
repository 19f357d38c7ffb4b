"""DAT as its authors released it in 2022."""

from collections.abc import Mapping

import torch
from torch import Tensor

from darswin.compat.checkpoint import Source, count_blocks, read_state, refused
from darswin.compat.timm_swin import bias_table, table_window
from darswin.models.dat import DAT

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


def load_dat(source: Source, **options) -> DAT:
    """The released DAT of CVPR 2022 from its state dict, in eval mode: the same outputs.

    The released code's later models, DAT++, have other layers and are refused.

    Args:
        source: a state dict or a file of one, as `darswin.compat.read_state`.
        options: constructor arguments that no shape tells: `offset_range` where it is not 2, and
            `image_size` where it is not 64 and no block is deformable.

    Raises:
        ValueError: keys or shapes that are not those of DAT.
    """
    state = read_state(source)
    with refused("DAT"):
        settings = _settings(state)
        model = DAT(**(settings | options))
        ours = model.state_dict()
        converted = {}
        for key, value in _joined(state).items():
            if key.endswith(("attn_mask", "relative_position_index")):
                continue  # the operator needs neither
            name = _renamed(key)
            if key.endswith("relative_position_bias_table"):
                value = bias_table(value, ours.get(name))
            elif name in ours and ours[name].dim() == 2 and value.shape[2:] == (1, 1):
                value = value.flatten(1)  # a 1 × 1 convolution is a linear layer
            converted[name] = value
        model.load_state_dict(converted)
    return model.eval()


def _joined(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """With keys' and values' projections as one."""
    joined = {}
    for key, value in state.items():
        if ".proj_k." in key:
            joined[key.replace("proj_k", "proj_kv")] = torch.cat(
                (value, state[key.replace("proj_k", "proj_v")])
            )
        elif ".proj_v." not in key:
            joined[key] = value
    return joined


def _renamed(key: str) -> str:
    for theirs, ours in _RENAMED.items():
        if key.startswith(f"{theirs}."):
            return ours + key.removeprefix(theirs)
    parts = key.split(".")
    if parts[0] == "down_projs":
        # Merging is a stage's end there and a stage's beginning here.
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


def _settings(state: Mapping[str, Tensor]) -> dict:
    """Constructor arguments, from keys and shapes."""
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
                found["window"] = table_window(table)
                kinds += "S" if f"{attn}.attn_mask" in state else "L"
        heads.append(stage_heads)
        groups.append(stage_groups)
        blocks.append(kinds)
    hidden = state["stages.0.mlps.0.chunk.linear1.weight"].shape[0]
    return found | dict(
        num_classes=state["cls_head.weight"].shape[0] if "cls_head.weight" in state else 0,
        in_chans=in_chans,
        embed_dim=embed_dim,
        depths=depths,
        num_heads=heads,
        blocks=blocks,
        groups=groups,
        patch_size=patch_size,
        mlp_ratio=hidden / embed_dim,
    )
