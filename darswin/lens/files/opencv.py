"""Camera matrices and their coefficients: OpenCV's FileStorage and ROS's camera_info.

Files are YAML, XML or JSON. The keys of several cameras end with a number, or left and right; or
each key has the values of all cameras. Intrinsics may also be single numbers: fx, fy, cx, cy, and
k1, k2, p1, … beside them.
"""

import re
from collections.abc import Mapping
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np

from darswin.lens.files.fields import Fields, plain_name, short
from darswin.lens.files.format import Cameras, Format, Intrinsics, has_several
from darswin.lens.files.reader import BESIDE, MATRIX, MODELS, ORDERS, PLANE, Reader, matrices
from darswin.utils.text import mapping

# Entries of OpenCV 5's multi-view calibration, each with the values of all cameras.
VIEWS = ("Ks", "distortions", "is_fisheye", "image_sizes")
MAX_NUMBERS = 10_000  # in one of them


class OpenCV(Format):
    """Cameras are called by the endings of their matrices' keys."""

    name = "OpenCV"
    keys = "camera_matrix and distortion_coefficients"
    takes_coefficients = True
    holds = (
        "Perspective and BrownConrady (3 radial, no skew), Equidistant and KannalaBrandt (4 radial "
        "only), Spherical and Mei (2 radial, tangential)"
    )

    def _recognizes(self, content: Mapping) -> bool:
        # Many files have a K or M. It counts if it is a matrix, or a list beside other entries.
        names = {plain_name(name): value for name, value in content.items()}
        return any(
            _is_matrix(value)
            or (
                (isinstance(value, (list, Mapping)) or " " in str(value or ""))
                and any(name + e in names for name in BESIDE for e in {end, ""})
            )
            for end, value in matrices(names)
        )

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        reader = Reader(file, coefficients)
        values = {plain: file.entries[name] for plain, name in reader.names.items()}
        suffixes = sorted({end for end, _ in matrices(values)}, key=lambda end: (len(end), end))
        if "" in suffixes:
            suffixes = [""]
        reader.check_coefficients(suffixes)
        return {suffix or "camera": partial(reader.camera, suffix) for suffix in suffixes}

    def _text(self, camera: Intrinsics, suffix: str) -> str | None:
        import cv2  # only writing needs it

        kind = next((kind for kind in MODELS if ORDERS[kind][0] is camera.model), "pinhole")
        order = ORDERS[kind][1].removesuffix(" tilt1 tilt2")
        skew = "" if kind == "pinhole" else "skew"  # cv2.projectPoints leaves it out
        if not camera.has_only(ORDERS[kind][0], f"{order} xi {skew}"):
            return None
        if kind == "pinhole" and not any(camera.listed("d1 d2 d3 s1 s2 s3 s4")):
            order = "k1 k2 p1 p2 k3"
        fx, fy, cx, cy, slant = camera.listed("fx fy cx cy skew")
        storage = cv2.FileStorage(
            suffix if suffix in (".xml", ".json") else ".yaml",
            cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY,
        )
        if camera.size is not None:
            storage.write("image_width", camera.size[1])
            storage.write("image_height", camera.size[0])
        if kind == "omnidir":
            storage.write("xi", camera.values["xi"])
        else:
            storage.write("fisheye_model", int(kind == "fisheye"))
        storage.write("camera_matrix", np.array([[fx, slant, cx], [0, fy, cy], [0, 0, 1]], float))
        storage.write("distortion_coefficients", np.array([camera.listed(order)]).T)
        return storage.releaseAndGetString()


class Ros(OpenCV):
    """A ROS message or file, which names its distortion model."""

    name = "ROS camera_info"
    keys = "k, d and distortion_model"

    def _recognizes(self, content: Mapping) -> bool:
        return super()._recognizes(content) and "distortion_model" in content


class ByName(Format):
    """The intrinsics of one camera as single numbers, without a matrix."""

    name = "intrinsics by name"
    keys = "fx, fy, cx, cy, k1, …"
    takes_coefficients = True

    def _recognizes(self, content: Mapping) -> bool:
        names = {plain_name(name): value for name, value in content.items()}
        return {*PLANE} <= names.keys() and not any(
            isinstance(names.get(matrix), (list, Mapping)) for matrix in MATRIX
        )

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        reader = Reader(file, coefficients)
        if reader.coefficients("") is None or any(
            re.fullmatch(r"[kps]\d|skew", n) for n in reader.names
        ):
            return {"camera": reader.camera_by_name}
        fx, fy, cx, cy = (file.number(reader.names[name]) for name in PLANE)
        whole = {**file.entries, "camera_matrix": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]}
        return {"camera": partial(Reader(Fields(whole), coefficients).camera, "")}


class MultiView(OpenCV):
    """Cameras are called by their ids, else by their numbers from 0."""

    name = "OpenCV multi-view"
    keys = ", ".join(VIEWS)

    def _recognizes(self, content: Mapping) -> bool:
        return has_several(content, VIEWS)

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        numbers = {key: numbers_of(file.get(key, "the numbers of all cameras")) for key in VIEWS}
        count, entries = max(len(numbers["is_fisheye"]), 1), dict[str, Any]()
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
        keys = [key for key in ("cam_ids", "cam_names") if key in file]
        ids = file.entries[keys[0]] if keys else [*range(count)]
        names = ids.split(",") if isinstance(ids, str) else ids
        if not isinstance(names, list) or len(names) != count:
            raise ValueError(f"cam_ids must be the names of {count} cameras, got {short(ids)}")
        reader = Reader(Fields(entries), coefficients)
        cameras = (partial(reader.camera, str(i)) for i in range(count))
        return mapping(zip((str(name).strip() for name in names), cameras, strict=True))


def numbers_of(value: Any) -> list:
    """The numbers of a matrix, or of lists of lists of lists."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if not isinstance(value, list):
        return value.split() if isinstance(value, str) else [value]
    for _ in range(2):
        rows = (row if isinstance(row, list) else [row] for row in value)
        value = [*islice(chain.from_iterable(rows), MAX_NUMBERS)]
    return value


def _is_matrix(value: Any) -> bool:
    if isinstance(value, Mapping):
        return "data" in value
    return isinstance(value, list) and len(value) in (3, 9)
