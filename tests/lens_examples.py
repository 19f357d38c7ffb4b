"""Examples of every lens model: a new model is added here, and all tests of all models run it."""

import math

import numpy as np
import torch

from darswin.lens import (
    BrownConrady,
    DoubleSphere,
    EnhancedUnified,
    Equidistant,
    Equisolid,
    FieldOfView,
    Fisheye624,
    KannalaBrandt,
    Lens,
    Mei,
    OCam,
    OCamInverse,
    Orthographic,
    Perspective,
    Polynomial,
    Spherical,
    Stereographic,
    Tabulated,
)

f64 = torch.float64


def double(*values):
    return torch.tensor(values, dtype=f64)


KODAK_INVERSE = (583.439624, 470.805865, 97.165132, 120.712689, 100.686168, 55.067847, 67.348203,
                 15.186683, 1.492255, 84.459767, 105.607698, 48.090642, 7.785426)  # fmt: skip


def example(name: str, generator: torch.Generator, focal: tuple[float, float] = (5, 2000)) -> Lens:
    """Four lenses of a model with random parameters, used as far as the model goes."""

    def uniform(low: float, high: float, *shape: int):
        return low + (high - low) * torch.rand(4, *shape, generator=generator, dtype=f64)

    focal = uniform(*focal)
    terms = torch.tensor([0.05, 0.01, 0.005, 0.001], dtype=f64)
    radial = uniform(-1, 1, 4) * terms
    return {
        "Perspective": lambda: Perspective(focal),
        "Equidistant": lambda: Equidistant(focal),
        "Equisolid": lambda: Equisolid(focal),
        "Stereographic": lambda: Stereographic(focal),
        "Orthographic": lambda: Orthographic(focal),
        "FieldOfView": lambda: FieldOfView(uniform(0.05, 3.0), focal),
        "Spherical": lambda: Spherical(uniform(0, 3), focal),
        "EnhancedUnified": lambda: EnhancedUnified(uniform(0, 1), uniform(0.3, 3), focal),
        "DoubleSphere": lambda: DoubleSphere(uniform(-0.8, 1.6), uniform(0, 1), focal),
        "Polynomial": lambda: Polynomial(focal[:, None] * torch.cat(
            (torch.ones(4, 1, dtype=f64), uniform(-0.1, 0.1, 3)), 1)),
        "OCam": lambda: OCam(torch.stack(
            (-focal, 0 * focal, uniform(0.1, 0.5) / focal, uniform(-0.1, 0.1) / focal**2,
             uniform(-0.1, 0.1) / focal**3), 1)),
        "OCamInverse": lambda: OCamInverse(
            focal[:, None] / 500 * double(*KODAK_INVERSE) * uniform(0.98, 1.02, 1)),
        "KannalaBrandt": lambda: KannalaBrandt(focal, radial),
        "Fisheye624": lambda: Fisheye624(focal, radial),
        "Mei": lambda: Mei(uniform(0, 3), focal, radial[:, :2]),
        "BrownConrady": lambda: BrownConrady(
            focal, radial[:, :3], denominator=uniform(-0.1, 0.1, 3)),
        "Tabulated": lambda: Tabulated(
            torch.nn.functional.pad(uniform(0.01, 0.3, 9).cumsum(1), (1, 0)),
            focal[:, None] * torch.nn.functional.pad(uniform(0.01, 0.3, 9).cumsum(1), (1, 0))),
    }[name]()  # fmt: skip


ASIDE = {
    "Mei": Mei(double(2.2134), 1336.3, double(0.0168, 1.6549), 1.75, double(716.9, 705.8),
               tangential=double(4.2e-4, 4.2e-3), affine=double(1, 0.001, 0, 0.9996).view(2, 2)),
    "KannalaBrandt": KannalaBrandt(double(300.0), double(0.01, -0.002), 1.8, double(400, 300),
                                   tangential=double(1e-3, -2e-3),
                                   prism=double(1e-3, -1e-4, 2e-3, 1e-4)),
    "Fisheye624": Fisheye624(double(300.0), double(0.01, -0.002, 0, 0, 0, 0), 1.8, double(40, 30),
                             tangential=double(1e-3, -2e-3), prism=double(1e-3, 0, 2e-3, 0)),
    "BrownConrady": BrownConrady(double(500.0), double(-0.1, 0.02), 0.9, double(320, 240),
                                 tangential=double(1e-3, 5e-4), prism=double(1e-3, 0, -1e-3, 0)),
    "affine alone": Polynomial(double(339.749, -31.988, 48.275, -7.201), 1.9, double(643.4, 479.4),
                               affine=double(1.001, -8e-4, 2e-4, 1).view(2, 2)),
}  # fmt: skip

