"""The polar grid: the rings that a lens's image is cut into, and the samples of each patch; and
what brings a polar map back to pixels.

Rings and samples are each split into equal steps of a *spacing*, see `darswin.lens.spacing`.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import pixel_rays
from darswin.lens.spacing import SPACINGS, Spacing, change_spacing, check_tan, span, to_theta
from darswin.ops.checks import as_int

Placement = Literal["centers", "edges"]
PLACEMENTS = ("centers", "edges")


class PolarGrid(NamedTuple):
    """What `polar_sample` needs of a lens, and the borders of its rings.

    Shapes: radii (N, R·S_r) px, azimuths (A·S_φ,) rad, center (N or 1, 2) px, borders (N, R+1) px;
    for general lenses also affine (N or 1, 2, 2) and offsets (N or 1, 2, R·S_r, A·S_φ) px.
    """

    radii: Tensor
    azimuths: Tensor
    center: Tensor
    borders: Tensor
    affine: Tensor | None = None
    offsets: Tensor | None = None


def polar_grid(
    lens: Lens,
    image_size: tuple[int, int],
    *,
    rings: int,
    sectors: int,
    samples: tuple[int, int],
    spacing: Spacing = "theta",
    sample_spacing: Spacing | None = None,
    placement: Placement = "centers",
) -> PolarGrid:
    """Cuts the image of each lens into R rings × A sectors and places S_r × S_φ samples in each.

    Convention:
        Ring 0 is the innermost and ring R-1 ends at θ_max. Sector a covers azimuths from 2πa/A to
        2π(a+1)/A; azimuth 0 points right, π/2 down.

    Args:
        lens: N lenses. image_size: (H, W), only for the principal point of a lens that has none.
        rings: R. sectors: A. samples: (S_r, S_φ).
        spacing: what the ring borders split equally.
        sample_spacing: what the samples inside a ring split equally; None means `spacing`.
        placement: "centers" of equal cells, or "edges": from border to border, both included.

    Raises:
        ValueError: an unknown name, a size below 1, "edges" with one sample along an axis, or
            "tan" with a lens of θ_max ≥ 90°.

    Source: DarSwin, ICCV 2023, sec. 4.2 and 4.3.
    """
    sample_spacing = spacing if sample_spacing is None else sample_spacing
    check_grid(rings, sectors, samples, spacing, sample_spacing, placement)
    borders, points = _rings(lens, rings, samples[0], spacing, sample_spacing, placement)
    theta_max = lens.theta_max
    sector = torch.arange(sectors, dtype=theta_max.dtype, device=theta_max.device)[:, None]
    azimuths = (sector + _steps(samples[1], placement, theta_max)).flatten() * (
        2 * math.pi / sectors
    )
    return PolarGrid(
        change_spacing(lens, points, sample_spacing, "radius"),
        azimuths,
        lens.center_in(image_size),
        change_spacing(lens, borders, spacing, "radius"),
        lens.affine,
        None if lens.is_radial else _offsets(lens, points, sample_spacing, azimuths),
    )


class PixelGrid(NamedTuple):
    """What `polar_to_image` needs of a lens to bring back a polar map, by its names.

    Shapes: radii (N, R) px, of the rings' centres; r_max (N,) px; for radial lenses center
    (N or 1, 2) px and affine (N, 2, 2), for general ones points (N, H, W, 2) px.
    """

    radii: Tensor
    r_max: Tensor
    center: Tensor | None = None
    affine: Tensor | None = None
    points: Tensor | None = None


def pixel_grid(
    lens: Lens,
    image_size: tuple[int, int],
    *,
    rings: int,
    split: int = 1,
    spacing: Spacing = "theta",
    sample_spacing: Spacing | None = None,
) -> PixelGrid:
    """The way back from the rings of `polar_grid`, each of them split into several.

    Args:
        lens: N lenses. image_size: (H, W). rings: as many as `polar_grid` was given.
        split: how many rings of the map a ring of `polar_grid` became.
        spacing, sample_spacing: as `polar_grid`; the latter splits a ring.

    Raises:
        ValueError: an unknown spacing, a size below 1, or "tan" with a lens of θ_max ≥ 90°.
    """
    sample_spacing = spacing if sample_spacing is None else sample_spacing
    check_grid(rings, 1, (split, 1), spacing, sample_spacing, "centers")
    _, centers = _rings(lens, rings, split, spacing, sample_spacing, "centers")
    radii = change_spacing(lens, centers, sample_spacing, "radius")
    if lens.is_radial:
        return PixelGrid(radii, lens.r_max, lens.center_in(image_size), lens.affine)
    theta, direction = pixel_rays(lens, image_size)
    seen = ~theta.isnan()  # NaN must not meet the gradients
    flat = lens.project(torch.where(seen, theta, 0.0))[..., None] * direction
    return PixelGrid(radii, lens.r_max, points=torch.where(seen[..., None], flat, torch.nan))


def token_rays(lens: Lens, *, rings: int, sectors: int, spacing: Spacing = "theta") -> Tensor:
    """Where the tokens of a polar map look: (N, R, A, 3), unit vectors x, y, z of the camera.

    Convention:
        x to the right, y down, z forward, as `Lens.unproject_points`; a token's ray is that of the
        middle of its ring and its sector on the radial curve, whatever offsets the lens has.

    Args:
        lens: N lenses. rings: R. sectors: A. spacing: as `polar_grid`.

    Raises:
        ValueError: an unknown spacing, a size below 1, or "tan" with a lens of θ_max ≥ 90°.
    """
    check_grid(rings, sectors, (1, 1), spacing, spacing, "centers")
    _, centers = _rings(lens, rings, 1, spacing, spacing, "centers")
    theta = change_spacing(lens, centers, spacing, "theta")[..., None]
    sector = torch.arange(sectors, dtype=theta.dtype, device=theta.device)
    azimuth = (sector + 0.5) * (2 * math.pi / sectors)
    aside, forward = torch.sin(theta), torch.cos(theta).expand(-1, -1, sectors)
    return torch.stack((aside * torch.cos(azimuth), aside * torch.sin(azimuth), forward), -1)


def _rings(
    lens: Lens,
    rings: int,
    samples: int,
    spacing: Spacing,
    sample_spacing: Spacing,
    placement: Placement,
) -> tuple[Tensor, Tensor]:
    """Ring borders (N, R+1) in units of `spacing`; samples (N, R·S_r) in those of the other."""
    if "tan" in (spacing, sample_spacing):
        check_tan(lens)
    theta_max = lens.theta_max
    fractions = torch.linspace(0, 1, rings + 1, dtype=theta_max.dtype, device=theta_max.device)
    first, last = span(lens, spacing)
    borders = first + (last - first) * fractions
    edges = change_spacing(lens, borders, spacing, sample_spacing)
    inner, outer = edges[:, :-1, None], edges[:, 1:, None]
    steps = _steps(samples, placement, theta_max)
    return borders, (inner + (outer - inner) * steps).flatten(1)


def _offsets(lens: Lens, points: Tensor, spacing: Spacing, azimuths: Tensor) -> Tensor:
    """(N, 2, N_r, N_a) px: how far from the radial curve the lens lets each point land."""
    theta = to_theta(lens, points, spacing)[:, :, None].expand(-1, -1, len(azimuths))
    direction = torch.stack((torch.cos(azimuths), torch.sin(azimuths)), -1)
    offsets = lens.offset(theta, direction.expand(*theta.shape, 2))
    return lens.through_affine(offsets).permute(0, 3, 1, 2)


def check_grid(
    rings: int,
    sectors: int,
    samples: tuple[int, int],
    spacing: str,
    sample_spacing: str,
    placement: str,
) -> None:
    """ValueError where the settings of a grid make none."""
    for name, value in (("rings", rings), ("sectors", sectors)):
        if (as_int(value) or 0) < 1:
            raise ValueError(f"{name} must be an int of at least 1, got {value!r}")
    if len(samples) != 2 or any((as_int(s) or 0) < 1 for s in samples):
        raise ValueError(f"samples must be (S_r, S_φ), ints of at least 1, got {samples!r}")
    for name, choice in (("spacing", spacing), ("sample_spacing", sample_spacing)):
        if choice not in SPACINGS:
            raise ValueError(f"{name} must be one of {SPACINGS}, got {choice!r}")
    if placement not in PLACEMENTS:
        raise ValueError(f"placement must be one of {PLACEMENTS}, got {placement!r}")
    if placement == "edges" and min(samples) < 2:
        raise ValueError(f"placement='edges' needs at least 2 samples an axis, got {samples!r}")


def _steps(count: int, placement: Placement, like: Tensor) -> Tensor:
    """Fractions of a cell at which its samples stand."""
    steps = torch.arange(count, dtype=like.dtype, device=like.device)
    return steps / (count - 1) if placement == "edges" else (steps + 0.5) / count
