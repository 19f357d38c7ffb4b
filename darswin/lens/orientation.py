"""The lens of a picture that was turned: upright, as its EXIF orientation says, or by any angle.

A calibration is of pixels as the camera stores them; pictures are read upright.
"""

import math

import torch
from torch import Tensor

from darswin.lens.base import Lens
from darswin.utils.exif import TURNS


def stored_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """(H, W) of a picture as stored, from that of the upright one."""
    return size[::-1] if TURNS[orientation][0] else size


def in_upright_picture(lens: Lens, size: tuple[int, int], orientation: int) -> Lens:
    """The lens, with an image_size, in an upright picture of (H, W) that shows all that it was
    calibrated with. The calibration was made upright if only so it has the picture's shape.

    `orientation` is EXIF's, 1 to 8, before. ValueError for a picture of another shape.
    """
    try:
        return upright(lens.in_picture(stored_size(size, orientation)), orientation)
    except ValueError as error:
        try:
            return lens.in_picture(size)
        except ValueError:
            turn = (
                "" if orientation == 1 else f" (as stored; its EXIF orientation is {orientation})"
            )
            raise ValueError(f"{error}{turn}") from error


def upright(lens: Lens, orientation: int) -> Lens:
    """The lens of the upright picture, from that of the picture as it is stored; exact.

    ValueError for another orientation than 1 to 8 (EXIF 2.3, tag 0x0112), or without image_size.
    """
    if orientation not in TURNS:
        raise ValueError(f"an EXIF orientation must be 1 to 8, got {orientation}")
    if lens.image_size is None:
        raise ValueError("a lens that is turned with its picture needs an image_size")
    swapped, *mirrored = TURNS[orientation]
    turn = lens.theta_max.new_tensor([[0, 1], [1, 0]] if swapped else [[1, 0], [0, 1]])
    turn = turn * turn.new_tensor([[-1.0 if axis else 1.0] for axis in mirrored])
    size = lens.image_size.flip(1) if swapped else lens.image_size
    off_middle = lens.center_in() - (lens.image_size.flip(1) - 1) / 2
    changed = {"image_size": size, "center": off_middle @ turn.T + (size.flip(1) - 1) / 2}
    if lens.affine is not None:
        changed["affine"] = turn @ lens.affine @ turn.T
    return lens.replace(**changed, **lens._rotated_terms(turn))


def rotated(lens: Lens, angle: float) -> tuple[Lens, Tensor]:
    """The lens of a camera that was turned about its optical axis; exact for every model.

    A ray at (θ, φ) is then at (θ, φ + angle), and the picture moves by an affine map around the
    principal point: a rotation, or where pixels are oblong what looks like one through the lens.

    Args:
        lens: one lens, with an image_size or a center. angle: rad, from x to y.

    Returns:
        The lens, which is the same unless it has tangential or thin-prism terms; and (2, 3)
        float64: what takes a pixel (x, y, 1) to its new place, as of `cv2.warpAffine`.
    """
    if len(lens) != 1:
        raise ValueError(f"rotated takes one lens, got {len(lens)}")
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    center, moves = lens.center_in()[0].detach().double(), turn
    if lens.affine is not None:
        affine = lens.affine[0].detach().double()
        moves = affine @ turn @ torch.linalg.inv(affine)
    matrix = torch.cat((moves, (center - moves @ center)[:, None]), 1)
    return lens.replace(**lens._rotated_terms(turn.to(lens.theta_max))), matrix.cpu()
