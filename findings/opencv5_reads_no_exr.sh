#!/bin/sh
# opencv-python-headless 5.0.0.93 reads no OpenEXR file, while 4.12.0.88 reads the same file.
#
# Expected: with OPENCV_IO_ENABLE_OPENEXR=1 set before the import, `cv2.imread` reads the depth that Blender and most
# simulators write as EXR, as the wheels of OpenCV 4 do.
# Seen: 5.0.0.93 gives None, and its build information lists no OpenEXR. 4.12.0.88 reads the floats exactly.
# Why it matters: `pip install -U` of a renderer's environment turns all depth maps into "cannot read the file".
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 4.12.0.88 5.0.0.93; do
  python3 -m venv "$folder/$version"
  "$folder/$version/bin/pip" install --quiet --disable-pip-version-check "opencv-python-headless==$version" "numpy==2.2.6"
done
export OPENCV_IO_ENABLE_OPENEXR=1
"$folder/4.12.0.88/bin/python" - "$folder/depth.exr" <<'PYTHON'
import sys

import cv2
import numpy as np

depth = np.linspace(0.5, 80, 64 * 48, dtype=np.float32).reshape(48, 64)
assert cv2.imwrite(sys.argv[1], depth)
again = cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED)
assert again.dtype == np.float32 and (again == depth).all()
print(f"OpenCV {cv2.__version__} writes and reads {depth.shape} floats")
PYTHON
"$folder/5.0.0.93/bin/python" - "$folder/depth.exr" <<'PYTHON'
import sys

import cv2

assert cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED) is None
lines = [line.strip() for line in cv2.getBuildInformation().splitlines() if "EXR" in line.upper()]
assert not any("build" in line or "YES" in line for line in lines), lines
print(f"OpenCV {cv2.__version__}: imread gives None; its build information on EXR: {lines}")
PYTHON