# Public calibrations, and r in px at 10, 30, 45, 60, 75, 85, 90 and 95°.
CALIBRATIONS = {
    "WoodScape front": (
        Polynomial(double(339.749, -31.988, 48.275, -7.201)),
        (58.573, 175.511, 267.754, 367.484, 477.055, 556.367, 598.013, 641.012)),
    "SynWoodScape front": (
        Polynomial(double(341.725, -26.4448, 32.7864, 0.50499)),
        (59.012, 176.421, 268.154, 367.112, 477.025, 558.253, 601.678, 647.167)),
    "KITTI-360 image_02": (
        Mei(double(2.2134047507854890), 1336.3220825849971,
            double(0.016798235660113681, 1.6548773243373522)),
        (72.561, 217.321, 325.705, 434.562, 543.590, 614.149, 647.437, 678.331)),
    "KITTI-360 image_03": (
        Mei(double(2.5535139132482758), 1485.4388981875156,
            double(0.049370396274089505, 4.5068455478645308)),
        (72.911, 217.875, 326.095, 435.253, 545.159, 615.474, 647.793, 676.794)),
    "TUM-VI Kalibr": (
        KannalaBrandt(double(190.97847715128717), double(
            .0034823894022493434, .0007150348452162257, -.0020532361418706202,
            .00020293673591811182)),
        (33.336, 100.093, 150.289, 200.445, 249.862, 281.623, 296.876, 311.559)),
    "TUM-VI basalt": (
        EnhancedUnified(double(.6291060871161842), 1.0418067403139693, 191.14799816648748),
        (33.367, 100.226, 150.530, 200.814, 250.436, 282.377, 297.682, 312.319)),
    "Kalibr ds": (
        DoubleSphere(double(-0.19963086), 0.592459, 317.55256),
        (69.238, 207.505, 310.799, 413.247, 513.388, 577.148, 607.417, 636.127)),
    "basalt ds": (
        DoubleSphere(double(-0.075347), 0.743925, 402.5),
        (75.832, 224.005, 328.202, 421.858, 499.463, 538.813, 553.844, 565.320)),
    "COLMAP": (
        KannalaBrandt(double(2134.23762), double(.00372, -.00331, .00167, -.00032)),
        (372.536, 1118.382, 1678.541, 2239.077, 2800.133, 3173.961, 3360.005, 3544.469)),
    "OCam kodak": (
        OCamInverse(double(*KODAK_INVERSE)),
        (47.875, 153.327, 247.086, 352.748, 465.102, 543.019, 583.440, 625.352)),
}  # fmt: skip

# For hypothesis: parameters as calibrations have them, and further out.
RANGES = {
    "focal": (0.5, 5000), "xi": (0, 4), "alpha": (0, 1), "beta": (0.05, 5), "omega": (0.02, 3.1),
    "radial": (-0.3, 0.3), "denominator": (-0.2, 0.2), "tangential": (-0.02, 0.02),
    "prism": (-0.02, 0.02),
}  # fmt: skip
# How many numbers a list has, where the model says it.
COUNTS = {"tangential": 2, "prism": 4}


def first_coefficients(name: str, size: float) -> tuple[list[float], float]:
    """The largest coefficients of a polynomial lens of a size in px, and the unit of the others."""
    first = {
        "OCam": [-size, 0.0],
        "OCamInverse": [size, size / math.pi * 2],
        "Polynomial": [size],
    }[name]
    return first, size / (size**2 if name == "OCam" else 1)


def points_around(theta_max: float, count: int = 200) -> np.ndarray:
    """Unit vectors (count, 3) up to θ_max from the axis, in the camera's frame."""
    rng = np.random.default_rng(0)
    theta, phi = rng.uniform(0, theta_max, count), rng.uniform(-math.pi, math.pi, count)
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)


def assert_projects(
    lens: Lens, points: np.ndarray, pixels: np.ndarray | torch.Tensor, atol: float = 1e-9
) -> None:
    """The lens takes points of the camera's frame to these pixels, as points and as rays, and the
    pixels back to directions."""
    lens = lens.with_theta_max(None)
    points, pixels = torch.as_tensor(points), torch.as_tensor(pixels)
    directions = points / points.norm(dim=-1, keepdim=True)
    x, y, z = points.unbind(-1)
    rays = torch.atan2(torch.hypot(x, y), z), torch.atan2(y, x)
    torch.testing.assert_close(lens.project_rays(*rays), pixels, rtol=0, atol=atol)
    torch.testing.assert_close(lens.project_points(3 * points), pixels, rtol=0, atol=atol)
    torch.testing.assert_close(lens.unproject_points(pixels), directions, rtol=0, atol=1e-8)
