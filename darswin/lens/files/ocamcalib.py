"""OCamCalib's calib_results.txt: two polynomials, the center, an affine matrix, the image size."""

from darswin.lens.files.cameras import Description, in_image
from darswin.lens.files.content import Content
from darswin.lens.files.fields import is_number, short, to_number, to_side
from darswin.lens.polynomial import OCam, OCamInverse

BLOCKS = (
    "the direct polynomial", "the inverse polynomial", "the center (row and column)",
    "the affine parameters (c, d, e)", "the image size (height and width)",
)  # fmt: skip


def fits(content: Content) -> bool:
    return isinstance(content, list) and (len(content[0]) < 2 or is_number(content[0][1]))


def cameras(rows: list[list[str]]) -> dict[str, Description]:
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
    model, coefficients = (OCamInverse, inverse) if inverse else (OCam, direct)
    affine = [[1.0, e], [d, c]]
    size = (height, width)
    return {"camera": in_image(model, (column, row), affine, size, coefficients=coefficients)}


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
