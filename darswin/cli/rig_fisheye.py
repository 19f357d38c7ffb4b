"""`darswin rig fisheye`: the six faces of a simulator's cube as a fisheye camera sees them."""

import math
import os
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from darswin.cli.views import camera_view
from darswin.lens import save
from darswin.lens.rig import CUBES, Rig
from darswin.utils.parameters import check, naming
from darswin.utils.words import counted, in_px

LENS, CLASSES, RECORD = "lens.json", "classes.json", "rig.json"
FRAME = "0000"  # the name of the only one


# The folder of a kind of pictures, and the endings of its files; None means those of pictures.
KINDS: dict[str, tuple[str, Collection[str] | None]] = {
    "colour": ("images", None), "labels": ("labels", (".png",)),
    "depth": ("distance", (".exr", ".npy", ".png")),
}  # fmt: skip


def fisheye(
    folder: str, *, to: str, out: str, faces: Literal["carla", "habitat", "opengl"] = "carla",
    size: tuple[int, int] | None = None, depth_of: Literal["z", "distance"] = "z",
    depth_unit: float | None = None,
) -> None:  # fmt: skip
    """Makes fisheye pictures, labels and distances of a simulator's six pictures of 90°.

    They are a data set for `darswin fit`: images, labels, distance, and lens.json. Distances are
    PNGs of 16 bits, in metres × 256, 0 where they are unknown.

    Args:
        folder: the folder with the faces of each frame, as front/0001.png, right/0001.png, …; or of
            one frame, front.png, …. Or with such folders colour, labels (ids in grey PNGs or in
            palettes) and depth (PNGs of 16 bits, .npy or .exr). CARLA's raw depth and labels, which
            are colours, must be decoded before.
        to: the calibration file of the fisheye camera, or its lens as JSON.
        out: the folder to write to: new, empty, or from an earlier run, whose files are replaced.
        faces: whose names the faces have: front, right, back, left, up and down for carla and
            habitat, and +x, -x, +y, -y, +z and -z for opengl.
        size: height and width of the fisheye pictures, px. The default is that of the lens.
        depth_of: what the depth is: z along the axis of each face, or distance along rays.
        depth_unit: metres of a step of the depth, e.g. 0.001. The default is 1, but for PNGs.
    """
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # before OpenCV is imported
    from darswin.cli.answers import distance_png
    from darswin.cli.pictures import check_paths, claim_folder, is_below
    from darswin.cli.rig_files import check_sizes, files_of, read_frames
    from darswin.data.scenes.targets import read_ids
    from darswin.utils.files import replace_file
    from darswin.utils.image import read_header, write_image
    from darswin.utils.progress import Progress

    check_paths([folder])
    check("out", out, not is_below(out, folder), f"a folder outside of {folder}")
    in_range = depth_unit is None or 0 < depth_unit < math.inf
    check("depth_unit", depth_unit, in_range, "a finite number of metres above 0")
    view, root = camera_view(to, size), Path(folder)
    kinds = [kind for kind in KINDS if (root / kind).is_dir()]
    found = {
        kind: files_of([str(root / kind if kinds else root)], CUBES[faces], KINDS[kind][1])
        for kind in kinds or ["colour"]
    }
    if "colour" not in found:
        raise FileNotFoundError(f"there is no folder {root / 'colour'} beside {root / kinds[0]}")
    pictures = found["colour"]
    for kind, frames in found.items():
        if lacking := frames.keys() ^ pictures.keys():
            raise FileNotFoundError(f"colour and {kind} do not both have the frame {min(lacking)}")
    first, *_ = (file for files in pictures.values() for file in files.values())
    for file in (file for files in found.get("depth", {}).values() for file in files.values()):
        if file.suffix == ".png" and depth_unit is None:
            text = f"missing `depth_unit`: the metres of a step of PNGs such as {file}"
            raise naming(ValueError(text), "depth_unit")
    rig = Rig.cube(read_header(first).size[0], faces)
    remap, target = view.at(rig), claim_folder(out, RECORD)
    save(view.lens, target / LENS)
    if (root / CLASSES).is_file():
        replace_file(target / CLASSES, (root / CLASSES).read_bytes())
    with Progress("fisheye", len(pictures)) as progress:
        for frame in pictures:
            for kind, frames in found.items():
                file, files = target / KINDS[kind][0] / f"{frame or FRAME}.png", frames[frame]
                if kind == "colour":
                    write_image(file, remap(read_frames(rig, files)))
                    continue
                read = read_ids if kind == "labels" else partial(_depth, unit=depth_unit)
                maps = check_sizes(rig, files, {name: read(path) for name, path in files.items()})
                if kind == "labels":
                    write_image(file, remap.target(maps)[..., None])
                else:
                    replace_file(file, distance_png(remap.depth(maps, of=depth_of)))
            progress.done += 1
    made = ", ".join(KINDS[kind][0] for kind in found)
    size_and_lens = f"{in_px(remap.view_size)}; the lens is {target / LENS}"
    print(f"{out}: {made} of {counted(len(pictures), 'frame')}, {size_and_lens}")


def _depth(file: Path, unit: float | None) -> np.ndarray:
    """A map of depths (H, W) float64, in metres."""
    import cv2

    from darswin.utils.image import BrokenImageError, decoded, file_content

    try:
        if file.suffix.lower() == ".npy":
            depth = np.load(file)
        else:
            depth = decoded(file_content(file), file, cv2.IMREAD_UNCHANGED)
    except (ValueError, EOFError) as error:
        raise BrokenImageError(f"cannot read {file}: {error}") from error
    except BrokenImageError as error:
        if file.suffix.lower() != ".exr":
            raise
        text = f"{error}. If this OpenCV reads no EXR, as OpenCV 5, convert it to .npy"
        raise BrokenImageError(text) from error
    depth = depth[..., 0] if depth.ndim == 3 else depth
    if depth.dtype == np.uint8:
        raise ValueError(f"{file} has 8 bits: depths are PNGs of 16 bits, .npy or .exr")
    return depth * float(unit or 1)
