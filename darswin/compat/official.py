"""The authors' released DarSwin-A: its weights and its differences from the paper.

Rings and samples are equal in tan θ, and samples stand on both borders of a ring. Azimuth 0 points
down, and azimuths run counterclockwise. Radii are scaled as with align_corners=True. The field of
view of image 0 applies to the whole batch. The bias uses tan θ_max as its angle. The azimuth has a
seam, and windows have other shifts.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from darswin.compat.checkpoint import Source, count_blocks, load_as
from darswin.layers.attention import PolarWindowAttention
from darswin.layers.position_bias import PositionBias
from darswin.lens import Lens, Number, Spherical
from darswin.lens.parameter import Parameter
from darswin.lens.spacing import check_tan
from darswin.models.darswin import DarSwin
from darswin.models.stages import StageSizes
from darswin.ops.reference import ranks
from darswin.views import PolarGrid, PolarView
from darswin.views.base import Pair, PerChannel


class OfficialPolynomial(Lens, register=False):
    """The polynomial lens of the released code: the angle as a function of the radius.

    θ(x) = x (d₁ + d₂ x + d₃ x² + d₄ x³) with x = r / radius in [0, 1]. The inverse is linear
    between the 50 points of a table. θ(1) is θ_max; it has its own unit and need not be an angle.

    Args:
        coefficients: d₁ … d₄, (4,) or (N, 4); θ must rise with x.
        radius: the radius of the image circle in pixels, which is half the side of the image.
    """

    coefficients = Parameter(shape=(4,))
    radius = Parameter(low=0, open=True, in_pixels=True)

    def _validate(self) -> None:
        self._require(
            "coefficients", (self._table()[1].diff(dim=1) > 0).all(1), "such that θ rises"
        )

    @property
    def theta_limit(self) -> Tensor:
        return self.coefficients.detach().sum(1)

    def _angle(self, x: Tensor) -> Tensor:
        columns = self.coefficients.reshape(*self.coefficients.shape, *(1,) * (x.dim() - 1))
        terms = (column * x**power for power, column in enumerate(columns.unbind(1), start=1))
        return sum(terms, torch.zeros_like(x))

    def _table(self) -> tuple[Tensor, Tensor]:
        """x (50,) and θ(x) (N, 50)."""
        like = self.coefficients
        x = torch.linspace(0, 1, 50, dtype=like.dtype, device=like.device)
        return x, self._angle(x[None])

    def project(self, theta: Number) -> Tensor:
        theta, radius = self._aligned(theta, "radius")
        x, angles = self._table()
        angle, radius = torch.broadcast_tensors(theta, radius)
        flat = self._by_lens(angle)
        above = ranks(angles, flat).clamp(1, len(x) - 1)
        low, high = angles.gather(1, above - 1), angles.gather(1, above)
        fraction = (flat - low) / (high - low)
        rho = x[above - 1] + fraction * (x[above] - x[above - 1])
        return rho.reshape(angle.shape) * radius

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, full = self._aligned(radius, "radius")
        return self._angle(radius / full)


class OfficialAttention(PolarWindowAttention):
    """The attention of the released code, whose angles are equal steps up to tan θ_max."""

    def angles(self, grid: PolarGrid) -> Tensor:
        return grid.last[:, None] * _inclusive(self.map_size[0], grid.last)


class OfficialView(PolarView):
    """The grid of the released code: in each step as there, with its rounding."""

    def grid(self, lens: Lens, image_size: Pair) -> PolarGrid:
        return _grid(lens, image_size, self)


class OfficialDarSwin(DarSwin):
    """The authors' released DarSwin-A. `OfficialDarSwin(num_classes)` has the sizes of the paper.

    The arguments are those of `DarSwin`. spacing, sample_spacing, placement, jitter, variant and
    merges have fixed values here.

    Raises:
        ValueError: an option is wrong for `DarSwin`; in forward, the images are not square, or a
            lens is not radial.
    """

    square_images = True
    view_class = OfficialView

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
        rings: int = 16,
        sectors: int = 64,
        samples: Pair = (10, 10),
        window: Pair = (1, 16),
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        mean: PerChannel = 0.0,
        std: PerChannel = 1.0,
    ):
        self._window = window
        super().__init__(
            num_classes, in_chans, embed_dim, depths, num_heads, mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate, rings=rings, sectors=sectors, samples=samples,
            spacing="tan", placement="edges", jitter=0.0, window=window,
            position_bias=position_bias, harmonics=harmonics, mean=mean, std=std,
        )  # fmt: skip

    def _finish(self, sizes: Sequence[StageSizes], patch: Pair) -> None:
        super()._finish([_with_shift(of_stage, self._window) for of_stage in sizes], patch)

    def attention(self, dim: int, heads: int, sizes: StageSizes, block: int) -> nn.Module:
        return OfficialAttention(
            dim,
            heads,
            **sizes.windows(block),
            periodic=(False, False),
            position_bias=self.position_bias,
            harmonics=self.harmonics,
            # The released code has M_φ rows of coefficients if the window is the whole map.
            periodic_bias=sizes.window == sizes.map_size,
        )


def _with_shift(sizes: StageSizes, window: Pair) -> StageSizes:
    """A stage's sizes with the shift of the released code."""
    shift = (window[0], window[1] // 4)
    if sizes.map_size[1] < 4:
        shift = shift[::-1]
    # A shift by whole windows of one token, or once around the map, moves nothing.
    along_r, along_phi = (
        s % size if w > 1 else 0
        for s, size, w in zip(shift, sizes.map_size, sizes.window, strict=True)
    )
    return dataclasses.replace(sizes, shift=(along_r, along_phi))


# Near 90° the rounding of float32 tangents moves samples by 1e-4 px. This code therefore follows
# the released code step by step. Even so, the samples vary by as much with the maths library (MKL
# differs between CPUs).
def _grid(lens: Lens, image_size: Pair, view: PolarView) -> PolarGrid:
    height, width = image_size
    if height != width:
        raise ValueError(f"OfficialDarSwin needs square images, got (H, W) = {image_size}")
    if lens.affine is not None or not lens.is_radial:
        raise ValueError(f"OfficialDarSwin needs radial lenses without affine, got {lens!r}")
    like = lens.theta_max
    lens = lens.replace(theta_max=like[:1].expand(lens.count))
    along_r, along_phi = (_inclusive(count - 1, like) for count in view.samples)
    ends = _last_angle(lens)[:, None] * _inclusive(view.rings, like)
    if isinstance(lens, OfficialPolynomial):
        borders = lens.project(ends)
        radii = _between(borders[:, :-1], borders[:, 1:], along_r)
    else:
        check_tan(lens)
        borders = _radius(lens, ends)
        inner, outer = borders[:, :-1], borders[:, :-1] + borders.diff(dim=1)
        tangents = _between(_tangent(lens, inner), _tangent(lens, outer), along_r)
        radii = _radius(lens, tangents)
    step = (torch.tensor(2 * math.pi, dtype=like.dtype) / view.sectors).item()
    # The range ends half a step early, so that rounding cannot add one more azimuth.
    start = torch.arange(0, (view.sectors - 0.5) * step, step, dtype=like.dtype, device=like.device)
    azimuths = _between(start, step + start, along_phi)
    scale = (height - 1) / 2 / (height // 2)
    # In the released code x points down and y to the right.
    swapped = torch.eye(2, dtype=like.dtype, device=like.device).flip(0)[None]
    # The angles of the bias are equal steps up to tan θ_max of image 0.
    last = _last_angle(lens[:1])
    center = lens.center_in(image_size)
    return PolarGrid(radii * scale, azimuths, center, borders * scale, last, affine=swapped)


def _inclusive(count: int, like: Tensor) -> Tensor:
    """The ends of `count` equal steps from 0 to 1, (count + 1,)."""
    return torch.arange(count + 1, dtype=like.dtype, device=like.device) / count


def _between(inner: Tensor, outer: Tensor, steps: Tensor) -> Tensor:
    """Borders (..., R) and fractions (S,) → points between the borders, (..., R·S)."""
    return (inner[..., None] + steps * (outer - inner)[..., None]).flatten(-2)


def _radius(lens: Lens, tangent: Tensor) -> Tensor:
    """The radius for tan θ."""
    return lens.project(torch.atan(tangent))


def _tangent(lens: Lens, radius: Tensor) -> Tensor:
    """tan θ for a radius, in the steps of the released code if that code has the lens."""
    if not isinstance(lens, Spherical):
        return torch.tan(lens.unproject(radius))
    xi, rho = lens.xi[:, None], radius / lens.focal[:, None]
    sine = xi * radius / lens.focal[:, None] / torch.sqrt(1 + rho * rho)
    return torch.tan(torch.asin(sine) + torch.atan(rho))


def _last_angle(lens: Lens) -> Tensor:
    """The largest angle, (N,): the released code splits it into rings and uses it in the bias."""
    if isinstance(lens, OfficialPolynomial):
        return lens.theta_max
    return torch.tan(lens.theta_max)


def load_official(source: Source, **options) -> DarSwin:
    """The authors' released DarSwin from its state dict, an `OfficialDarSwin` in eval mode.

    The outputs of the released "angular" and "polar" models are reproduced. The position bias of
    the released "polar" model is the paper's angular encoding (a Fourier series in θ and φ), so it
    is called "angular" here. The released radial model (DarSwin-RA) does not run. Its weights are
    loaded into our DarSwin-RA, with a warning.

    The lens of `model(images, lens)` is `lens.Spherical(xi, focal, theta_max)` in pixels of the
    images, or `OfficialPolynomial(coefficients, radius)`.

    Args:
        source: a state dict, or the path of its file: safetensors, or what `torch.save` wrote, of
            which no code is executed.
        options: constructor arguments that cannot be read from the state dict: `rings`, `sectors`,
            `samples` and `in_chans`, if they differ from 16, 64, (10, 10) and 3.

    Raises:
        ValueError: the keys or shapes are not those of a released model.
    """

    def make(state: Mapping[str, Tensor]) -> DarSwin:
        settings = _settings(state)
        kind = DarSwin if settings.get("variant") == "RA" else OfficialDarSwin
        return kind(**(settings | options))

    def convert(key: str, value: Tensor, model: DarSwin) -> tuple[str, Tensor]:
        if key == "patch_embed.mlp.weight":
            # Columns (C, S_r, S_φ) → (S_r, S_φ, C).
            value = value.unflatten(1, (model.in_chans, *model.view.samples))
            value = value.permute(0, 2, 3, 1).flatten(1)
        return _renamed(key), value

    return load_as("a released DarSwin", source, make, convert)


def _settings(state: Mapping[str, Tensor]) -> dict:
    """The constructor arguments, read from the keys and shapes."""
    depths = count_blocks(state, "layers.{}.blocks.{}.norm1.weight")
    heads = [state[f"layers.{stage}.blocks.0.attn.a_p"].shape[1] for stage in range(len(depths))]
    settings = dict(
        num_classes=state["head.weight"].shape[0],
        embed_dim=state["patch_embed.norm.weight"].shape[0],
        depths=depths,
        num_heads=heads,
    )
    cosines, sines = (state[f"layers.0.blocks.0.attn.{name}_r"].shape[0] for name in "ab")
    if cosines == sines:
        return settings | dict(position_bias="angular_relative")
    settings["harmonics"] = sines
    last_stage_masked = f"layers.{len(depths) - 1}.blocks.1.attn_mask" in state
    if depths[-1] > 1 and not last_stage_masked:
        warnings.warn(
            "the released radial model does not run, so its outputs cannot be reproduced: its "
            "weights are loaded into DarSwin-RA with the polar position bias",
            stacklevel=5,
        )
        grid = dict(spacing="tan", placement="edges", jitter=0.0)
        return settings | grid | dict(variant="RA", position_bias="polar")
    return settings | dict(position_bias="angular")


def _renamed(key: str) -> str:
    key = key.replace("patch_embed.mlp.", "patch_embed.proj.")
    if key.startswith("layers."):
        _, index, rest = key.split(".", 2)
        # Merging is the last layer of a stage there and the first layer here.
        stage = int(index) + rest.startswith("downsample.")
        key = f"stages.{stage}.{rest}"
    # There, a is for the cosine, b for the sine, r for the radius, and p for the azimuth.
    for theirs, ours in (
        ("a_r", "b_theta"),
        ("b_r", "a_theta"),
        ("a_p", "b_phi"),
        ("b_p", "a_phi"),
    ):
        if key.endswith(f".attn.{theirs}"):
            return key.removesuffix(theirs) + f"position_bias.{ours}"
    return key
