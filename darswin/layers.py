"""The layers of the models. A polar map is (B, R, A, D) from the embedding to the head; the maps of
Swin and DAT are (B, H, W, D), rows and columns."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.grid import Placement, PolarGrid, Spacing, check_grid, polar_grid
from darswin.lens import Lens
from darswin.linear import Linear
from darswin.ops import polar_embed, polar_sample, window_attention
from darswin.ops.checks import channels_first, check_jitter, check_layout, per_channel
from darswin.ops.reference import normalized
from darswin.recompute import made_again

PositionBias = Literal["angular_relative", "angular", "polar"]
GridFunction = Callable[..., PolarGrid]


class PolarSample(nn.Module):
    """Samples images on the polar grid of their lenses: what `F.grid_sample` does, with the grid.

    Args:
        rings, sectors, samples, spacing, sample_spacing, placement: as `darswin.grid.polar_grid`.
        jitter: in [0, 1], how far a sample may move, in cells; only in training. The seed of each
            call comes from torch's generator.
        layout: "image" gives (B, C, R·S_r, A·S_φ), "tokens" (B, R, A, S_r·S_φ·C).
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.
        grid: the function that makes the grid.

    Raises:
        ValueError: settings that make no grid, here; images and lenses that do not fit, in forward.

    Source: DarSwin, ICCV 2023, sec. 4.2 and 4.3.
    """

    def __init__(
        self,
        rings: int,
        sectors: int,
        samples: tuple[int, int],
        *,
        spacing: Spacing = "theta",
        sample_spacing: Spacing | None = None,
        placement: Placement = "centers",
        jitter: float = 0.0,
        layout: Literal["tokens", "image"] = "image",
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
        grid: GridFunction = polar_grid,
    ):
        super().__init__()
        check_grid(rings, sectors, samples, spacing, sample_spacing or spacing, placement)
        check_layout(layout)
        self.rings, self.sectors, self.samples = int(rings), int(sectors), (*map(int, samples),)
        self.spacing, self.sample_spacing = spacing, sample_spacing or spacing
        self.placement, self.jitter, self.layout = placement, check_jitter(jitter), layout
        self.mean, self.std = mean, std
        self._grid = grid

    def grid(self, lens: Lens, image_size: tuple[int, int]) -> PolarGrid:
        """The grid of a lens in images of (H, W)."""
        return self._grid(
            lens,
            image_size,
            rings=self.rings,
            sectors=self.sectors,
            samples=self.samples,
            spacing=self.spacing,
            sample_spacing=self.sample_spacing,
            placement=self.placement,
        )

    def arguments(self, images: Tensor, grid: PolarGrid) -> dict:
        """What the operators sample images with, on a grid that `grid` gave."""
        dtype = torch.float64 if images.dtype == torch.float64 else torch.float32
        radii, azimuths, center, _, affine, offsets = (
            None if t is None else t.to(images.device, dtype) for t in grid
        )
        jitter = self.jitter if self.training else 0.0
        # 62 bits, so that the seed is a tensor that compiled training does not specialise on.
        seed = torch.randint(2**62, ()) if jitter else 0
        statistics = dict(mean=self.mean, std=self.std) if images.dtype == torch.uint8 else {}
        return dict(
            image=images, radii=radii, azimuths=azimuths, center=center, affine=affine,
            offsets=offsets, patch=self.samples, jitter=jitter, seed=seed, **statistics,
        )  # fmt: skip

    def forward(self, images: Tensor, lens: Lens) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → the samples, in `layout`."""
        images = check_images(images)
        check_lens(lens, images)
        grid = self.grid(lens, images.shape[2:])
        return polar_sample(**self.arguments(images, grid), layout=self.layout)

    def extra_repr(self) -> str:
        return (
            f"rings={self.rings}, sectors={self.sectors}, samples={self.samples}, "
            f"spacing={self.spacing!r}, sample_spacing={self.sample_spacing!r}, "
            f"placement={self.placement!r}, jitter={self.jitter}, layout={self.layout!r}"
        )


def check_images(images: Tensor) -> Tensor:
    """The images as (B, C, H, W), else TypeError or ValueError. uint8 ones may be (B, H, W, 3)."""
    if not isinstance(images, Tensor):
        raise TypeError(f"images must be a tensor, got {type(images).__name__}")
    if images.dim() != 4:
        raise ValueError(f"images must have shape (B, C, H, W), got {tuple(images.shape)}")
    return channels_first(images)


