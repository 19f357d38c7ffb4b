"""DAT, the Deformable Attention Transformer of CVPR 2022: a baseline of the paper."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.attention import WindowAttention, check_heads
from darswin.layers.embed import PatchProjection
from darswin.layers.linear import Linear
from darswin.layers.position_bias import RelativeTable
from darswin.models.registry import register_model
from darswin.models.stages import StageSizes
from darswin.models.swin import Swin
from darswin.ops.checks import tensor_there
from darswin.views import View
from darswin.views.base import Pair, PerChannel


class DeformableAttention(nn.Module):
    """Multi-head attention with keys at learned positions (DAT, CVPR 2022, sec. 3.2).

    Each key starts at a pixel of the map. A small network moves it, by at most `offset_range` half
    pixels, from the queries around that pixel. The heads of a group share their keys. The position
    bias of a query and a key is interpolated in a table.
    """

    def __init__(
        self,
        dim: int,
        num_heads: int,
        *,
        map_size: Pair,
        groups: int,
        kernel: int,
        offset_range: float = 2.0,
    ):
        super().__init__()
        check_heads(dim, num_heads)
        if groups < 1 or num_heads % groups:
            raise ValueError(f"groups must divide num_heads = {num_heads}, got {groups}")
        self.num_heads, self.groups, self.offset_range = num_heads, groups, offset_range
        channels = dim // groups
        self.q = Linear(dim, dim)
        self.kv = Linear(dim, 2 * dim)
        self.proj = Linear(dim, dim)
        self.around = nn.Conv2d(channels, channels, kernel, padding=kernel // 2, groups=channels)
        self.norm = nn.LayerNorm(channels)
        self.offset = Linear(channels, 2, bias=False)
        self.position_bias = RelativeTable(map_size, num_heads)

    def _grouped(self, x: Tensor) -> Tensor:
        """(B, H, W, D) → (B·G, D/G, H, W)."""
        return x.unflatten(3, (self.groups, -1)).permute(0, 3, 4, 1, 2).flatten(0, 1)

    def forward(self, x: Tensor, table: Tensor) -> Tensor:
        """(B, H, W, D) and the result of `position_bias` → the same shape as x."""
        batch, height, width, dim = x.shape
        tokens = height * width
        q = self.q(x)
        around = self.around(self._grouped(q)).permute(0, 2, 3, 1)
        offset = torch.tanh(self.offset(F.gelu(self.norm(around))))  # (B·G, H, W, 2): y, x
        # Positions in the map, in units of its half sides: -1 … 1 from edge to edge.
        pixels = _pixel_centers(height, width, offset)
        points = pixels + offset * (self.offset_range / tensor_there((height, width), offset))
        # The released code samples as if the centres of the outermost pixels were at the edges.
        sampled = F.grid_sample(self._grouped(x), points.flip(-1), align_corners=True)
        sampled = sampled.unflatten(0, (batch, self.groups)).permute(0, 3, 4, 1, 2)
        sampled = sampled.reshape(batch, tokens, dim)
        k, v = self.kv(sampled).chunk(2, 2)

        reach = (pixels.flatten(0, 1)[:, None] - points.flatten(1, 2)[:, None]) / 2
        table = table.unflatten(1, (self.groups, -1))
        table = table.expand(batch, -1, -1, -1, -1).flatten(0, 1)
        bias = F.grid_sample(table, reach.flip(-1), align_corners=True)  # (B·G, heads/G, N, N)
        bias = bias.reshape(batch, self.num_heads, tokens, tokens)
        q, k, v = (
            t.flatten(1, -2).unflatten(2, (self.num_heads, -1)).transpose(1, 2) for t in (q, k, v)
        )
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=bias)
        return self.proj(out.transpose(1, 2).reshape(x.shape))

    def extra_repr(self) -> str:
        return f"groups={self.groups}, offset_range={self.offset_range}"


def _pixel_centers(height: int, width: int, like: Tensor) -> Tensor:
    """y and x of the centre of each pixel, (H, W, 2); the edges of the map are at -1 and 1."""
    y, x = (
        (2 * torch.arange(side, dtype=like.dtype, device=like.device) + 1) / side - 1
        for side in (height, width)
    )
    return torch.stack(torch.meshgrid(y, x, indexing="ij"), -1)


@register_model(
    "dat",
    image_size=64,
    presets=dict(
        micro=dict(groups=(1, 1, 1, 2)),
        nano=dict(image_size=32, blocks=("L", "LD", "D"), groups=(1, 1, 2)),
    ),
)
class DAT(Swin):
    """The Deformable Attention Transformer: Swin with deformable attention in some blocks.

    The arguments that are not listed here are those of `Swin`.

    Args:
        blocks: a string for each stage with the kinds of its blocks, which repeats: "L" has window
            attention, "S" has shifted windows, "D" has deformable attention.
        groups: for each stage, the number of groups of heads in deformable attention. The heads of
            a group share their keys.
        offset_range: the largest offset of a key, in half pixels of the map.

    Raises:
        ValueError: an unknown option, or sizes that do not divide; in forward, images of another
            size.

    Source: DAT, CVPR 2022, the version that the paper compares with; not the later DAT++.
    """

    def __init__(
        self,
        num_classes: int = 1000,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        image_size: int | Pair = 64,
        patch_size: int = 2,
        window: Pair = (4, 4),
        blocks: Sequence[str] = ("LS", "LS", "LD", "LD"),
        groups: Sequence[int] = (1, 1, 3, 6),
        offset_range: float = 2.0,
        view: str | View = "none",
        mean: PerChannel | None = None,
        std: PerChannel | None = None,
    ):
        if not len(blocks) == len(groups) == len(depths):
            raise ValueError(
                f"blocks and groups must have one entry for each stage, {len(depths)}, "
                f"got {blocks} and {groups}"
            )
        if not all(blocks) or not set("".join(blocks)) <= set("LSD"):
            raise ValueError(f"blocks must be of the kinds 'L', 'S' and 'D', got {blocks}")
        self.blocks, self.groups, self.offset_range = blocks, groups, offset_range
        super().__init__(
            num_classes, in_chans, embed_dim, depths, num_heads, mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate, image_size=image_size, patch_size=patch_size,
            window=window, view=view, mean=mean, std=std,
        )  # fmt: skip

    def downsample(self, dim: int, merge: Pair) -> nn.Module:
        return PatchProjection(dim, 2 * dim, 2, bias=False)

    def attention(self, dim: int, heads: int, sizes: StageSizes, block: int) -> nn.Module:
        kinds = self.blocks[sizes.index]
        kind = kinds[block % len(kinds)]
        if kind == "D":
            return DeformableAttention(
                dim,
                heads,
                map_size=sizes.map_size,
                groups=self.groups[sizes.index],
                kernel=2 * (len(self.blocks) - sizes.index) + 1,  # 9, 7, 5, 3
                offset_range=self.offset_range,
            )
        rows, columns = sizes.window
        shift = ((rows + 1) // 2, (columns + 1) // 2) if kind == "S" else (0, 0)
        return WindowAttention(
            dim, heads, map_size=sizes.map_size, window=sizes.window, shift=shift
        )
