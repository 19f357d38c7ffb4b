#!/bin/sh
# opencv-python-headless 5.0.0.93: `cv2.fisheye.projectPoints` mirrors rays beyond 90° to the other side of the picture.
#
# Expected: a ray at 95° to the right lands at cx + f θ, or an error, as the model is defined by θ.
# Seen: the ray lands to the left of the centre, at cx - f (180° - θ): a point behind the image plane is projected as
# its opposite. `undistortPoints` gives 1.7e16 for a pixel of 95°, not NaN. Neither says a word.
# Why it matters: points at the rim of a fisheye of 190° appear on the other side, among true points.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.2.6
"$folder/env/bin/python" - <<'PYTHON'
import math

import cv2
import numpy as np

matrix, zeros = np.array([[300.0, 0, 640], [0, 300, 480], [0, 0, 1]]), np.zeros(3)
print(f"OpenCV {cv2.__version__}: angle to the right, x of its pixel, expected")
for degrees in (80, 89, 91, 95, 110):
    angle = math.radians(degrees)
    ray = np.array([[[math.sin(angle), 0.0, math.cos(angle)]]])
    x = cv2.fisheye.projectPoints(ray, zeros, zeros, matrix, np.zeros(4))[0][0, 0, 0]
    print(f"{degrees:4}°  {x:8.2f}  {640 + 300 * angle:8.2f}")
    seen = 640 + 300 * angle if degrees < 90 else 640 - 300 * (math.pi - angle)
    assert abs(x - seen) < 0.01
pixel = np.array([[[640 + 300 * math.radians(95), 480.0]]])
plane = cv2.fisheye.undistortPoints(pixel, matrix, np.zeros(4))[0, 0, 0]
print(f"undistortPoints of the pixel of 95°: x = {plane:.3g} in the plane z = 1")
assert plane > 1e15
PYTHON