def check_lens(lens: Lens, images: Tensor) -> None:
    """TypeError or ValueError unless there is a lens for each image, or one, and of its size.

    Compiled graphs cannot look at a value, so they do not check sizes."""
    if not isinstance(lens, Lens):
        raise TypeError(f"lens must be a darswin.lens.Lens, got {type(lens).__name__}")
    if len(lens) not in (1, images.shape[0]):
        raise ValueError(
            f"there must be one lens or one an image, {images.shape[0]}, got {len(lens)}"
        )
    if lens.image_size is None or torch.compiler.is_compiling():
        return
    size = tuple(images.shape[2:])
    for other in lens.image_size.unique(dim=0).tolist():
        if tuple(other) != size:
            raise ValueError(
                f"the lens belongs to images of (H, W) = {tuple(round(s) for s in other)}, got "
                f"images of {size}; lens.resized({size}) is the lens of a resized image"
            )


def check_dtype(images: Tensor, dtype: torch.dtype) -> None:
    """TypeError unless the images are uint8 or of a model's dtype, or autocast makes them so."""
    if images.dtype in (torch.uint8, dtype):
        return
    autocast = torch.is_autocast_enabled(images.device.type)
    if not autocast or torch.float64 in (images.dtype, dtype):
        raise TypeError(
            f"images must be uint8, or {dtype} as the model's weights are, got {images.dtype}"
        )


