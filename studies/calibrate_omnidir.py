"""Calibrates with `cv2.omnidir.calibrate`: a program for a Python with opencv-contrib.

It reads corners from an .npz file and writes camera matrix, ξ and coefficients to another:

    PYTHON calibrate_omnidir.py in.npz out.npz
"""

import sys

import cv2
import numpy as np


def main() -> None:
    given, found = sys.argv[1:]
    data = np.load(given)
    seen = ~np.isnan(data["corners"]).any(2)
    points = [data["points"][None, there] for there in seen]
    corners = [picture[None, there] for picture, there in zip(data["corners"], seen, strict=True)]
    height, width = (int(side) for side in data["size"])
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-10)
    try:
        error, matrix, xi, distortion, *_, used = cv2.omnidir.calibrate(
            points, corners, (width, height), None, None, None, cv2.omnidir.CALIB_FIX_SKEW, stop
        )
    except cv2.error as failure:
        sys.exit(str(failure).strip().splitlines()[-1])
    np.savez(
        found, error=error, matrix=matrix, xi=xi, distortion=distortion, used=used,
        version=cv2.__version__,
    )  # fmt: skip


if __name__ == "__main__":
    main()
