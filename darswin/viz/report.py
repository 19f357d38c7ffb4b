"""Descriptions of lenses: field of view, pixels per degree, and the best spacing."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.lens.base import MARGIN, Lens
from darswin.lens.solve import direction_of
from darswin.lens.spacing import SPACINGS, Spacing
from darswin.utils.words import in_px
from darswin.views import PolarView
from darswin.views.directions import sides

__all__ = ["describe"]

SIDES = ("left", "top", "right", "bottom")


def pixels_per_degree(lens: Lens, theta: Tensor) -> tuple[Tensor, Tensor]:
    """The pixels per degree of one lens at θ (rad), before `affine`: along the radius, dr/dθ, and
    around the axis, r / sin θ."""
    theta = theta.detach().clone().requires_grad_()
    lens = lens.detach()
    with torch.enable_grad():
        radius = lens.project(theta)
        (along,) = torch.autograd.grad(radius.sum(), theta)
    theta, radius = theta.detach(), radius.detach()
    around = torch.where(theta == 0, along, radius / torch.sin(theta))
    return along * math.pi / 180, around * math.pi / 180


def largest_offset(lens: Lens) -> float:
    """The largest offset (px) by tangential and thin-prism terms up to θ_max."""
    theta = lens.theta_max * torch.linspace(0, 1, 129).to(lens.theta_max)[:, None]
    azimuth = torch.linspace(0, 2 * math.pi, 181).to(theta)
    direction = direction_of(azimuth)
    return lens.through_affine(lens.offset(theta, direction)).norm(dim=-1).max().item()


def beyond_lens(lens: Lens, image_size: tuple[int, int]) -> Tensor:
    """True for each side of the image that lies beyond the lens: (4,), in the order of SIDES."""
    return lens.side_angles(image_size)[0] >= lens.with_theta_max(None).theta_max


def outside_share(lens: Lens, image_size: tuple[int, int]) -> float:
    """The fraction of rays up to θ_max, in equal steps of θ and φ, that miss the image."""
    steps = (torch.arange(128, dtype=torch.float64) + 0.5) / 128
    pixels = lens.project_rays(lens.theta_max * steps[:, None], 2 * math.pi * steps, image_size)
    last = pixels.new_tensor(image_size).flip(0) - 0.5
    return 1 - ((pixels >= -0.5) & (pixels <= last)).all(-1).double().mean().item()


class Patches(NamedTuple):
    """The smallest and largest ring width (px), and area of a patch (px²)."""

    width: tuple[float, float]
    area: tuple[float, float]
    ratio: float  # the area of the largest patch over the smallest


def patches(lens: Lens, spacing: Spacing, rings: int, sectors: int) -> Patches:
    """The sizes of the patches of one lens's partition."""
    grid = PolarView(rings=rings, sectors=sectors, samples=(1, 1), spacing=spacing).grid(
        lens, (1, 1)
    )
    borders = grid.borders[0]
    stretch = 1.0 if lens.affine is None else lens.affine[0].det().abs().item()
    # Relative to a circle of radius 1: the squares of lengths in pixels may overflow.
    shares = ((borders / borders[-1]) ** 2).diff() * (math.pi / sectors * stretch)
    areas = shares * borders[-1] ** 2
    width, area, share = ((v.min().item(), v.max().item()) for v in (borders.diff(), areas, shares))
    return Patches(width, area, share[1] / share[0])


def best_spacing(lens: Lens, rings: int, sectors: int) -> Spacing:
    """The spacing, "radius" excluded, whose patches have the most equal areas in pixels."""
    usable = [s for s in SPACINGS if s != "radius" and _usable(lens, s)]
    return min(usable, key=lambda spacing: patches(lens, spacing, rings, sectors).ratio)


def describe(
    lens: Lens, image_size: tuple[int, int] | None = None, *, rings: int = 16, sectors: int = 64
) -> str:
    """Describes a lens in about twenty lines of text.

    Args:
        lens: one lens. image_size: (H, W); None means the lens's own.
        rings, sectors: of the partition, for the sizes of its patches.

    Raises:
        ValueError: more than one lens, or no image_size.
    """
    if len(lens) != 1:
        raise ValueError(f"describe takes one lens, got {len(lens)}")
    lens = lens.detach().to("cpu", torch.float64)
    if image_size is None:
        if lens.image_size is None:
            raise ValueError("the lens has no image size: give image_size, (H, W)")
        height, width = (round(side) for side in lens.image_size[0].tolist())
        image_size = height, width
    rows = _model(lens, image_size) + _view(lens, image_size)
    rows += _density(lens) + _spacings(lens, rings, sectors)
    return "\n".join(f"{name:<16}{text}".rstrip() for name, text in rows)


