"""The polar grid: the rings that a lens's image is cut into, and the samples of each patch.

Rings and samples are each split into equal steps of some function of θ, the *spacing*:

- "theta": θ itself, the paper's text. Works beyond 90°.
- "tan": tan θ, the authors' released code. Only for θ_max < 90°.
- "g": DarSwin-Unet's compromise between the two.
- "radius": r, equal steps in the image; knows nothing of the lens but its image circle.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.inverse import inverse
from darswin.ops.checks import as_int

Spacing = Literal["theta", "tan", "g", "radius"]
Placement = Literal["centers", "edges"]
SPACINGS: tuple[Spacing, ...] = ("theta", "tan", "g", "radius")
PLACEMENTS = ("centers", "edges")

# g(t) = c b t^n + (1 - c) (1 - (1 - t)^m), t = θ/θ_max: constants of the released DarSwin-Unet.
G_M, G_N, G_B, G_C = 2.288135593220339, 5, 8.31578947368421, 1 / 3


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
    if "tan" in (spacing, sample_spacing):
        check_tan(lens)
    theta_max = lens.theta_max[:, None]  # (N, 1)
    fractions = torch.linspace(0, 1, rings + 1, dtype=theta_max.dtype, device=theta_max.device)
    first, last = (_to_spacing(lens, t, spacing) for t in (torch.zeros_like(theta_max), theta_max))
    borders = first + (last - first) * fractions  # (N, R+1), in units of `spacing`
    border_radii = _change(lens, borders, spacing, "radius")
    borders = _change(lens, borders, spacing, sample_spacing)
    inner, outer = borders[:, :-1, None], borders[:, 1:, None]
    steps = _steps(samples[0], placement, theta_max)
    points = (inner + (outer - inner) * steps).flatten(1)  # (N, R·S_r), in units of sample_spacing
    sector = torch.arange(sectors, dtype=theta_max.dtype, device=theta_max.device)[:, None]
    azimuths = (sector + _steps(samples[1], placement, theta_max)).flatten() * (
        2 * math.pi / sectors
    )
    return PolarGrid(
        _change(lens, points, sample_spacing, "radius"),
        azimuths,
        lens.center_in(image_size),
        border_radii,
        lens.affine,
        None if lens.is_radial else _offsets(lens, points, sample_spacing, azimuths),
    )


def _offsets(lens: Lens, points: Tensor, spacing: Spacing, azimuths: Tensor) -> Tensor:
    """(N, 2, N_r, N_a) px: how far from the radial curve the lens lets each point land."""
    theta = _to_theta(lens, points, spacing)[:, :, None].expand(-1, -1, len(azimuths))
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


def check_tan(lens: Lens) -> None:
    """ValueError where tan θ ends before θ_max does. Compiled graphs cannot look at a value, so
    they do not check."""
    if torch.compiler.is_compiling():
        return
    largest = lens.theta_max.max().item() if len(lens) else 0.0
    if largest >= math.pi / 2:
        raise ValueError(
            "spacing='tan' needs lenses with θ_max below 90°, since tan θ ends there; got "
            f"{math.degrees(largest):.1f}°. Use 'theta', 'g' or 'radius'."
        )


def _steps(count: int, placement: Placement, like: Tensor) -> Tensor:
    """Fractions of a cell at which its samples stand."""
    steps = torch.arange(count, dtype=like.dtype, device=like.device)
    return steps / (count - 1) if placement == "edges" else (steps + 0.5) / count


def _change(lens: Lens, value: Tensor, source: Spacing, target: Spacing) -> Tensor:
    """(N, K) from units of one spacing to those of another."""
    if source == target:
        return value
    return _to_spacing(lens, _to_theta(lens, value, source), target)


def _to_spacing(lens: Lens, theta: Tensor, spacing: Spacing) -> Tensor:
    if spacing == "theta":
        return theta
    if spacing == "tan":
        return torch.tan(theta)
    if spacing == "radius":
        return lens.project(theta)
    return _g(theta / lens.theta_max[:, None])


def _to_theta(lens: Lens, value: Tensor, spacing: Spacing) -> Tensor:
    if spacing == "theta":
        return value
    if spacing == "tan":
        return torch.atan(value)
    if spacing == "radius":
        return lens.unproject(value)
    return _inverse_g(value) * lens.theta_max[:, None]


def _g(t: Tensor) -> Tensor:
    """DarSwin-Unet's g of t = θ/θ_max in [0, 1]: rises from 0 to c b + 1 - c."""
    t = t.clamp(max=1)  # rounding must not take (1 - t) below 0
    return G_C * G_B * t**G_N + (1 - G_C) * (1 - (1 - t) ** G_M)


def _inverse_g(value: Tensor) -> Tensor:
    def slope(t: Tensor) -> Tensor:
        return G_C * G_B * G_N * t ** (G_N - 1) + (1 - G_C) * G_M * (1 - t) ** (G_M - 1)

    return inverse(_g, slope, value, value.new_ones(()))
