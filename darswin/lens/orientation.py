"""The lens of a rotated picture: upright by its EXIF orientation, or by any angle.

A calibration describes pixels as the camera stores them, but pictures are read upright.
"""

import math

import torch
from torch import Tensor

from darswin.lens.base import Lens
from darswin.utils.angles import check_turn
from darswin.utils.exif import TURNS


def stored_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """(H, W) of a picture as stored, from the (H, W) of the upright picture."""
    return size[::-1] if TURNS[orientation][0] else size


def in_upright_picture(lens: Lens, size: tuple[int, int], orientation: int) -> Lens:
    """The lens in an upright picture of (H, W) that shows the whole calibrated image.

    If the stored picture has another shape than the calibration but the upright one has the same,
    the calibration was made with upright pictures. `orientation` is the stored picture's EXIF
    orientation, 1 to 8. Raises ValueError if neither shape matches.
    """
    try:
        return upright(lens.in_picture(stored_size(size, orientation)), orientation)
    except ValueError as error:
        try:
            return lens.in_picture(size)
        except ValueError:
            if orientation == 1:
                raise error from None
            stored = f"as stored; its EXIF orientation is {orientation}"
            raise ValueError(f"{error} ({stored})") from error


def upright(lens: Lens, orientation: int) -> Lens:
    """The exact lens of the upright picture, from the lens of the stored picture.

    Raises ValueError for an orientation that is not 1 to 8 (EXIF 2.3, tag 0x0112), and for a lens
    without image_size.
    """
    if orientation not in TURNS:
        raise ValueError(f"an EXIF orientation must be 1 to 8, got {orientation}")
    if lens.image_size is None:
        raise ValueError("a lens needs an image_size to be rotated with its picture")
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
    """The exact lens of a camera rotated about its optical axis, for every model.

    A ray at (θ, φ) moves to (θ, φ + angle). The picture moves by an affine map around the principal
    point: a rotation, if the pixels are square.

    Args:
        lens: one lens, with an image_size or a center.
        angle: rad, in [-2π, 2π], from x to y.

    Returns:
        The lens, which is the same unless it has tangential or thin-prism terms; and a (2, 3)
        float64 matrix that maps a pixel (x, y, 1) to its new place, as for `cv2.warpAffine`.
    """
    if len(lens) != 1:
        raise ValueError(f"rotated takes one lens, got {len(lens)}")
    check_turn("angle", angle)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    center, moves = lens.center_in()[0].detach().double(), turn
    if lens.affine is not None:
        affine = lens.affine[0].detach().double()
        moves = affine @ turn @ torch.linalg.inv(affine)
    matrix = torch.cat((moves, (center - moves @ center)[:, None]), 1)
    return lens.replace(**lens._rotated_terms(turn.to(lens.theta_max))), matrix.cpu()
