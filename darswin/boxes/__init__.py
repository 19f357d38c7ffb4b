"""Boxes, points, polygons and masks that follow a picture through a lens or a view.

Boxes (x0, y0, x1, y1), polygons and points have the coordinates of COCO and torchvision: a picture
covers (0, 0) to (W, H), and pixel i has its centre at i + 1/2. Boxes of five columns are rotated,
*turned* for short: (x, y, w, h, angle), the middle, two sides, and the angle of w in rad, from x to
y, so clockwise on a screen. A *point map* is a function from points (..., 2) to points (..., 2),
NumPy float64, in darswin's pixels, whose centres are integers; it gives NaN where nothing is seen.
Examples are `to_view` and `to_image` of a `darswin.views.Remap`, and `frames.Plan.points`. Tensors
give tensors of the same device and dtype, all else gives NumPy arrays.

A box is warped as the ellipse inside it: objects touch the middles of the sides of their boxes, and
the corners are mostly empty, so a rectangle would grow with every step.
"""

from darswin.boxes.carried import carry, carry_mask, carry_points, carry_polygon
from darswin.boxes.instances import Instances
from darswin.boxes.overlap import clip, iou, merge
from darswin.boxes.rle import decode_rle, encode_rle
from darswin.boxes.sphere import spherical
from darswin.boxes.turned import corners, turned

__all__ = [
    "Instances", "carry", "carry_mask", "carry_points", "carry_polygon", "clip", "corners",
    "decode_rle", "encode_rle", "iou", "merge", "spherical", "turned",
]  # fmt: skip
