"""CamOdoCal's YAML, which KITTI-360 and VINS use: MEI, KANNALA_BRANDT, PINHOLE and SCARAMUZZA."""

from collections.abc import Mapping
from functools import partial

from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.cameras import Cameras, Description, describe, in_image
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields
from darswin.lens.files.ocamcalib import check_inverse
from darswin.lens.polynomial import OCam, OCamInverse

Plane = tuple[tuple[float, float], tuple[float, float]]  # focal lengths, principal point
MODELS = ("MEI", "KANNALA_BRANDT", "PINHOLE", "SCARAMUZZA")


def fits(content: Content) -> bool:
    """Whether a file's content is CamOdoCal's: it has a model type, or parameters of one."""
    keys = ("model_type", "mirror_parameters", "projection_parameters")
    return isinstance(content, Mapping) and any(key in content for key in keys)


def cameras(file: Fields) -> Cameras:
    """Its one camera, by its name if it has one."""
    return {file.text("camera_name") if "camera_name" in file else "camera": partial(_camera, file)}


def _camera(file: Fields) -> Description:
    said = file.text("model_type", f"one of {', '.join(MODELS)}")
    model = said.upper()
    size = (file.side("image_height"), file.side("image_width"))
    if model == "SCARAMUZZA":
        description = _scaramuzza(file, size)
    elif model == "KANNALA_BRANDT":
        projection = file.section("projection_parameters")
        radial = [projection.number(f"k{i}") for i in (2, 3, 4, 5)]
        plane = _plane(projection, "mu", "mv", "u0", "v0")
        description = describe(KannalaBrandt, *plane, size, {"radial": radial})
    elif model == "PINHOLE":
        plane = _plane(file.section("projection_parameters"), "fx", "fy", "cx", "cy")
        description = describe(BrownConrady, *plane, size, _distortion(file))
    elif model == "MEI":
        plane = _plane(file.section("projection_parameters"), "gamma1", "gamma2", "u0", "v0")
        mirror = file.section("mirror_parameters")
        xi = mirror.number("xi")
        mirror.check_all_read(model)
        description = describe(Mei, *plane, size, {"xi": xi, **_distortion(file)})
    else:
        raise ValueError(f"model_type must be one of {', '.join(MODELS)}, got {said!r}")
    # Other mappings are matrices: where the camera stands.
    file.check_all_read(
        model, like=lambda _, value: isinstance(value, Mapping) and "data" not in value
    )
    return description


def _plane(fields: Fields, fx: str, fy: str, cx: str, cy: str) -> Plane:
    plane = (fields.positive(fx), fields.positive(fy)), (fields.number(cx), fields.number(cy))
    fields.check_all_read("this camera")
    return plane


def _distortion(file: Fields) -> dict[str, list[float]]:
    fields = file.section("distortion_parameters")
    k1, k2, p1, p2 = (fields.number(name) for name in ("k1", "k2", "p1", "p2"))
    fields.check_all_read("this camera")
    return {"radial": [k1, k2], "tangential": [p1, p2]}


def _scaramuzza(file: Fields, size: tuple[int, int]) -> Description:
    """OCamCalib's polynomials, whose axis may point either way: a₀ tells."""
    affine = file.section("affine_parameters")
    center = (affine.number("cx"), affine.number("cy"))
    matrix = [[affine.number("ac"), affine.number("ad")], [affine.number("ae"), 1.0]]
    affine.check_all_read("SCARAMUZZA")
    direct = _polynomial(file.section("poly_parameters"))
    backwards = direct[0] > 0
    if backwards:
        direct = [-c for c in direct]
    inverse = file.section("inv_poly_parameters") if "inv_poly_parameters" in file else None
    if inverse is not None and any(coefficients := _polynomial(inverse)):
        if backwards:
            coefficients = [c * (-1) ** i for i, c in enumerate(coefficients)]
        check_inverse(direct, coefficients, size)
        return in_image(OCamInverse, center, matrix, size, {"coefficients": coefficients})
    return in_image(OCam, center, matrix, size, {"coefficients": direct})


def _polynomial(fields: Fields) -> list[float]:
    """p0, p1, … as far as they go."""
    count = 1
    while count < 64 and f"p{count}" in fields:
        count += 1
    coefficients = [fields.number(f"p{i}") for i in range(count)]
    fields.check_all_read("SCARAMUZZA")
    return coefficients
