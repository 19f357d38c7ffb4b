#!/bin/sh
# pycolmap 4.2.1: a fisheye camera ends at 90° from its axis, although its model (Kannala-Brandt) goes on.
#
# Expected: the pixel of a ray at 95°, and the ray of that pixel, as the model's formula r = f θ has them.
# Seen: `img_from_cam` gives NaN from 90° on. `cam_from_img` gives points of the plane z = 1 and says nothing: the
# pixel of 90.1° is a ray at 57.5°, and that of 95° one at 58.9°, so rays fold back by 32° at the rim.
# Why it matters: many fisheyes see 95 to 110° from the axis. Their pixels near the rim get wrong rays without an error.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy==2.2.6
"$folder/env/bin/python" - <<'PYTHON'
import math

import numpy as np
import pycolmap

camera = pycolmap.Camera(
    model="OPENCV_FISHEYE", width=1200, height=1200, params=[330, 330, 600, 600, 0, 0, 0, 0]
)
print(f"pycolmap {pycolmap.__version__}: angle, its pixel's x (expected), the angle of that pixel")
for degrees, seen in ((60, 60.0), (89, 89.0), (90.1, 57.547), (95, 58.905), (100, 60.189)):
    angle = math.radians(degrees)
    expected = 600 + 330 * angle
    pixel = camera.img_from_cam(np.array([[math.sin(angle), 0.0, math.cos(angle)]]))[0, 0]
    back = math.degrees(math.atan(camera.cam_from_img(np.array([[expected, 600.0]]))[0, 0]))
    print(f"{degrees:6}°  {pixel:9.3f} ({expected:.3f})  {back:.3f}°")
    assert np.isnan(pixel) == (degrees > 90)
    assert abs(back - seen) < 0.01
PYTHON
