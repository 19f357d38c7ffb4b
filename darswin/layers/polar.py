"""The polar grid: rings and sectors of a lens's image, the samples in them, and the way back from a
polar map to pixels.

Rings and samples are equal steps of a *spacing*; see `darswin.lens.spacing`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from darswin.lens import Lens
from darswin.lens.pixels import pixel_rays
from darswin.lens.solve import direction_of, vector_of
from darswin.lens.spacing import (
    SPACINGS,
    Spacing,
    change_spacing,
    check_fixed_theta_max,
    check_tan,
    span,
    to_theta,
)
from darswin.ops import polar_sample, polar_to_image_plan
from darswin.ops.checks import (
    FRAME_CHANNELS,
    as_int,
    channels_first,
    check_has_batch,
    check_jitter,
    check_layout,
    readable,
)

__all__ = ["PolarGrid", "PolarGridSpec", "PolarSample", "polar_grid"]

Placement = Literal["centers", "edges"]
PLACEMENTS = get_args(Placement)


class PolarGrid(NamedTuple):
    """The points at which `polar_sample` reads the images of N lenses, and the ring borders.

    Shapes: radii (N, R·S_r) px, azimuths (A·S_φ,) rad, center (N or 1, 2) px, borders (N, R+1) px;
    for general lenses also affine (N or 1, 2, 2) and offsets (N or 1, 2, R·S_r, A·S_φ) px.
    """

    radii: Tensor
    azimuths: Tensor
    center: Tensor
    borders: Tensor
    affine: Tensor | None = None
    offsets: Tensor | None = None


class PixelGrid(NamedTuple):
    """The arguments of `polar_to_image` that resample a polar map to the pixels of the images.

    Shapes: radii of the ring centres (N, R) px; r_max (N,) px; for radial lenses center
    (N or 1, 2) px and affine (N, 2, 2), for general lenses points (N, H, W, 2) px; for a single
    lens also plan (1, H, 3, W).
    """

    radii: Tensor
    r_max: Tensor
    center: Tensor | None = None
    affine: Tensor | None = None
    points: Tensor | None = None
    plan: Tensor | None = None


@dataclass(frozen=True)
class PolarGridSpec:
    """The settings of a polar grid: R rings × A sectors, with S_r × S_φ samples in each.

    Convention:
        Ring 0 is the innermost and ring R-1 ends at θ_max. Sector a covers azimuths from 2πa/A to
        2π(a+1)/A; azimuth 0 points right, π/2 down.

    Args:
        rings: R. sectors: A. samples: (S_r, S_φ). The defaults are those of the paper.
        spacing: the quantity that increases equally from ring border to ring border.
        sample_spacing: the quantity that increases equally from sample to sample inside a ring;
            None means `spacing`.
        placement: "centers" puts the samples at the centres of equal cells; "edges" puts them from
            border to border, both included.
        theta_max: θ at the end of the last ring, rad, in (0, π), for every lens; None means θ_max
            of each lens. With a fixed angle, things of one angular size have one size on the map,
            whatever the lens. Samples beyond θ_max of a lens are zero. The spacings must be
            "theta".

    Raises:
        ValueError: an option is unknown or out of range, a size is below 1, "edges" has one sample
            along an axis, or theta_max has another spacing than "theta"; in the methods, the
            spacing is "tan" and a lens has θ_max ≥ 90°.

    Source: DarSwin, ICCV 2023, sec. 4.2 and 4.3.
    """

    rings: int = 16
    sectors: int = 64
    samples: tuple[int, int] = (10, 10)
    spacing: Spacing = "theta"
    sample_spacing: Spacing | None = None
    placement: Placement = "centers"
    theta_max: float | None = None

    def __post_init__(self) -> None:
        for name in ("rings", "sectors"):
            value = getattr(self, name)
            if (as_int(value) or 0) < 1:
                raise ValueError(f"{name} must be an int of at least 1, got {value!r}")
            object.__setattr__(self, name, int(value))  # NumPy's ints become Python's
        samples = self.samples
        if len(samples) != 2 or any((as_int(s) or 0) < 1 for s in samples):
            raise ValueError(f"samples must be (S_r, S_φ), ints of at least 1, got {samples!r}")
        object.__setattr__(self, "samples", (int(samples[0]), int(samples[1])))
        for name, choice in (("spacing", self.spacing), ("sample_spacing", self.inner_spacing)):
            if choice not in SPACINGS:
                raise ValueError(f"{name} must be one of {SPACINGS}, got {choice!r}")
        if self.placement not in PLACEMENTS:
            raise ValueError(f"placement must be one of {PLACEMENTS}, got {self.placement!r}")
        if self.placement == "edges" and min(samples) < 2:
            raise ValueError(f"placement='edges' needs 2 or more samples per axis, got {samples!r}")
        if self.theta_max is not None:
            check_fixed_theta_max(self.theta_max, self.spacing, self.inner_spacing)

    @property
    def inner_spacing(self) -> Spacing:
        """`sample_spacing`, or `spacing` if that is None."""
        return self.spacing if self.sample_spacing is None else self.sample_spacing

    def grid(self, lens: Lens, image_size: tuple[int, int]) -> PolarGrid:
        """The grid of N lenses. A lens without principal point gets the centre of (H, W)."""
        steps_r, steps_phi = (_steps(s, self.placement, lens.theta_max) for s in self.samples)
        borders, points = self._rings(lens, self.inner_spacing, steps_r)
        sector = torch.arange(self.sectors, dtype=borders.dtype, device=borders.device)[:, None]
        azimuths = (sector + steps_phi).flatten() * (2 * math.pi / self.sectors)
        radii, offsets = self._radii(lens, points, self.inner_spacing), None
        if not lens.is_radial:
            theta = to_theta(lens, points, self.inner_spacing)
            if self.theta_max is not None:
                theta = torch.minimum(theta, lens.theta_max[:, None])
            offsets = _offsets(lens, theta, azimuths)
        if self.theta_max is not None:
            radii = torch.where(points > lens.theta_max[:, None], torch.nan, radii)
        return PolarGrid(
            radii,
            azimuths,
            lens.center_in(image_size),
            self._radii(lens, borders, self.spacing),
            lens.affine,
            offsets,
        )

    def pixel_grid(self, lens: Lens, image_size: tuple[int, int], split: int = 1) -> PixelGrid:
        """The way back to images of (H, W) from a polar map with `split` rings per ring here."""
        steps = _steps(split, "centers", lens.theta_max)
        _, centers = self._rings(lens, self.inner_spacing, steps)
        radii, r_max = self._radii(lens, centers, self.inner_spacing), lens.r_max
        if self.theta_max is not None:
            end = lens.theta_max.clamp(max=self.theta_max)
            r_max = lens.project(end[:, None])[:, 0]
        if lens.is_radial:
            grid = PixelGrid(radii, r_max, lens.center_in(image_size), lens.affine)
        else:
            theta, direction = pixel_rays(lens, image_size)
            seen = ~theta.isnan()  # NaN would spread to the gradients
            flat = lens.project(torch.where(seen, theta, 0.0))[..., None] * direction
            points = torch.where(seen[..., None], flat, torch.nan)
            grid = PixelGrid(radii, r_max, points=points)
        # Plans of many lenses would take much memory. A graph has no plan, and must not ask for the
        # number of lenses, which may vary.
        if torch.compiler.is_compiling() or len(lens) != 1:
            return grid
        of_map = radii.new_empty((1, radii.shape[1], self.sectors * split, 0))
        plan = polar_to_image_plan(
            of_map, radii, grid.center, image_size,
            affine=grid.affine, points=grid.points, r_max=grid.r_max,
        )  # fmt: skip
        return grid._replace(plan=plan)

    def token_rays(self, lens: Lens) -> Tensor:
        """The viewing directions of the tokens of a map: unit vectors (x, y, z), (N, R, A, 3).

        x points right, y down and z forward. The ray of a token goes through the centre of its ring
        and its sector on the radial curve; other distortions of the lens are ignored.
        """
        _, centers = self._rings(lens, self.spacing, _steps(1, "centers", lens.theta_max))
        theta = change_spacing(lens, centers, self.spacing, "theta")[..., None]
        sector = torch.arange(self.sectors, dtype=theta.dtype, device=theta.device)
        azimuth = (sector + 0.5) * (2 * math.pi / self.sectors)
        return vector_of(theta.expand(-1, -1, self.sectors), direction_of(azimuth))

    def border_angles(self, lens: Lens) -> Tensor:
        """θ of the ring borders, (N, R+1) rad."""
        borders, _ = self._rings(lens, self.spacing, lens.theta_max.new_zeros(1))
        return to_theta(lens, borders, self.spacing)

    def last_angle(self, lens: Lens) -> Tensor:
        """θ at the end of the last ring, (N,) rad."""
        last = lens.theta_max
        return last if self.theta_max is None else torch.full_like(last, self.theta_max)

    def _radii(self, lens: Lens, values: Tensor, spacing: Spacing) -> Tensor:
        """r at values of a spacing, px. Beyond θ_max of a lens, r rises in proportion to θ."""
        if self.theta_max is None:
            return change_spacing(lens, values, spacing, "radius")
        last = lens.theta_max[:, None]
        beyond = (values - last).clamp(min=0) * (lens.r_max[:, None] / last)
        return lens.project(torch.minimum(values, last)) + beyond

    def _rings(self, lens: Lens, inner: Spacing, steps: Tensor) -> tuple[Tensor, Tensor]:
        """The ring borders (N, R+1) in units of `spacing`, and points inside the rings,
        (N, R·len(steps)) in units of `inner`. `steps` are fractions of a ring."""
        if "tan" in (self.spacing, inner):
            check_tan(lens)
        fractions = torch.linspace(0, 1, self.rings + 1, dtype=steps.dtype, device=steps.device)
        first, last = span(lens, self.spacing)
        if self.theta_max is not None:
            last = self.last_angle(lens)[:, None]
        borders = first + (last - first) * fractions
        edges = change_spacing(lens, borders, self.spacing, inner)
        begin, end = edges[:, :-1, None], edges[:, 1:, None]
        return borders, (begin + (end - begin) * steps).flatten(1)


def polar_grid(lens: Lens, image_size: tuple[int, int], **settings: Any) -> PolarGrid:
    """Cuts the image of each lens into rings × sectors and places samples in each.

    Args:
        lens: N lenses.
        image_size: (H, W); its centre is the principal point of a lens that has none.
        settings: the arguments of `PolarGridSpec`.

    Raises:
        ValueError: a setting is wrong, or the spacing is "tan" and a lens has θ_max ≥ 90°.
    """
    return PolarGridSpec(**settings).grid(lens, image_size)


def _steps(count: int, placement: Placement, like: Tensor) -> Tensor:
    """The positions of the samples of a cell, as fractions of the cell."""
    steps = torch.arange(count, dtype=like.dtype, device=like.device)
    return steps / (count - 1) if placement == "edges" else (steps + 0.5) / count


def _offsets(lens: Lens, theta: Tensor, azimuths: Tensor) -> Tensor:
    """The offset of each point from the radial curve of the lens, (N, 2, N_r, N_a) px."""
    theta = theta[:, :, None].expand(-1, -1, len(azimuths))
    direction = direction_of(azimuths)
    offsets = lens.offset(theta, direction.expand(*theta.shape, 2))
    return lens.through_affine(offsets).permute(0, 3, 1, 2)


class PolarSample(nn.Module):
    """Samples images on the polar grid of their lenses, with the operator `polar_sample`.

    Args:
        rings, sectors, samples, settings: the arguments of `PolarGridSpec`.
        jitter: how far a sample may move in training, in cells, in [0, 1]. The seed of each call
            comes from torch's generator.
        layout: "tokens" returns (B, R, A, S_r·S_φ·C), "image" returns (B, C, R·S_r, A·S_φ).
        mean, std: normalization of uint8 images, `(pixel/255 - mean) / std`; images in floating
            point are not normalized.

    Raises:
        ValueError: a setting is wrong; in forward, the images and the lenses do not fit.

    Source: DarSwin, ICCV 2023, sec. 4.2 and 4.3.
    """

    def __init__(
        self,
        rings: int,
        sectors: int,
        samples: tuple[int, int],
        *,
        jitter: float = 0.0,
        layout: Literal["tokens", "image"] = "tokens",
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
        **settings: Any,
    ):
        super().__init__()
        self.spec = PolarGridSpec(rings, sectors, samples, **settings)
        check_layout(layout)
        self.jitter, self.layout = check_jitter(jitter), layout
        self.mean, self.std = mean, std

    def grid(self, lens: Lens, image_size: tuple[int, int]) -> PolarGrid:
        """The polar grid of N lenses in images of (H, W)."""
        return self.spec.grid(lens, image_size)

    def arguments(self, images: Tensor, grid: PolarGrid) -> dict[str, Any]:
        """The arguments with which the operators sample images (B, C, H, W) on a grid."""
        dtype = torch.float64 if images.dtype == torch.float64 else torch.float32
        radii, azimuths, center, _, affine, offsets = (
            None if t is None else t.to(images.device, dtype) for t in grid
        )
        jitter = self.jitter if self.training else 0.0
        # The seed is a tensor, so that compiled training does not specialise on its value.
        seed = torch.randint(2**62, ()) if jitter else 0
        return dict(
            image=images, radii=radii, azimuths=azimuths, center=center, affine=affine,
            offsets=offsets, samples=self.spec.samples, jitter=jitter, seed=seed, mean=self.mean,
            std=self.std, channels_last=False,
        )  # fmt: skip

    def forward(self, images: Tensor, lens: Lens, channels_last: bool | None = None) -> Tensor:
        """Images and their lenses (B or 1) → the samples in `layout`.

        Args:
            images: (B, C, H, W) or (B, H, W, C).
            lens: B lenses or one.
            channels_last: the layout of the images; see `polar_sample`.
        """
        images = check_images(images, channels_last)
        height, width = images.shape[2:]
        check_lens(lens, (height, width))
        check_count(lens.count, images)
        grid = self.grid(lens, (height, width))
        return polar_sample(**self.arguments(images, grid), layout=self.layout)

    def extra_repr(self) -> str:
        return f"{self.spec}, jitter={self.jitter}, layout={self.layout!r}"


def check_images(
    images: Tensor, channels_last: bool | None = None, channels: int | None = None
) -> Tensor:
    """The images as (B, C, H, W); TypeError or ValueError if that fails, see `channels_first`."""
    if not isinstance(images, Tensor):
        raise TypeError(f"images must be a tensor, got {type(images).__name__}")
    check_has_batch("images", images, channels_last, channels)
    return channels_first("images", images, channels_last, channels)


def check_lens(lens: Lens | None, size: tuple[int, int]) -> Lens:
    """Returns the lens if it is one for images of (H, W); its size is checked if `readable`."""
    if not isinstance(lens, Lens):
        raise TypeError(f"lens must be a darswin.lens.Lens, got {type(lens).__name__}")
    if lens.image_size is None or not readable(lens.image_size):
        return lens
    for other in lens.image_size.unique(dim=0).tolist():
        if tuple(other) != size:
            advice = f"if the image was resized, use lens.resized({size})"
            if size[0] == other[1] and size[1] in FRAME_CHANNELS:
                advice = "the channels come first: pass images.permute(0, 3, 1, 2)"
            raise ValueError(
                f"the lens belongs to images of (H, W) = {tuple(round(s) for s in other)}, got "
                f"images of {size}; {advice}"
            )
    return lens


def check_count(lenses: int, images: Tensor) -> None:
    """ValueError unless there is one lens for each image or one for all."""
    if lenses not in (1, images.shape[0]):
        raise ValueError(
            f"there must be one lens, or one for each of the {images.shape[0]} images, got {lenses}"
        )
