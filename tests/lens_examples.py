"""Examples of every lens model. Tests of all models use them; add a new model here."""

import functools
import itertools
import json
import math
from pathlib import Path

import numpy as np
import torch
import yaml

from darswin.lens import (
    MODELS,
    BrownConrady,
    Fisheye624,
    KannalaBrandt,
    Lens,
    Mei,
    Polynomial,
    load,
)
from darswin.lens.files.load import Calibration

f64 = torch.float64
FILES = Path(__file__).parent / "lens" / "files"


def loads(text: str, coefficients: str | None = None, **options) -> Lens:
    """The lens in the text of a calibration file."""
    return Calibration(text, "in a string", coefficients).lens(**options)


def file_text(name: str) -> str:
    """The text of a file in tests/lens/files."""
    return FILES.joinpath(name).read_text()


def double(*values):
    return torch.tensor(values, dtype=f64)


def poses(seed: int, count: int) -> list[np.ndarray]:
    """Random poses (4, 4) of cameras in a rig."""
    rng = np.random.default_rng(seed)
    found = np.tile(np.eye(4), (count, 1, 1))
    turns = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    found[:, :3, :3] = turns * np.linalg.det(turns)[:, None, None]
    found[:, :3, 3] = rng.normal(size=(count, 3))
    return list(found)


# A camera of 1280 × 960 px, and its calibration in the forms of other tools.
K = [[421.3, 0.0, 643.1], [0.0, 420.9, 478.6], [0.0, 0.0, 1.0]]
FISHEYE = [-0.021, 0.0043, -0.0012, 0.00008]
PLUMB_BOB = [-0.22, 0.05, 0.001, -0.002, 0.003]
RATIONAL = [0.2, 0.05, 0.001, -0.002, 0.003, 0.25, 0.04, 0.002]


def opencv(**entries):
    return json.dumps(dict(width=1280, height=960, K=K) | entries)


def flat(*names, **entries):
    """Single numbers. The names are those of coefficients."""
    plane = {"fx": 421.3, "fy": 420.9, "cx": 643.1, "cy": 478.6, "width": 1280, "height": 960}
    return json.dumps(plane | dict(zip(names, itertools.cycle(FISHEYE), strict=False)) | entries)


def message(binning=(0, 0), roi=(0, 0, 0, 0)):
    """A message of ROS."""
    sides = zip(("x_offset", "y_offset", "width", "height"), roi, strict=True)
    return yaml.safe_dump(
        dict(height=960, width=1280, distortion_model="plumb_bob", d=PLUMB_BOB,
             k=np.ravel(K).tolist(), binning_x=binning[0], binning_y=binning[1],
             roi=dict(sides, do_rectify=False))
    )  # fmt: skip


def sized(**entries):
    """A fisheye whose size is given by the entries."""
    return json.dumps(dict(K=K, D=FISHEYE, fisheye=1) | entries)


def _by_name(d, first=1, **plane):
    return {f"k{i}": value for i, value in enumerate(d, first)} | plane


_PINHOLE = dict(camera_model="pinhole", distortion_model="equidistant", resolution=[1280, 960],
                intrinsics=[421.3, 420.9, 643.1, 478.6])  # fmt: skip
NGP = json.loads(file_text("instant_ngp.json"))
# What other cameras of instant-ngp have.
OTHER_CAMERAS = (
    dict(ftheta_p0=0.0, ftheta_p1=0.001, ftheta_p2=0), dict(ftheta_p4="1e-9"), dict(latlong=True),
    dict(equirectangular=1), dict(is_orthographic="True"), dict(isLatLong="yes"),
)  # fmt: skip


def instant_ngp(**entries):
    """A file of instant-ngp with other entries; None leaves an entry out."""
    return json.dumps({name: v for name, v in (NGP | entries).items() if v is not None})


