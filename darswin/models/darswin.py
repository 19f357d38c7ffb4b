"""DarSwin: an image encoder in the polar coordinates of a calibrated lens."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

from darswin.grid import Placement, PolarGrid, Spacing, polar_grid
from darswin.layers import (
    Block,
    PatchMerging,
    PolarPatchEmbed,
    PositionBias,
    check_images,
    radial_positions,
)
from darswin.lens import Lens
from darswin.models import official

Pair = tuple[int, int]


@dataclass(frozen=True)
class StagePlan:
    """Sizes of a stage: its map (R, A), its windows, the shift of its odd blocks, and the merging
    that leads to it."""

    map_size: Pair
    window: Pair
    shift: Pair
    merge: Pair | None


def plan_stages(
    rings: int, sectors: int, count: int, variant: Literal["A", "RA"], window: Pair
) -> list[StagePlan]:
    """The stages' sizes; ValueError where a window or a merging does not divide its map.

    A window keeps its number of tokens when an axis runs out. DarSwin-A merges 4 along azimuth,
    once the ring is used up along the radius; it shifts by a quarter window along azimuth, or,
    where one window spans the ring, by half along the radius. DarSwin-RA merges 2×2 and shifts by
    half the window along both axes. There is no shift along an axis that one window spans.
    """
    plans: list[StagePlan] = []
    size, merge = (rings, sectors), None
    for stage in range(count):
        if stage > 0:
            merge = _merging(size, variant, stage)
            size = (size[0] // merge[0], size[1] // merge[1])
        fitted = _fit_window(window, size)
        if size[0] % fitted[0] or size[1] % fitted[1]:
            raise ValueError(
                f"stage {stage + 1}: window {fitted} must divide the map (R, A) = {size}; "
                "choose other rings, sectors or window"
            )
        plans.append(StagePlan(size, fitted, _shift(size, fitted, variant), merge))
    return plans


def _merging(size: Pair, variant: str, stage: int) -> Pair:
    choices = [(2, 2)] if variant == "RA" else [(1, 4), (4, 1)] if size[1] < 4 else [(1, 4)]
    for merge in choices:
        if size[0] % merge[0] == 0 and size[1] % merge[1] == 0:
            return merge
    raise ValueError(
        f"stage {stage + 1}: a map of (R, A) = {size} cannot be merged by {choices[-1]}; "
        "choose other rings or sectors, or fewer stages"
    )


def _fit_window(window: Pair, size: Pair) -> Pair:
    tokens = window[0] * window[1]
    if window[1] > size[1]:
        return (min(size[0], tokens // size[1]), size[1])
    if window[0] > size[0]:
        return (size[0], min(size[1], tokens // size[0]))
    return window


def _shift(size: Pair, window: Pair, variant: str) -> Pair:
    half = tuple(w // 2 if s > w else 0 for s, w in zip(size, window, strict=True))
    if variant == "RA":
        return half
    return (0, window[1] // 4) if size[1] > window[1] else (half[0], 0)


class Stage(nn.Module):
    """Merging, then blocks; odd ones are shifted."""

    def __init__(
        self, dim: int, depth: int, heads: int, plan: StagePlan, drop_path: Sequence[float], **block
    ):
        super().__init__()
        self.map_size = plan.map_size
        self.downsample = PatchMerging(dim // 2, plan.merge) if plan.merge else nn.Identity()
        self.blocks = nn.ModuleList(
            Block(
                dim,
                heads,
                map_size=plan.map_size,
                window=plan.window,
                shift=plan.shift if index % 2 else (0, 0),
                drop_path=drop_path[index],
                **block,
            )
            for index in range(depth)
        )

    def forward(self, x: Tensor, radial: Tensor) -> Tensor:
        """The map of the stage before → this stage's map."""
        x = self.downsample(x)
        for block in self.blocks:
            x = block(x, radial)
        return x


