"""The result of OpenCV 5's multi-view calibration: each entry has the values of all cameras."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields
from darswin.lens.files.format import Cameras, has_several
from darswin.lens.files.opencv import OpenCV, Reader
from darswin.utils.text import mapping

KEYS = ("Ks", "distortions", "is_fisheye", "image_sizes")


class MultiView(OpenCV):
    """Cameras are called by their ids, else by their numbers from 0."""

    name = "OpenCV multi-view"
    keys = ", ".join(KEYS)

    def recognizes(self, content: Content) -> bool:
        return isinstance(content, Mapping) and has_several(content, KEYS)

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        numbers = {key: _flat(file.get(key, "the numbers of all cameras")) for key in KEYS}
        count, entries = len(numbers["is_fisheye"]), dict[str, Any]()
        for key, values in numbers.items():
            if not values or len(values) % count:
                each = f"as many numbers for each of the {count} cameras of is_fisheye"
                raise ValueError(f"{key} must have {each}, got {len(values)}")
        for i in range(count):
            matrix, terms, flag, size = (
                values[i * len(values) // count : (i + 1) * len(values) // count]
                for values in numbers.values()
            )
            entries |= {f"K_{i}": matrix, f"distortion_{i}": terms, f"is_fisheye_{i}": flag[0],
                        f"image_width_{i}": size[:1], f"image_height_{i}": size[1:]}  # fmt: skip
        ids = next((file.entries[key] for key in ("cam_ids", "cam_names") if key in file), None)
        names = ids.split(",") if isinstance(ids, str) else ids
        if names is None:
            names = [*range(count)]
        if not isinstance(names, list) or len(names) != count:
            raise ValueError(f"cam_ids must be the names of {count} cameras, got {ids!r}")
        reader = Reader(Fields(entries), coefficients)
        cameras = (partial(reader.camera, str(i)) for i in range(count))
        return mapping(zip((str(name).strip() for name in names), cameras, strict=True))


def _flat(value: Any) -> list:
    """The numbers of a matrix, or of nested lists."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, str):
        value = value.split()
    if not isinstance(value, list):
        return [value]
    return [entry for row in value for entry in (_flat(row) if isinstance(row, list) else [row])]