# A camera with the coefficients of a fisheye, in each form that has them.
FISHEYES = {
    "ROS": lambda d: yaml.safe_dump(
        yaml.safe_load(message()) | dict(distortion_model="equidistant", d=d)),
    "matrix": lambda d: opencv(D={"rows": len(d), "cols": 1, "data": d}, fisheye=1),
    "rows": lambda d: opencv(D=[[value] for value in d], fisheye_model=1),
    "text": lambda d: opencv(dist_coeffs=" ".join(map(str, d)), model="equidistant"),
    "Kalibr": lambda d: json.dumps({"cam0": _PINHOLE | dict(distortion_coeffs=d)}),
    "EuRoC": lambda d: json.dumps(_PINHOLE | dict(distortion_coefficients=d)),
    "by name": lambda d: flat(**_by_name(d), model="fisheye"),
    "CamOdoCal": lambda d: json.dumps(dict(
        model_type="KANNALA_BRANDT", image_width=1280, image_height=960,
        projection_parameters=_by_name(d, 2, mu=421.3, mv=420.9, u0=643.1, v0=478.6))),
    "nerfstudio": lambda d: json.dumps(
        _by_name(d, fl_x=421.3, fl_y=420.9, cx=643.6, cy=479.1, w=1280, h=960)
        | dict(camera_model="OPENCV_FISHEYE")),
    "basalt": lambda d: json.dumps(dict(value0=dict(resolution=[[1280, 960]], intrinsics=[dict(
        camera_type="kb4", intrinsics=_by_name(d, fx=421.3, fy=420.9, cx=643.1, cy=478.6))]))),
}  # fmt: skip

FRONT = Polynomial(
    [350.4, -17.5, 27.5, -2.4], math.radians(95), [641.3, 486.1], image_size=(966, 1280)
)

OCAM_INVERSE = (605.752533, 505.883847, 86.351154, 61.948168, 71.032826, 13.486967, 10.437652,
                26.947608, 4.280596, -7.524929, 1.280191, 3.803522, 0.992970)  # fmt: skip


def example(name: str, generator: torch.Generator, focal: tuple[float, float] = (5, 2000)) -> Lens:
    """Four lenses of a model with random parameters, used up to their limit."""

    def uniform(low: float, high: float, *shape: int):
        return low + (high - low) * torch.rand(4, *shape, generator=generator, dtype=f64)

    def rising():
        return torch.nn.functional.pad(uniform(0.01, 0.3, 9).cumsum(1), (1, 0))

    focal = uniform(*focal)
    terms = torch.tensor([0.05, 0.01, 0.005, 0.001], dtype=f64)
    radial = uniform(-1, 1, 4) * terms
    parameters = {
        "FieldOfView": lambda: dict(omega=uniform(0.05, 3.0), focal=focal),
        "Spherical": lambda: dict(xi=uniform(0, 3), focal=focal),
        "EnhancedUnified": lambda: dict(alpha=uniform(0, 1), beta=uniform(0.3, 3), focal=focal),
        "DoubleSphere": lambda: dict(xi=uniform(-0.8, 1.6), alpha=uniform(0, 1), focal=focal),
        "Polynomial": lambda: dict(coefficients=focal[:, None] * torch.cat(
            (torch.ones(4, 1, dtype=f64), uniform(-0.1, 0.1, 3)), 1)),
        "OCam": lambda: dict(coefficients=torch.stack(
            (-focal, 0 * focal, uniform(0.1, 0.5) / focal, uniform(-0.1, 0.1) / focal**2,
             uniform(-0.1, 0.1) / focal**3), 1)),
        "OCamInverse": lambda: dict(
            coefficients=focal[:, None] / 500 * double(*OCAM_INVERSE) * uniform(0.98, 1.02, 1)),
        "KannalaBrandt": lambda: dict(focal=focal, radial=radial),
        "Fisheye624": lambda: dict(focal=focal, radial=radial),
        "Mei": lambda: dict(xi=uniform(0, 3), focal=focal, radial=radial[:, :2]),
        "BrownConrady": lambda: dict(
            focal=focal, radial=radial[:, :3], denominator=uniform(-0.1, 0.1, 3)),
        "Tabulated": lambda: dict(angles=rising(), radii=focal[:, None] * rising()),
    }.get(name, lambda: dict(focal=focal))  # fmt: skip
    return MODELS[name](**parameters())


