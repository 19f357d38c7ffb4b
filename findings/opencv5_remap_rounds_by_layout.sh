#!/bin/sh
# opencv-python-headless 5.0.0.93: whether `cv2.remap` rounds points to 1/32 px depends on channels and dtype.
#
# Expected: one rule for INTER_LINEAR with float maps; OpenCV 4 rounds always, and 5.0 is known not to.
# Seen: exact for 1, 3 and 4 channels of uint8, uint16 and float32. For 2 or 5 channels, and for int16 and float64 of
# any number of channels, points are rounded to 1/32 px, so a noise picture of 0 to 255 is up to 6 off.
# Why it matters: an image and its depth map (float64), or a flow of two channels, are remapped by different points.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.2.6
"$folder/env/bin/python" - <<'PYTHON'
import cv2
import numpy as np

random = np.random.default_rng(0)
x, y = (random.uniform(10, 160, (200, 200)).astype(np.float32) for _ in range(2))
left, top = np.floor(x).astype(int), np.floor(y).astype(int)
across, down = (x.astype(float) - left)[..., None], (y.astype(float) - top)[..., None]
print(f"OpenCV {cv2.__version__}: largest error of remap for 1 to 5 channels of 0 to 255")
for dtype in (np.uint8, np.uint16, np.float32, np.int16, np.float64):
    errors = []
    for channels in range(1, 6):
        picture = (255 * random.random((200, 200, channels))).astype(dtype)
        corners = [[picture[top + i, left + j].astype(float) for j in (0, 1)] for i in (0, 1)]
        rows = [(1 - across) * pair[0] + across * pair[1] for pair in corners]
        exact = (1 - down) * rows[0] + down * rows[1]
        remapped = cv2.remap(picture, x, y, cv2.INTER_LINEAR).reshape(200, 200, channels)
        errors.append(float(np.abs(remapped - exact).max()))
        rounds = channels in (2, 5) or dtype in (np.int16, np.float64)
        assert (errors[-1] > 3) == rounds and (rounds or errors[-1] < 0.51), (dtype, channels)
    print(f"{np.dtype(dtype).name:8}", *(f"{error:6.2f}" for error in errors))
PYTHON