class DarSwin(nn.Module):
    """The Distortion Aware Radial Swin Transformer.

    The image is cut into R × A polar patches along the lens's projection curve, each sampled at
    S_r × S_φ points and embedded; blocks of windowed attention on the polar map follow, with
    merging in between. Any image size works; R and A are those of the model.

    Args:
        num_classes: 0 leaves out the head. in_chans: C of the images.
        embed_dim, depths, num_heads: of the stages; width doubles at each.
        rings, sectors: R and A. samples: (S_r, S_φ).
        variant: "A" has windows and merging along azimuth, "RA" along radius and azimuth.
        window: (M_r, M_φ) where the map is large enough; None means (1, 16) for A, (4, 4) for RA.
        mlp_ratio: hidden width of the MLPs over D. drop_path_rate: of the last block; linear.
        spacing, sample_spacing, placement: as `darswin.grid.polar_grid`. "radius" for both is a
            model without lens knowledge, "radius" for the samples alone samples uniformly.
        jitter: in [0, 1], of the sample points in training; 0 is off.
        position_bias: "angular_relative", or the ablations "angular" and "polar" with `harmonics`.
        periodic_bias: see `AngularRelativeBias`.
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.
        compat: "official" reproduces the authors' released DarSwin-A: its sampling grid, masks,
            shifts and bias angles. Overrides spacing, sample_spacing, placement and jitter.

    Raises:
        ValueError: sizes that windows or merging do not divide, or an unknown option.

    Source: DarSwin, ICCV 2023.
    """

    def __init__(
        self,
        num_classes: int = 1000,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        rings: int = 16,
        sectors: int = 64,
        samples: Pair = (10, 10),
        variant: Literal["A", "RA"] = "A",
        window: Pair | None = None,
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        spacing: Spacing = "theta",
        sample_spacing: Spacing | None = None,
        placement: Placement = "centers",
        jitter: float = 1.0,
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
        compat: Literal["official"] | None = None,
    ):
        super().__init__()
        if variant not in ("A", "RA"):
            raise ValueError(f"variant must be 'A' or 'RA', got {variant!r}")
        if compat not in (None, "official") or (compat and variant != "A"):
            raise ValueError(
                f"compat must be None, or 'official' with variant 'A'; got {compat!r}, {variant!r}"
            )
        if len(depths) != len(num_heads) or not depths:
            raise ValueError(f"depths and num_heads must pair up, got {depths} and {num_heads}")
        window = window or ((1, 16) if variant == "A" else (4, 4))
        plans = plan_stages(rings, sectors, len(depths), variant, window)
        if compat:
            plans = [official.plan(plan, window) for plan in plans]
        self.num_classes, self.in_chans = num_classes, in_chans
        self.num_features = embed_dim * 2 ** (len(depths) - 1)
        self.compat, self.position_bias = compat, position_bias

        self.patch_embed = PolarPatchEmbed(
            rings,
            sectors,
            samples,
            in_chans=in_chans,
            embed_dim=embed_dim,
            spacing="tan" if compat else spacing,
            sample_spacing="tan" if compat else sample_spacing,
            placement="edges" if compat else placement,
            jitter=0.0 if compat else jitter,
            mean=mean,
            std=std,
            grid=official.grid if compat else polar_grid,
        )
        rates = [drop_path_rate * k / max(sum(depths) - 1, 1) for k in range(sum(depths))]
        self.stages = nn.ModuleList()
        for index, (plan, depth, heads) in enumerate(zip(plans, depths, num_heads, strict=True)):
            before = sum(depths[:index])
            self.stages.append(
                Stage(
                    embed_dim * 2**index,
                    depth,
                    heads,
                    plan,
                    drop_path=rates[before : before + depth],
                    mlp_ratio=mlp_ratio,
                    periodic=(False, not compat),
                    position_bias=position_bias,
                    harmonics=harmonics,
                    # The released code has M_φ rows of coefficients where one window is the map.
                    periodic_bias=plan.window == plan.map_size if compat else periodic_bias,
                )
            )
        self.norm = nn.LayerNorm(self.num_features)
        self.reset_classifier(num_classes)
        self.apply(_init_weights)

    def reset_classifier(self, num_classes: int) -> None:
        """A new head for `num_classes` classes; 0 leaves it out."""
        self.num_classes = num_classes
        self.head = nn.Linear(self.num_features, num_classes) if num_classes else nn.Identity()
        _init_weights(self.head)

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters, besides biases and norms, that a recipe should not decay."""
        return {name for name, _ in self.named_parameters() if ".position_bias." in name}

    def _radial(self, lens: Lens, grid: PolarGrid, rings: int) -> Tensor:
        if self.compat:
            return official.radial_positions(lens, rings)
        return radial_positions(lens, grid, rings, self.position_bias)

    def _stage_maps(self, images: Tensor, lens: Lens) -> list[Tensor]:
        images = check_images(images, lens)
        grid = self.patch_embed.sample.grid(lens, images.shape[2:])
        if self.compat:
            images = images.transpose(2, 3)  # its x runs down and its y to the right
        x = self.patch_embed(images, grid)
        maps = []
        for stage in self.stages:
            x = stage(x, self._radial(lens, grid, stage.map_size[0]))
            maps.append(x)
        return maps

    def forward_features(self, images: Tensor, lens: Lens) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → the last map, (B, R', A', D'), normed."""
        return self.norm(self._stage_maps(images, lens)[-1])

    def forward_intermediates(
        self,
        images: Tensor,
        lens: Lens,
        *,
        indices: int | Sequence[int] | None = None,
        intermediates_only: bool = False,
    ) -> list[Tensor] | tuple[Tensor, list[Tensor]]:
        """The polar maps of the stages, before the norm, and `forward_features`.

        Args:
            indices: which stages; an int means the last so many, None all.
            intermediates_only: leaves out the first result.

        Returns:
            (features, maps), each map (B, R, A, D) of its stage.
        """
        count = len(self.stages)
        chosen = range(count)[-indices:] if isinstance(indices, int) else indices or range(count)
        if (isinstance(indices, int) and not 0 < indices <= count) or any(
            not -count <= i < count for i in chosen
        ):
            raise ValueError(f"indices must name some of {count} stages, got {indices}")
        maps = self._stage_maps(images, lens)
        intermediates = [maps[i] for i in chosen]
        return intermediates if intermediates_only else (self.norm(maps[-1]), intermediates)

    def forward_head(self, features: Tensor, pre_logits: bool = False) -> Tensor:
        """Features (B, R', A', D') → logits (B, num_classes), or their mean (B, D')."""
        pooled = features.mean((1, 2))
        return pooled if pre_logits else self.head(pooled)

    def forward(self, images: Tensor, lens: Lens) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → logits (B, num_classes)."""
        return self.forward_head(self.forward_features(images, lens))


def _init_weights(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