ASIDE = {
    "Mei": Mei(double(2.35), 1390.0, double(0.032, 2.4), 1.75, double(708.5, 697.0),
               tangential=double(6e-4, -3.5e-3), affine=double(1, 0.001, 0, 0.9994).view(2, 2)),
    "KannalaBrandt": KannalaBrandt(double(300.0), double(0.01, -0.002), 1.8, double(400, 300),
                                   tangential=double(1e-3, -2e-3),
                                   prism=double(1e-3, -1e-4, 2e-3, 1e-4)),
    "Fisheye624": Fisheye624(double(300.0), double(0.01, -0.002, 0, 0, 0, 0), 1.8, double(40, 30),
                             tangential=double(1e-3, -2e-3), prism=double(1e-3, 0, 2e-3, 0)),
    "BrownConrady": BrownConrady(double(500.0), double(-0.1, 0.02), 0.9, double(320, 240),
                                 tangential=double(1e-3, 5e-4), prism=double(1e-3, 0, -1e-3, 0)),
    "affine alone": Polynomial(double(350.4, -17.5, 27.5, -2.4), 1.9, double(641.3, 486.1),
                               affine=double(1.001, -8e-4, 2e-4, 1).view(2, 2)),
}  # fmt: skip

# r, px, at `DEGREES` for files of tests/lens/files and their cameras, computed from the models'
# formulas with 40 digits (mpmath). Only TUM-VI's calibration is of a real camera.
DEGREES = double(10, 30, 45, 60, 75, 85, 90, 95)
TUMVI = (33.336, 100.093, 150.289, 200.445, 249.862, 281.623, 296.876, 311.559)
EUCM = (34.619, 103.857, 155.807, 207.761, 259.431, 293.235, 309.708, 325.715)
OCAM = (50.690, 159.561, 253.544, 360.431, 478.438, 562.226, 605.752, 650.603)
CALIBRATIONS = {
    ("woodscape.json", None): (
        60.767, 182.438, 276.818, 376.441, 483.321, 559.477, 599.200, 640.089),
    ("synwoodscape.json", None): (
        59.860, 179.856, 272.829, 371.134, 477.444, 554.156, 594.590, 636.559),
    ("kitti360_02.yaml", None): (
        72.387, 216.575, 324.265, 432.268, 540.123, 609.270, 641.463, 670.895),
    ("kitti360_03.yaml", None): (
        75.418, 224.754, 335.049, 444.537, 552.149, 619.031, 649.031, 675.367),
    ("kalibr_tumvi.yaml", "cam0"): TUMVI,
    ("camodocal_kb.yaml", None): TUMVI,
    ("basalt.json", "cam0"): EUCM,
    ("kalibr_fov.yaml", "cam1"): EUCM,
    ("kalibr_ds.yaml", None): (
        73.511, 220.677, 331.414, 442.589, 553.504, 626.021, 661.234, 695.292),
    ("basalt.json", "cam1"): (
        74.461, 220.044, 322.610, 415.103, 492.213, 531.685, 546.924, 558.704),
    ("colmap.txt", None): (
        363.169, 1090.529, 1637.383, 2185.502, 2735.760, 3104.577, 3289.572, 3474.684),
    ("ocamcalib.txt", None): OCAM,
    ("camodocal_scaramuzza.yaml", None): OCAM,
}  # fmt: skip


def calibrated(name: str, camera: str | None = None) -> Lens:
    """The lens of a file in tests/lens/files, used up to its limit."""
    return load(FILES / name, camera=camera, dtype=f64).with_theta_max(None)