class Pixels(nn.Module):
    """The images of a model of fixed size, as (B, C, H, W) in floating point.

    Args:
        image_size: (H, W). in_chans: C.
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.

    Raises:
        TypeError, ValueError: images of another kind, shape, size or number of channels.
    """

    def __init__(
        self,
        image_size: tuple[int, int],
        in_chans: int = 3,
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
    ):
        super().__init__()
        self.image_size, self.in_chans = tuple(image_size), in_chans
        self.mean, self.std = per_channel("mean", mean, in_chans), per_channel("std", std, in_chans)

    def forward(self, images: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(B, C, H, W), or uint8 (B, H, W, 3) → (B, C, H, W), of uint8 in `dtype`."""
        images = check_images(images)
        check_channels(images, self.in_chans)
        if images.shape[2:] != self.image_size:
            raise ValueError(
                f"images must have the model's image_size, (H, W) = {self.image_size}, "
                f"got {tuple(images.shape[2:])}"
            )
        if images.dtype != torch.uint8:
            return images
        exact = torch.promote_types(dtype, torch.float32)
        return normalized(images, self.mean, self.std, exact).to(dtype)

    def extra_repr(self) -> str:
        return f"image_size={self.image_size}, mean={self.mean}, std={self.std}"


def check_channels(images: Tensor, in_chans: int) -> None:
    """ValueError unless the images (B, C, H, W) have `in_chans` channels."""
    if images.shape[1] != in_chans:
        raise ValueError(f"images must have {in_chans} channels, got {images.shape[1]}")


class PatchProjection(nn.Module):
    """Joins p × p neighbours of a map into one: a convolution as wide as its step, a LayerNorm.

    Args:
        dim: D of the map, out_dim: D'. patch: p, which divides the map. bias: of the convolution.

    Source: Swin Transformer, ICCV 2021, sec. 3.1; DAT, CVPR 2022, sec. 3.3.
    """

    def __init__(self, dim: int, out_dim: int, patch: int, *, bias: bool = True):
        super().__init__()
        self.proj = nn.Conv2d(dim, out_dim, patch, patch, bias=bias)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, D) → (B, H/p, W/p, D')."""
        check_dtype(x, self.proj.weight.dtype)
        return self.norm(self.proj(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


class PolarPatchEmbed(nn.Module):
    """Image and lens → polar map: samples of each patch, a linear layer, a LayerNorm.

    Args:
        in_chans: C. embed_dim: D. Others: as `PolarSample`.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """

    def __init__(
        self,
        rings: int,
        sectors: int,
        samples: tuple[int, int],
        *,
        in_chans: int = 3,
        embed_dim: int = 96,
        **grid_options,
    ):
        super().__init__()
        self.in_chans = in_chans
        self.sample = PolarSample(rings, sectors, samples, layout="tokens", **grid_options)
        self.proj = Linear(samples[0] * samples[1] * in_chans, embed_dim)
        self.norm = nn.LayerNorm(embed_dim)

    def forward(self, images: Tensor, grid: PolarGrid) -> Tensor:
        """(B, C, H, W), uint8 or of the weights' dtype → (B, R, A, D)."""
        check_channels(images, self.in_chans)
        weight, bias = self.proj.weight, self.proj.bias
        check_dtype(images, weight.dtype)
        if images.dtype == torch.uint8 and weight.dtype == torch.float64:
            mean, std = (
                per_channel(name, getattr(self.sample, name), self.in_chans)
                for name in ("mean", "std")
            )
            images = normalized(images, mean, std, weight.dtype)  # the operator would use float32
        tokens = polar_embed(**self.sample.arguments(images, grid), weight=weight, bias=bias)
        if weight.dtype == torch.bfloat16:
            tokens = tokens.bfloat16()  # of uint8 images they are float32
        return self.norm(tokens)


class RelativeBias(nn.Module):
    """B_θ + B_φ: a bias table from the angles between tokens. Subclasses say what one axis gives.

    Args:
        window: (M_r, M_φ). sectors: A of the map.
    """

    def __init__(self, window: tuple[int, int], sectors: int):
        super().__init__()
        self.window, self.turn = window, 2 * math.pi / sectors

    def _coefficients(self, rows: int, heads: int) -> nn.Parameter:
        return nn.Parameter(nn.init.trunc_normal_(torch.empty(rows, heads), std=0.02))

    def _axis(self, angle: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Angles (N, K) of Δ = -(K-1)/2 … (K-1)/2 → (N, K, heads)."""
        raise NotImplementedError

    def forward(self, radial: Tensor) -> Tensor:
        """`radial` (N, at least M_r) rad: how far 0, 1, … rings reach.

        Returns:
            (N, heads, 2·M_r-1, 2·M_φ-1), the `bias` of `window_attention`.
        """
        outward = radial[:, : self.window[0]]
        theta = torch.cat((-outward[:, 1:].flip(1), outward), 1)
        reach = self.window[1]
        phi = torch.arange(1 - reach, reach, device=radial.device, dtype=radial.dtype) * self.turn
        along_r = self._axis(theta, self.a_theta, self.b_theta).transpose(1, 2)
        along_phi = self._axis(phi[None], self.a_phi, self.b_phi).transpose(1, 2)
        return along_r[..., None] + along_phi[..., None, :]


class AngularRelativeBias(RelativeBias):
    """B = a_Δ sin α + b_Δ cos α, α the angle between two tokens Δ apart.

    Coefficients are stored by Δ modulo their number: Δ = 0, 1, …, -2, -1.

    Args:
        window, sectors: as `RelativeBias`. heads: attention heads.
        periodic: φ coefficients by Δφ modulo M_φ rather than modulo 2·M_φ-1, which makes them, and
            so the bias, periodic; for a window that spans the ring.

    Source: DarSwin, ICCV 2023, eq. 9 to 11.
    """

    def __init__(self, window: tuple[int, int], heads: int, sectors: int, periodic: bool = False):
        super().__init__(window, sectors)
        rows_theta, rows_phi = 2 * window[0] - 1, window[1] if periodic else 2 * window[1] - 1
        self.a_theta = self._coefficients(rows_theta, heads)
        self.b_theta = self._coefficients(rows_theta, heads)
        self.a_phi = self._coefficients(rows_phi, heads)
        self.b_phi = self._coefficients(rows_phi, heads)

    def _axis(self, angle: Tensor, a: Tensor, b: Tensor) -> Tensor:
        reach, angle = angle.shape[1] // 2, angle[..., None]
        # Rows Δ = -reach … reach. Slices: the gradient of an index would be a slow scatter.
        a, b = (torch.cat((rows[len(rows) - reach :], rows[: reach + 1])) for rows in (a, b))
        return a * torch.sin(angle) + b * torch.cos(angle)


class FourierBias(RelativeBias):
    """B = b_0 + (1/P) Σ_{p=1..P} (a_p sin pα + b_p cos pα), P harmonics.

    α is the angle between two tokens ("angular"), or along the radius their distance in the image,
    the circle's radius being π ("polar"): what `radial` holds decides.

    Args:
        window, sectors: as `RelativeBias`. heads: attention heads. harmonics: P.

    Source: DarSwin, ICCV 2023, table 3, after Ning et al., IJCAI 2020.
    """

    def __init__(self, window: tuple[int, int], heads: int, sectors: int, harmonics: int = 16):
        super().__init__(window, sectors)
        self.a_theta = self._coefficients(harmonics, heads)
        self.b_theta = self._coefficients(harmonics + 1, heads)
        self.a_phi = self._coefficients(harmonics, heads)
        self.b_phi = self._coefficients(harmonics + 1, heads)

    def _axis(self, angle: Tensor, a: Tensor, b: Tensor) -> Tensor:
        harmonics = a.shape[0]
        waves = angle[..., None] * torch.arange(1, harmonics + 1, device=angle.device)
        return b[0] + (torch.sin(waves) @ a + torch.cos(waves) @ b[1:]) / harmonics


class RelativeTable(nn.Module):
    """A learned bias for each offset between two tokens, which knows no angle.

    Args:
        window: (M_r, M_φ), or of a plain map rows and columns. heads: attention heads.

    Source: Swin Transformer, ICCV 2021, eq. 4.
    """

    def __init__(self, window: tuple[int, int], heads: int):
        super().__init__()
        table = torch.empty(heads, 2 * window[0] - 1, 2 * window[1] - 1)
        self.table = nn.Parameter(nn.init.trunc_normal_(table, std=0.02))

    def forward(self) -> Tensor:
        """(1, heads, 2·M_r-1, 2·M_φ-1), the `bias` of `window_attention`."""
        return self.table[None]


class WindowAttention(nn.Module):
    """Multi-head attention in the windows of a map, as in Swin.

    Args:
        dim: D. num_heads: divides D. map_size: (R, A), or of a plain map (H, W).
        window: (M_r, M_φ), which divides the map. shift: (s_r, s_φ).
        periodic: whether the map wraps around along each axis.
        position_bias: makes the bias from the window and the heads.

    Raises:
        ValueError: sizes that do not divide.

    Source: Swin Transformer, ICCV 2021, sec. 3.2.
    """

    recompute = False  # see `Encoder.set_recompute`

    def __init__(
        self,
        dim: int,
        num_heads: int,
        *,
        map_size: tuple[int, int],
        window: tuple[int, int],
        shift: tuple[int, int] = (0, 0),
        periodic: tuple[bool, bool] = (False, False),
        position_bias: Callable[[tuple[int, int], int], nn.Module] = RelativeTable,
        qkv_bias: bool = True,
    ):
        super().__init__()
        check_heads(dim, num_heads)
        if map_size[0] % window[0] or map_size[1] % window[1]:
            raise ValueError(f"window must divide the map (R, A) = {map_size}, got {window}")
        self.num_heads, self.window, self.shift = num_heads, tuple(window), tuple(shift)
        self.map_size, self.periodic = tuple(map_size), tuple(periodic)
        self.qkv = Linear(dim, 3 * dim, bias=qkv_bias)
        self.proj = Linear(dim, dim)
        self.position_bias = position_bias(self.window, num_heads)

    def forward(self, x: Tensor, *positions: Tensor) -> Tensor:
        """(B, R, A, D) → the same shape. `positions` are what the bias is made from."""
        batch, rings, sectors, dim = x.shape
        if (rings, sectors) != self.map_size:
            raise ValueError(f"the map must be (R, A) = {self.map_size}, got {(rings, sectors)}")
        qkv = self.qkv(x).reshape(batch, rings, sectors, 3, self.num_heads, dim // self.num_heads)
        attend = partial(
            window_attention, window=self.window, shift=self.shift, periodic=self.periodic
        )
        bias = self.position_bias(*positions)
        out = attend(qkv, bias)
        with made_again(out, attend, qkv, bias, when=self.recompute):
            return self.proj(out)

    def extra_repr(self) -> str:
        return (
            f"map_size={self.map_size}, window={self.window}, shift={self.shift}, "
            f"periodic={self.periodic}"
        )


def check_heads(dim: int, num_heads: int) -> None:
    """ValueError unless the heads divide the width."""
    if dim % num_heads:
        raise ValueError(f"num_heads must divide dim = {dim}, got {num_heads}")


class PolarWindowAttention(WindowAttention):
    """Multi-head attention in the windows of a polar map, with a bias that knows the angles.

    Args:
        dim, num_heads, map_size, window, shift, periodic: as `WindowAttention`.
        position_bias: "angular_relative", "angular" or "polar".
        harmonics: of the last two. periodic_bias: see `AngularRelativeBias`; it acts where the
            window spans the ring.

    Raises:
        ValueError: sizes that do not divide, or an unknown position bias.

    Source: DarSwin, ICCV 2023, sec. 4.4 and 4.5.
    """

    def __init__(
        self,
        dim: int,
        num_heads: int,
        *,
        map_size: tuple[int, int],
        window: tuple[int, int],
        shift: tuple[int, int] = (0, 0),
        periodic: tuple[bool, bool] = (False, True),
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
        qkv_bias: bool = True,
    ):
        sectors = map_size[1]
        if position_bias == "angular_relative":
            whole = periodic_bias and window[1] == sectors
            bias = partial(AngularRelativeBias, sectors=sectors, periodic=whole)
        elif position_bias in ("angular", "polar"):
            bias = partial(FourierBias, sectors=sectors, harmonics=harmonics)
        else:
            raise ValueError(
                "position_bias must be 'angular_relative', 'angular' or 'polar', "
                f"got {position_bias!r}"
            )
        super().__init__(
            dim,
            num_heads,
            map_size=map_size,
            window=window,
            shift=shift,
            periodic=periodic,
            position_bias=bias,
            qkv_bias=qkv_bias,
        )

    def forward(self, x: Tensor, radial: Tensor) -> Tensor:
        """(B, R, A, D) → the same shape. `radial` (B or 1, R+1): see `radial_positions`."""
        return super().forward(x, radial.to(x.device, self.proj.weight.dtype))


def radial_positions(lens: Lens, grid: PolarGrid, rings: int, kind: PositionBias) -> Tensor:
    """(N, rings+1): how far from the centre the borders of a map of `rings` rings are, in rad.

    The angle θ, equally split; for "polar" the radius in the image, the circle's radius being π.
    """
    if kind == "polar":
        step = (grid.borders.shape[1] - 1) // rings
        borders = grid.borders[:, ::step]
        return borders * (math.pi / borders[:, -1:])
    fractions = torch.linspace(0, 1, rings + 1, device=lens.theta_max.device)
    return lens.theta_max[:, None] * fractions


class DropPath(nn.Module):
    """Stochastic depth: in training, drops a branch for whole images with probability p."""

    def __init__(self, p: float = 0.0):
        super().__init__()
        if not 0 <= p < 1:
            raise ValueError(f"drop path must be in [0, 1), got {p}")
        self.p = p

    def forward(self, x: Tensor) -> Tensor:
        if self.p == 0 or not self.training:
            return x
        keep = 1 - self.p
        mask = torch.bernoulli(x.new_full((x.shape[0], *(1,) * (x.dim() - 1)), keep))
        return x * (mask / keep)

    def extra_repr(self) -> str:
        return f"p={self.p}"


class Mlp(nn.Module):
    """Linear, GELU, Linear."""

    recompute = False  # see `Encoder.set_recompute`

    def __init__(self, dim: int, hidden: int):
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.fc1(x)
        x = F.gelu(hidden)
        with made_again(x, F.gelu, hidden, when=self.recompute):
            return self.fc2(x)


class Block(nn.Module):
    """Pre-norm transformer block: attention, then an MLP, each behind a residual.

    Args:
        dim: D. attn: maps (B, R, A, D), and positions, to the same shape.
        mlp_ratio: hidden width of the MLP over D. drop_path: probability.
    """

    recompute = False  # see `Encoder.set_recompute`

    def __init__(
        self, dim: int, attn: nn.Module, *, mlp_ratio: float = 4.0, drop_path: float = 0.0
    ):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attn = attn
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, int(dim * mlp_ratio))
        self.drop_path = DropPath(drop_path)

    def forward(self, x: Tensor, *positions: Tensor) -> Tensor:
        """(B, R, A, D) → the same shape. `positions` are the attention's."""
        y = self.norm1(x)
        with made_again(y, self.norm1, x, when=self.recompute):
            y = self.attn(y, *positions)
        x = x + self.drop_path(y)
        y = self.norm2(x)
        with made_again(y, self.norm2, x, when=self.recompute):
            y = self.mlp(y)
        return x + self.drop_path(y)


class PatchMerging(nn.Module):
    """Joins m_r × m_φ neighbouring tokens into one of twice the width.

    Args:
        dim: D. merge: (m_r, m_φ): (1, 4) in DarSwin-A, (2, 2) in DarSwin-RA.

    Source: DarSwin, ICCV 2023, sec. 4.4.
    """

    def __init__(self, dim: int, merge: tuple[int, int]):
        super().__init__()
        self.merge = tuple(merge)
        joined = dim * merge[0] * merge[1]
        self.norm = nn.LayerNorm(joined)
        self.reduction = Linear(joined, 2 * dim, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R/m_r, A/m_φ, 2·D)."""
        batch, rings, sectors, dim = x.shape
        mr, ma = self.merge
        if rings % mr or sectors % ma:
            raise ValueError(f"merge {self.merge} must divide (R, A) = {(rings, sectors)}")
        # Inner order (φ, r, D): neighbours along the radius come first.
        x = x.reshape(batch, rings // mr, mr, sectors // ma, ma, dim).permute(0, 1, 3, 4, 2, 5)
        return self.reduction(self.norm(x.flatten(3)))

    def extra_repr(self) -> str:
        return f"merge={self.merge}"
