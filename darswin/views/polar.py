"""The polar view of DarSwin: rings and sectors of a lens's image, the samples in them, and the way
back from a polar map to pixels.

Rings and samples are equal steps of a *spacing*; see `darswin.lens.spacing`.
"""

import math
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import pixel_rays, ray_channels
from darswin.lens.solve import direction_of, vector_of
from darswin.lens.spacing import SPACINGS, Rings, Spacing, check_fixed_theta_max
from darswin.ops import polar_sample, polar_to_image, polar_to_image_plan
from darswin.ops.checks import as_int, check_jitter, check_layout, check_tensor
from darswin.views.base import (
    Pair,
    PerChannel,
    PixelGrid,
    PolarGrid,
    PreparedPolar,
    View,
    check_count,
    check_lens,
    check_seen_images,
    in_full_precision,
)
from darswin.views.polar_back import from_edges, nearest, places_of, resized_around, shown_by
from darswin.views.registry import register_view

Layout = Literal["tokens", "image"]
Placement = Literal["centers", "edges"]
PLACEMENTS = get_args(Placement)


class PolarView(View):
    """Samples images on the polar grid of their lenses: R rings × A sectors, S_r × S_φ samples in
    each.

    `view(images, lens)` is the samples, by the operator `polar_sample`.

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
            of each lens. With a fixed angle, the size of an object on the map does not depend on
            the lens. Samples beyond θ_max of a lens are zero. The spacings must be "theta".
        jitter: how far a sample may move in training, in cells, in [0, 1]. The seed of each call
            comes from torch's generator.
        layout: "tokens" returns (B, R, A, S_r·S_φ·C), "image" returns (B, C, R·S_r, A·S_φ).
        mean, std: the arguments of `View`.

    Raises:
        ValueError: an option is unknown or out of range, a size is below 1, "edges" has one sample
            along an axis, or theta_max has another spacing than "theta"; in the methods, the images
            and the lenses do not fit, or the spacing is "tan" and a lens has θ_max ≥ 90°.

    Source: DarSwin, ICCV 2023, sec. 4.2 and 4.3.
    """

    coordinates = 3  # the viewing direction of a token

    _rays: tuple[Tensor, Tensor] | None = None  # of the images' pixels, `for_lens`

    def __init__(
        self,
        rings: int = 16,
        sectors: int = 64,
        samples: Pair = (10, 10),
        *,
        spacing: Spacing = "theta",
        sample_spacing: Spacing | None = None,
        placement: Placement = "centers",
        theta_max: float | None = None,
        jitter: float = 0.0,
        layout: Layout = "tokens",
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(mean, std)
        for name, value in (("rings", rings), ("sectors", sectors)):
            if (as_int(value) or 0) < 1:
                raise ValueError(f"{name} must be an int of at least 1, got {value!r}")
        if len(samples) != 2 or any((as_int(s) or 0) < 1 for s in samples):
            raise ValueError(f"samples must be (S_r, S_φ), ints of at least 1, got {samples!r}")
        # NumPy's ints become Python's.
        self.rings, self.sectors = int(rings), int(sectors)
        self.samples = int(samples[0]), int(samples[1])
        self.spacing, self.sample_spacing = spacing, sample_spacing
        for name, choice in (("spacing", spacing), ("sample_spacing", self.inner_spacing)):
            if choice not in SPACINGS:
                raise ValueError(f"{name} must be one of {SPACINGS}, got {choice!r}")
        if placement not in PLACEMENTS:
            raise ValueError(f"placement must be one of {PLACEMENTS}, got {placement!r}")
        if placement == "edges" and min(samples) < 2:
            raise ValueError(f"placement='edges' needs 2 or more samples per axis, got {samples!r}")
        if theta_max is not None:
            check_fixed_theta_max(theta_max, spacing, self.inner_spacing)
        check_layout(layout)
        self.placement, self.theta_max, self.layout = placement, theta_max, layout
        self.jitter = check_jitter(jitter)
        self.in_pixels = layout == "image"

    @in_full_precision
    def for_lens(self, lens: Lens | None, size: Pair) -> Self:
        lens = check_lens(lens, size)
        return self if lens.is_radial else self._with(_rays=pixel_rays(lens, size))

    @in_full_precision
    def prepare(self, lens: Lens | None, size: Pair, *, back: bool | Pair = True) -> PreparedPolar:
        lens = check_lens(lens, size)
        grid = self.grid(lens, size)
        if not back:
            return PreparedPolar(size, grid)
        # Images of another size are resized.
        maps = self.map_size if self.in_pixels or isinstance(back, bool) else back
        pixels = self.pixel_grid(lens, size, maps)
        return PreparedPolar(size, grid, pixels, shown_by(pixels, size))

    @in_full_precision
    def ray_channels(self, lens: Lens | None, size: Pair) -> Tensor:
        lens = check_lens(lens, size)
        if self.in_pixels:
            steps_r, steps_phi = self._steps(lens)
            rays = _rays(self._rings(lens, steps_r).angles, _azimuths(self.sectors, steps_phi))
            return rays.permute(0, 3, 1, 2)
        return ray_channels(*self._rays or pixel_rays(lens, size))

    @in_full_precision
    def token_positions(self, lens: Lens | None, size: Pair) -> Tensor:
        assert lens is not None
        return self.token_rays(lens, size)

    def see(
        self, images: Tensor, prepared: PreparedPolar, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        check_count(prepared.grid.radii.shape[0], images.shape[0])
        # The operator would normalize in float32, and it needs a mean.
        if dtype == torch.float64 or self.mean is None:
            images = self.floating(images, dtype)
        samples = polar_sample(**self.arguments(images, prepared.grid), layout=self.layout)
        # The operator makes float32 of uint8. Pixels go to a network as they are, tokens do not.
        return samples.to(dtype) if self.in_pixels and images.dtype == torch.uint8 else samples

    def arguments(self, images: Tensor, grid: PolarGrid) -> dict[str, Any]:
        """The arguments with which `polar_sample` reads images (B, C, H, W) on a grid."""
        dtype = torch.float64 if images.dtype == torch.float64 else torch.float32
        radii, azimuths, center, _, _, affine, offsets = (
            None if t is None else t.to(images.device, dtype) for t in grid
        )
        jitter = self.jitter if self.training else 0.0
        # The seed is a tensor, so that compiled training does not specialise on its value.
        seed = torch.randint(2**62, ()) if jitter else 0
        return dict(
            image=images, radii=radii, azimuths=azimuths, center=center, affine=affine,
            offsets=offsets, samples=self.samples, jitter=jitter, seed=seed,
            mean=0.0 if self.mean is None else self.mean, std=1.0 if self.std is None else self.std,
            channels_last=False,
        )  # fmt: skip

    def back(self, maps: Tensor, prepared: PreparedPolar) -> Tensor:
        assert prepared.back is not None and prepared.shown is not None
        *lens, plan = prepared.back
        if self.in_pixels:
            maps = resized_around(maps, self.map_size)
            if self.placement == "edges" and maps.is_floating_point():
                maps = from_edges(maps, self.samples)
            maps = maps.permute(0, 2, 3, 1)
        if not maps.is_floating_point():
            places = places_of(maps)
            if self.in_pixels:
                places = places.permute(0, 3, 1, 2)
            return nearest(maps, self.back(places, prepared), prepared.shown)
        dtype = torch.float64 if maps.dtype == torch.float64 else torch.float32
        radii, r_max, center, affine, points = (
            None if tensor is None else tensor.to(maps.device, dtype) for tensor in lens
        )
        if plan is not None and (plan.device, plan.dtype) != (maps.device, dtype):
            plan = None
        assert radii is not None
        pixels = polar_to_image(
            maps, radii, center, prepared.size,
            affine=affine, points=points, r_max=r_max, plan=plan, layout="tokens",
        )  # fmt: skip
        return pixels.permute(0, 3, 1, 2)

    def check_seen(self, sampled: Tensor, prepared: PreparedPolar, channels: int | None) -> Tensor:
        if self.in_pixels:
            sampled = check_seen_images(sampled, self.map_size, channels)
        else:
            assert channels is not None
            values = self.samples[0] * self.samples[1] * channels
            check_tensor(
                "sampled", sampled, (torch.float32, torch.float64, torch.bfloat16),
                "(B, R, A, S_r·S_φ·C) = (any, {}, {}, {})",
                (None, self.rings, self.sectors, values),
            )  # fmt: skip
        check_count(prepared.grid.radii.shape[0], sampled.shape[0])
        return sampled

    @property
    def map_size(self) -> Pair:
        """What the network sees has this size, (R, A), or (R·S_r, A·S_φ) for an image."""
        if not self.in_pixels:
            return self.rings, self.sectors
        return self.rings * self.samples[0], self.sectors * self.samples[1]

    @property
    def inner_spacing(self) -> Spacing:
        """`sample_spacing`, or `spacing` if that is None."""
        return self.spacing if self.sample_spacing is None else self.sample_spacing

    def grid(self, lens: Lens, image_size: tuple[int, int]) -> PolarGrid:
        """The grid of N lenses. A lens without principal point gets the centre of (H, W).

        Raises:
            ValueError: the spacing is "tan" and a lens has θ_max ≥ 90°.
        """
        steps_r, steps_phi = self._steps(lens)
        rings, last, offsets = self._rings(lens, steps_r), lens.theta_max, None
        azimuths = _azimuths(self.sectors, steps_phi)
        radii, center = rings.radii, lens.center_in(image_size)
        if self.theta_max is not None:
            radii = torch.where(rings.angles > last[:, None], torch.nan, radii)
            last = torch.full_like(last, self.theta_max)
        if not lens.is_radial:
            theta = rings.angles
            if self.theta_max is not None:
                theta = torch.minimum(theta, lens.theta_max[:, None])
            offsets = _offsets(lens, theta, azimuths)
        return PolarGrid(radii, azimuths, center, rings.borders, last, lens.affine, offsets)

    def pixel_grid(self, lens: Lens, image_size: Pair, map_size: Pair | None = None) -> PixelGrid:
        """The way back to images of (H, W) from a polar map, or from one of another size (R', A'),
        whose R' is a multiple of R."""
        rings, sectors = map_size or (self.rings, self.sectors)
        steps = _steps(rings // self.rings, "centers", lens.theta_max)
        radii, r_max = self._rings(lens, steps).radii, lens.r_max
        if self.theta_max is not None:
            end = lens.theta_max.clamp(max=self.theta_max)
            r_max = lens.project(end[:, None])[:, 0]
        # Sides of an odd picture may be exactly at r_max: no rounding decides what is there.
        r_max = r_max * (1 + 16 * torch.finfo(r_max.dtype).eps)  # as `Lens.unproject`
        if lens.is_radial:
            grid = PixelGrid(radii, r_max, lens.center_in(image_size), lens.affine)
        else:
            theta, direction = self._rays or pixel_rays(lens, image_size)
            known = ~theta.isnan()  # NaN would spread to the gradients
            flat = lens.project(torch.where(known, theta, 0.0))[..., None] * direction
            points = torch.where(known[..., None], flat, torch.nan)
            grid = PixelGrid(radii, r_max, points=points)
        # Plans of many lenses would take much memory. A graph has no plan, and must not ask for the
        # number of lenses, which may vary.
        if torch.compiler.is_compiling() or len(lens) != 1:
            return grid
        of_map = radii.new_empty((1, *radii.shape[1:], sectors, 0))
        plan = polar_to_image_plan(
            of_map, radii, grid.center, image_size,
            affine=grid.affine, points=grid.points, r_max=grid.r_max,
        )  # fmt: skip
        return grid._replace(plan=plan)

    def token_rays(self, lens: Lens, map_size: Pair | None = None) -> Tensor:
        """The viewing directions of the tokens of a map: unit vectors (x, y, z), (N, R, A, 3).

        A map of another size than (R, A) has rings of its own, equal steps of the spacing too.

        x points right, y down and z forward. The ray of a token goes through the centre of its ring
        and its sector on the radial curve; other distortions of the lens are ignored.
        """
        rings, sectors = map_size or (self.rings, self.sectors)
        center = _steps(1, "centers", lens.theta_max)
        of_map = Rings(lens, rings, center, self.spacing, self.spacing, self.theta_max)
        return _rays(of_map.angles, _azimuths(sectors, center))

    def border_angles(self, lens: Lens) -> Tensor:
        """θ of the ring borders, (N, R+1) rad."""
        return self._rings(lens, lens.theta_max.new_zeros(1)).border_angles

    def _steps(self, lens: Lens) -> tuple[Tensor, Tensor]:
        """The positions of the samples in a cell, along radius and azimuth."""
        steps_r, steps_phi = (_steps(s, self.placement, lens.theta_max) for s in self.samples)
        return steps_r, steps_phi

    def _rings(self, lens: Lens, steps: Tensor) -> Rings:
        inner = self.inner_spacing
        return Rings(lens, self.rings, steps, self.spacing, inner, self.theta_max)

    def extra_repr(self) -> str:
        return (
            f"rings={self.rings}, sectors={self.sectors}, samples={self.samples}, "
            f"spacing={self.spacing!r}, sample_spacing={self.sample_spacing!r}, "
            f"placement={self.placement!r}, theta_max={self.theta_max}, jitter={self.jitter}, "
            f"layout={self.layout!r}"
        )


@register_view("polar")
def polar_image(size: Pair, **options: Any) -> PolarView:
    """The polar view as an image with a row for each ring, from the centre to θ_max.

    Args:
        size: (R, A). options: the other arguments of `PolarView`.
    """
    return PolarView(*size, samples=(1, 1), layout="image", **options)


def _steps(count: int, placement: Placement, like: Tensor) -> Tensor:
    """The positions of the samples of a cell, as fractions of the cell."""
    steps = torch.arange(count, dtype=like.dtype, device=like.device)
    return steps / (count - 1) if placement == "edges" else (steps + 0.5) / count


def _azimuths(sectors: int, steps: Tensor) -> Tensor:
    """The azimuths at these fractions of each sector, rad."""
    sector = torch.arange(sectors, dtype=steps.dtype, device=steps.device)[:, None]
    return (sector + steps).flatten() * (2 * math.pi / sectors)


def _rays(theta: Tensor, azimuths: Tensor) -> Tensor:
    """The unit vectors (x, y, z) of θ (N, R) and azimuths (A,), (N, R, A, 3)."""
    return vector_of(theta[..., None].expand(-1, -1, len(azimuths)), direction_of(azimuths))


def _offsets(lens: Lens, theta: Tensor, azimuths: Tensor) -> Tensor:
    """The offset of each point from the radial curve of the lens, (N, 2, N_r, N_a) px."""
    theta = theta[:, :, None].expand(-1, -1, len(azimuths))
    direction = direction_of(azimuths)
    offsets = lens.offset(theta, direction.expand(*theta.shape, 2))
    return lens.through_affine(offsets).permute(0, 3, 1, 2)
