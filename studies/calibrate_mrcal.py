"""Calibrates with mrcal: a program for the Python of Debian's package `mrcal`.

It reads corners from an .npz file and writes the rays of `pixels` (M, 2) to another:

    /usr/bin/python3 calibrate_mrcal.py LENSMODEL_… in.npz out.npz
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import mrcal
import numpy as np


def main() -> None:
    model, given, found = sys.argv[1:]
    data = np.load(given)
    corners, columns, rows = data["corners"], int(data["columns"]), int(data["rows"])
    height, width = data["size"]
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "corners.vnl"
        lines = ["# filename x y level"]
        for k, picture in enumerate(corners):
            lines += [f"picture{k:03}.png {x:.9f} {y:.9f} 0" for x, y in picture]
        cache.write_text("\n".join(lines) + "\n")
        command = [
            "/usr/bin/python3", "/usr/bin/mrcal-calibrate-cameras", "--lensmodel", model,
            "--corners-cache", cache, "--imagersize", str(width), str(height),
            "--focal", str(float(data["focal"])), "--object-spacing", str(float(data["square"])),
            "--object-width-n", str(columns), "--object-height-n", str(rows),
            "--skip-calobject-warp-solve", "--outdir", folder, "picture*.png",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        models = list(Path(folder).glob("*.cameramodel"))
        if done.returncode or not models:
            sys.exit((done.stderr.strip() or "mrcal wrote no model").splitlines()[-1])
        lens, values = mrcal.cameramodel(str(models[0])).intrinsics()
    rays = mrcal.unproject(data["pixels"], lens, values)
    np.savez(found, rays=rays)


if __name__ == "__main__":
    main()
