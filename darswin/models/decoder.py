"""The decoder of the dense models: from the encoder's last map back to its first, and finer."""

from collections.abc import Callable, Sequence

from torch import Tensor, nn

from darswin.layers.expand import PatchExpand, SkipJoin
from darswin.models.stages import StagePlan, make_stages

EXPANSION = 4  # how many tokens along each axis the last expansion makes of one


class Decoder(nn.Module):
    """Mirrors an encoder, whatever its maps are: for each stage on the way back a `SkipJoin` that
    undoes its merging, then blocks on its windows; at the end ×4 along both axes.

    Args:
        plans: of the encoder's stages. embed_dim: D of its first map.
        depths: blocks of each stage but the last, the first one's first; an int is for all.
        num_heads: of the encoder's stages.
        attention, mlp_ratio, drop_path_rate: as `make_stages`.

    Raises:
        ValueError: as many depths as there are not stages.

    Source: Swin-Unet, ECCV 2022 workshops; DarSwin-Unet, WACV 2025.
    """

    def __init__(
        self,
        plans: Sequence[StagePlan],
        embed_dim: int,
        depths: int | Sequence[int],
        num_heads: Sequence[int],
        *,
        attention: Callable[[int, int, StagePlan, int], nn.Module],
        mlp_ratio: float,
        drop_path_rate: float,
    ):
        super().__init__()
        upper = plans[:-1]
        depths = [depths] * len(upper) if isinstance(depths, int) else list(depths)
        if len(depths) != len(upper) or min(depths, default=1) < 1:
            raise ValueError(
                "decoder_depths must be an int of at least 1, or one for each stage but the last, "
                f"{len(upper)}, got {depths}"
            )
        self.joins = nn.ModuleList(
            SkipJoin(embed_dim * 2**plan.index, after.merge)
            for plan, after in zip(upper, plans[1:], strict=True)
            if after.merge is not None
        )
        self.stages = make_stages(
            upper,
            embed_dim,
            depths,
            num_heads[: len(upper)],
            attention=attention,
            downsample=lambda _dim, _merge: nn.Identity(),
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
        )
        self.expand = PatchExpand(embed_dim, embed_dim, (EXPANSION, EXPANSION))

    def forward(
        self, maps: Sequence[Tensor], positions: Sequence[Sequence[Tensor | None]]
    ) -> Tensor:
        """The maps of all stages, (B, R, A, D) the first → (B, 4·R, 4·A, D).

        Args:
            positions: of each stage but the last, as `Prepared` has them.
        """
        x = maps[-1]
        steps = zip(self.joins, self.stages, maps[:-1], positions, strict=True)
        for join, stage, skip, of_stage in reversed(list(steps)):
            x = stage(join(x, skip), *of_stage)
        return self.expand(x)
