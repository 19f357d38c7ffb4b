"""Calibrates with mrcal: a program for the Python of Debian's package `mrcal`.

It reads corners from an .npz file and writes to another the rays of `pixels` (M, 2) and the points
(K, 3) of the board, which it bends unless it is known to be flat:

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
            for x, y in picture:
                place = "- - -" if np.isnan(x) else f"{x:.9f} {y:.9f} 0"
                lines.append(f"picture{k:03}.png {place}")
        cache.write_text("\n".join(lines) + "\n")
        command = [
            "/usr/bin/python3", "/usr/bin/mrcal-calibrate-cameras", "--lensmodel", model,
            "--corners-cache", cache, "--imagersize", str(width), str(height),
            "--focal", str(float(data["focal"])), "--object-spacing", str(float(data["square"])),
            "--object-width-n", str(columns), "--object-height-n", str(rows),
            *["--skip-calobject-warp-solve"] * bool(data["flat"]), "--outdir", folder,
            "picture*.png",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        models = list(Path(folder).glob("*.cameramodel"))
        if done.returncode or not models:
            sys.exit((done.stderr.strip() or "mrcal wrote no model").splitlines()[-1])
        camera = mrcal.cameramodel(str(models[0]))
    rays = mrcal.unproject(data["pixels"], *camera.intrinsics())
    warp = camera.optimization_inputs()["calobject_warp"]
    board = mrcal.ref_calibration_object(columns, rows, float(data["square"]), calobject_warp=warp)
    np.savez(found, rays=rays, board=board.reshape(-1, 3))


if __name__ == "__main__":
    main()