def _model(lens: Lens, image_size: tuple[int, int]) -> list[tuple[str, str]]:
    names = lens.parameters + lens.optional
    values = {name: getattr(lens, name) for name in names if getattr(lens, name) is not None}
    cx, cy = lens.center_in(image_size)[0].tolist()
    rows = [("model", type(lens).__name__)]
    rows += [(f"  {name}", _numbers(value[0])) for name, value in values.items()]
    rows += [
        ("image", f"{in_px(image_size)}"),
        (
            "principal point",
            f"x {cx:.2f}, y {cy:.2f} px (pixel centres are integers)"
            f"{', outside the sensor' if _is_outside(lens, image_size) else ''}",
        ),
    ]
    if lens.affine is not None:
        a, b, c, d = lens.affine[0].flatten().tolist()
        rows.append(("affine", f"[[{a:.6g}, {b:.6g}], [{c:.6g}, {d:.6g}]]"))
    if not lens.is_radial:
        offset = f"{largest_offset(lens):.2f} px at most, by tangential and thin-prism terms"
        rows.append(("off the curve", offset))
    return rows


def _is_outside(lens: Lens, image_size: tuple[int, int]) -> bool:
    # The principal point is not in the image.
    return bool((sides(lens, image_size) < 0).any())


def _view(lens: Lens, image_size: tuple[int, int]) -> list[tuple[str, str]]:
    angles, last = sides(lens, image_size), lens.theta_max.item()
    left, top, right, bottom = angles.clamp(-last, last).tolist()  # beyond θ_max nothing is used
    ends = zip(SIDES, angles.tolist(), beyond_lens(lens, image_size).tolist(), strict=True)
    corners = _corners(lens, image_size)
    if _is_outside(lens, image_size):
        corners = "on the row and the column of the principal point"
    share = outside_share(lens, image_size)
    return [
        ("field of view", f"{_degrees(left + right)} across, {_degrees(top + bottom)} down, "
                          f"{corners}"),
        ("θ at the sides", ", ".join(
            f"{side}: the lens ends before" if beyond else f"{side} {_degrees(angle)}"
            + " (beyond θ_max)" * (angle > last + MARGIN) for side, angle, beyond in ends)),
        ("θ limit", f"{_both(lens.theta_limit)}: r rises up to here"),
        ("θ_max", f"{_both(lens.theta_max)}: the rings end here, r = {lens.r_max.item():.1f} px"),
        ("outside sensor", f"{share:.1%} of the samples up to θ_max, with equal steps of θ"),
    ]  # fmt: skip


def _corners(lens: Lens, image_size: tuple[int, int]) -> str:
    height, width = image_size
    pixels = torch.tensor([[x, y] for y in (-0.5, height - 0.5) for x in (-0.5, width - 0.5)])
    widest = lens.with_theta_max(None).theta_and_direction(pixels, image_size)[0].tolist()
    if math.isnan(sum(widest)):
        return "the lens ends before the corners"
    beyond = " (beyond θ_max)" * (max(widest) > lens.theta_max.item() + MARGIN)
    across = max(widest[0] + widest[3], widest[1] + widest[2])
    return f"{_degrees(across)} between the corners{beyond}"


def _density(lens: Lens) -> list[tuple[str, str]]:
    end = math.degrees(lens.theta_max.item())
    degrees = torch.arange(0, end, 15, dtype=torch.float64)
    degrees = torch.cat((degrees[end - degrees > 5], degrees.new_tensor([end])))
    theta = torch.deg2rad(degrees).clamp(max=lens.theta_max.item())
    rows = [("θ (°)", degrees, 1), ("r (px)", lens.project(theta), 1)]
    density = pixels_per_degree(lens, theta)
    rows += list(zip(("px/° along r", "px/° around"), density, (2, 2), strict=True))
    return [("", "")] + [
        (name, "".join(f"{value:>8.{digits}f}" for value in values.tolist()))
        for name, values, digits in rows
    ]


def _spacings(lens: Lens, rings: int, sectors: int) -> list[tuple[str, str]]:
    rows = [
        ("", ""),
        ("spacing", f"ring width (px)   px per token   for {rings} × {sectors} tokens"),
    ]
    best = best_spacing(lens, rings, sectors)
    for spacing in SPACINGS:
        if not _usable(lens, spacing):
            rows.append((f"  {spacing}", "impossible for this θ_max: tan θ ends at 90°"))
            continue
        found = patches(lens, spacing, rings, sectors)
        width, area = (f"{low:.1f} to {high:.1f}" for low, high in found[:2])
        note = "  ignores the lens" if spacing == "radius" else ""
        note += "  <- most equal" if spacing == best else ""
        rows.append((f"  {spacing}", f"{width:<18}{area:<18}1 : {found.ratio:.0f}{note}"))
    return rows


def _usable(lens: Lens, spacing: Spacing) -> bool:
    return spacing != "tan" or lens.theta_max.item() < math.pi / 2


def _numbers(values: Tensor) -> str:
    return ", ".join(f"{value:.7g}" for value in values.reshape(-1).tolist())


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.2f}°"


def _both(angle: Tensor) -> str:
    return f"{_degrees(angle.item())} ({angle.item():.5f} rad)"