RANDOM = ("Mei", "KannalaBrandt", "Fisheye624", "BrownConrady", "rational")


@functools.cache
def every_lens() -> dict[str, tuple[Lens, tuple[int, int]]]:
    """A lens of each model and (H, W) of its images; and those of `ASIDE`."""
    found = {}
    for model in sorted(MODELS):
        lens = example(model, torch.manual_seed(3), (140, 160))[0]
        found[model] = lens.with_theta_max(min(0.95 * lens.theta_max.item(), 1.7)), (480, 640)
    for name, lens in ASIDE.items():
        cx, cy = lens.center[0].tolist()
        found[f"{name}, off the curve"] = lens, (round(2 * cy), round(2 * cx))
    return found


def random_lens(name: str, seed: int, aside: float = 1.0, count: int = 8) -> Lens:
    """Lenses with realistic terms, the offset's times `aside`, used up to their limit."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int):
        return low + (high - low) * torch.rand(count, *shape, generator=generator, dtype=f64)

    focal = uniform(200, 2000)
    terms = dict(tangential=aside * uniform(-5e-3, 5e-3, 2))
    if name == "Mei":
        radial = uniform(-1, 1, 2) * double(0.3, 0.5)
        return Mei(uniform(0.5, 3), focal, radial, **terms)
    terms["prism"] = aside * uniform(-1e-2, 1e-2, 4)
    if name == "rational":
        terms["denominator"] = uniform(-0.1, 0.1, 3)
    if name in ("BrownConrady", "rational"):
        return BrownConrady(focal, uniform(-1, 1, 3) * double(0.4, 0.2, 0.1), **terms)
    radial = uniform(-1, 1, 6) * double(0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
    if name == "KannalaBrandt":
        return KannalaBrandt(focal, radial[:, :4], **terms)
    return Fisheye624(focal, 3 * radial, **terms)


# The ranges of parameters for hypothesis: wider than in calibrations.
RANGES = {
    "focal": (0.5, 5000), "xi": (0, 4), "alpha": (0, 1), "beta": (0.05, 5), "omega": (0.02, 3.1),
    "radial": (-0.3, 0.3), "denominator": (-0.2, 0.2), "tangential": (-0.02, 0.02),
    "prism": (-0.02, 0.02),
}  # fmt: skip


def first_coefficients(name: str, size: float) -> tuple[list[float], float]:
    """The leading coefficients of a polynomial lens with a size in px; the unit of the others."""
    first = {
        "OCam": [-size, 0.0],
        "OCamInverse": [size, size / math.pi * 2],
        "Polynomial": [size],
    }[name]
    return first, size / (size**2 if name == "OCam" else 1)


def points_around(theta_max: float, count: int = 200) -> np.ndarray:
    """Unit vectors (count, 3) in the camera's frame, at angles up to θ_max."""
    rng = np.random.default_rng(0)
    theta, phi = rng.uniform(0, theta_max, count), rng.uniform(-math.pi, math.pi, count)
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)


def assert_projects(
    lens: Lens, points: np.ndarray, pixels: np.ndarray | torch.Tensor, atol: float = 1e-9
) -> None:
    """Checks that the lens projects points of the camera's frame, and their rays, to these pixels,
    and the pixels back to directions."""
    lens = lens.with_theta_max(None)
    points, pixels = torch.as_tensor(points), torch.as_tensor(pixels)
    directions = points / points.norm(dim=-1, keepdim=True)
    x, y, z = points.unbind(-1)
    rays = torch.atan2(torch.hypot(x, y), z), torch.atan2(y, x)
    torch.testing.assert_close(lens.project_rays(*rays), pixels, rtol=0, atol=atol)
    torch.testing.assert_close(lens.project_points(3 * points), pixels, rtol=0, atol=atol)
    torch.testing.assert_close(lens.unproject_points(pixels), directions, rtol=0, atol=1e-8)
