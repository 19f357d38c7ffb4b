"""The image of a ROS message: a region of the sensor, whose pixels may be joined."""

import math

from darswin.lens.files.fields import Fields, to_side
from darswin.lens.image import Size


def in_message(
    file: Fields, plane: dict[str, float], size: Size
) -> tuple[Size, dict[str, list[float]]]:
    """The image size of a ROS message, and the place of its region on the sensor, if any.
    Changes `plane` from the sensor's pixels to the image's: the image shows the region `roi`,
    and joins `binning_x` × `binning_y` pixels to one."""
    roi = file.section("roi") if "roi" in file else Fields({})
    left, top, width, height = (
        _pixels(roi, name) for name in ("x_offset", "y_offset", "width", "height")
    )
    across, down = (max(_pixels(file, f"binning_{axis}"), 1) for axis in "xy")
    sensor: dict[str, list[float]] = {}
    if width or height or left or top:
        rows, columns = size or (math.inf, math.inf)
        if not (0 < width <= columns - left and 0 < height <= rows - top):
            raise ValueError(
                "roi must be a part of the image of 1 pixel or more, or all 0, got "
                f"{width}×{height} px at ({left}, {top})"
            )
        if size is not None:
            sides = size[0] / down, size[1] / across
            sensor = {"sensor": [left / across, top / down, *sides]}
        size = height, width
    if size is not None:
        size = size[0] // down, size[1] // across
        if 0 in size:
            raise ValueError(f"the binning of {across}×{down} pixels leaves none of the image")
    plane["cx"] = (plane["cx"] - left + 0.5) / across - 0.5
    plane["cy"] = (plane["cy"] - top + 0.5) / down - 0.5
    for name, count in (("fx", across), ("fy", down), ("skew", across)):
        plane[name] /= count
    return size, sensor


def _pixels(fields: Fields, name: str) -> int:
    """A number of pixels; 0 if the entry is missing."""
    if name not in fields:
        return 0
    return to_side(fields.get(name, "a whole number of pixels"), fields.path(name), least=0)
