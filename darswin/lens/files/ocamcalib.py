"""OCamCalib's calib_results.txt: two polynomials, the center, an affine matrix, the image size."""

import math

from darswin.lens.files.cameras import Cameras, Description, in_image
from darswin.lens.files.content import Content
from darswin.lens.files.fields import is_number, short, to_number, to_side
from darswin.lens.polynomial import OCam, OCamInverse

BLOCKS = (
    "the direct polynomial", "the inverse polynomial", "the center (row and column)",
    "the affine parameters (c, d, e)", "the image size (height and width)",
)  # fmt: skip

MOST_APART = 1.0  # px


def fits(content: Content) -> bool:
    """Whether a file's content is OCamCalib's: rows of numbers."""
    return isinstance(content, list) and (len(content[0]) < 2 or is_number(content[0][1]))


def cameras(rows: list[list[str]]) -> Cameras:
    """Its one camera."""
    return {"camera": lambda: _camera(rows)}


def _camera(rows: list[list[str]]) -> Description:
    names = BLOCKS if len(rows) != len(BLOCKS) - 1 else (BLOCKS[0], *BLOCKS[2:])
    if len(rows) != len(names):
        raise ValueError(
            f"it must have {len(BLOCKS)} lines of numbers, {', '.join(BLOCKS)}; got {len(rows)}"
        )
    block = dict(zip(names, rows, strict=True))
    direct = _polynomial(block, BLOCKS[0])
    inverse = _polynomial(block, BLOCKS[1]) if BLOCKS[1] in block else []
    row, column = _numbers(block, BLOCKS[2], 2)
    c, d, e = _numbers(block, BLOCKS[3], 3)
    height, width = (to_side(word, BLOCKS[4]) for word in _words(block, BLOCKS[4], 2))
    # Its x' is down and its y' to the right: row = c x' + d y' + …, column = e x' + y' + ….
    affine, size = [[1.0, e], [d, c]], (height, width)
    if not inverse:
        return in_image(OCam, (column, row), affine, size, {"coefficients": direct})
    check_inverse(direct, inverse, size)
    return in_image(OCamInverse, (column, row), affine, size, {"coefficients": inverse})


def check_inverse(direct: list[float], inverse: list[float], size: tuple[int, int]) -> None:
    """That two polynomials are of one lens, up to half the diagonal of an image of (H, W).

    The toolbox fits the inverse to some hundredths of a pixel.

    Raises:
        ValueError: they differ by more than `MOST_APART` px.
    """
    reach, last = math.hypot(*size) / 2, -1.0
    for step in range(257):
        radius = reach * step / 256
        theta = math.atan2(radius, -_value(direct, radius))
        if theta <= last:
            return  # no ray lands beyond
        last = theta
        found = _value(inverse, theta - math.pi / 2)
        if not abs(found - radius) <= MOST_APART:
            raise ValueError(
                f"the inverse polynomial must give back the direct one's radii to {MOST_APART:g} "
                f"px, got {found:.6g} px for {radius:.6g} px; the file without the inverse "
                "polynomial means the direct one"
            )


def _value(coefficients: list[float], x: float) -> float:
    value = 0.0
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value


def _words(block: dict[str, list[str]], name: str, count: int) -> list[str]:
    if len(block[name]) != count:
        raise ValueError(f"{name} must be {count} numbers, got {short(block[name])}")
    return block[name]


def _numbers(block: dict[str, list[str]], name: str, count: int) -> list[float]:
    return [to_number(word, name, f"{count} numbers") for word in _words(block, name, count)]


def _polynomial(block: dict[str, list[str]], name: str) -> list[float]:
    """Their number, then the coefficients."""
    count, *words = block[name]
    if count != str(len(words)) or len(words) > 64:
        raise ValueError(
            f"{name} must be the number of its coefficients, 64 at most, and these, got "
            f"{short(count)} and {len(words)} of them"
        )
    return [to_number(word, name, "finite numbers") for word in words]
