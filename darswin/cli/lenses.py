"""The lenses of the files that `darswin predict` reads: given, or those of the run."""

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from darswin.cli.options import FIRST_TASK, content_of
from darswin.data.cameras import Calibrations, is_json
from darswin.data.scenes import Scenes, open_scenes
from darswin.data.scenes.targets import TARGETS, Target
from darswin.data.splits import some

# The lenses of files, by the files' names.
Lenses = Mapping[str, Calibrations]

_OPENING = ("classes", "splits", "label_map", "holdout")


def given_lenses(
    lens: str, camera: str | None, coefficients: str | None, files: Sequence[str]
) -> Lenses:
    """The lenses that `predict --lens` names; arguments as there."""
    if is_json(lens) or not os.path.isdir(lens):
        root = "." if is_json(lens) else Path(lens).parent
        return dict.fromkeys(files, Calibrations(lens, root, camera, coefficients))
    if camera is not None:
        raise ValueError(f"--camera {camera} chooses a camera of a file, but {lens} is a folder")
    own = {Path(file): Path(lens, f"{Path(file).stem}.json") for file in files}
    there = {file: calibration for file, calibration in own.items() if calibration.is_file()}
    if not there:
        raise FileNotFoundError(f"no calibration in {lens}: {next(iter(own.values()))} is missing")
    return dict.fromkeys(files, Calibrations(None, coefficients=coefficients, files=there))


def lenses_of_run(
    run: str, camera: str | None, coefficients: str | None, files: Sequence[str]
) -> Lenses:
    """The lenses on which a run was trained, if they are the lenses of the files.

    They are the run's `data.lens`, or else the data set's own: each picture in it has its lens, and
    other pictures have one if the data set has a single one. `camera` and `coefficients` take the
    place of the run's. A line on stderr names the lenses.

    Raises:
        ValueError: the run has no lens, or not for all files.
    """
    missing = "missing --lens: give the camera's calibration file"
    config = Path(run) / "config.yaml"
    if not config.is_file():
        raise ValueError(f"{missing}, because {run} has no config.yaml, which would name one")
    content = content_of(config)
    data, task = content.get("data", {}), content.get("task", FIRST_TASK)
    camera = camera or data.get("camera")
    coefficients = coefficients or data.get("coefficients")
    lens, path = data.get("lens"), data.get("path", ".")
    if lens is None and task not in TARGETS:
        raise ValueError(f"{missing}, because {run} was trained on pictures without a lens")
    try:
        if lens is not None:
            lenses: Lenses = dict.fromkeys(files, Calibrations(lens, path, camera, coefficients))
        else:
            opening = {"camera": camera, "coefficients": coefficients}
            opening |= {option: data[option] for option in _OPENING if option in data}
            lenses = _of_scenes(_scenes(path, TARGETS[task], opening), files)
        for file in files:
            lenses[file].camera_of(file)
    except (ValueError, OSError) as error:
        raise ValueError(f"{missing}, because that of {run} cannot be used: {error}") from error
    what = f"lenses of the run's data set: {path}" if lens is None else f"lens of the run: {lens}"
    print(f"darswin: {what}", file=sys.stderr)
    return lenses


def _scenes(path: str, target: Target, opening: Mapping[str, Any]) -> list[Scenes]:
    """The splits of a run's data set."""
    splits = []
    for split in ("train", "val", "test"):
        try:
            splits.append(open_scenes(path, split, target, **opening))
        except FileNotFoundError:
            if split == "train":
                raise
    return splits


def _of_scenes(splits: Sequence[Scenes], files: Sequence[str]) -> Lenses:
    """The lenses of scenes for files that are among them, or that have the only lens."""
    own = {
        os.path.abspath(scenes.file(k)): scenes.lenses
        for scenes in splits
        for k in range(len(scenes))
    }
    several = len({camera for scenes in splits for camera in scenes.lenses.cameras}) > 1
    others = [file for file in files if os.path.abspath(file) not in own]
    if several and others:
        raise ValueError(f"the data set has several lenses, but not these files: {some(others)}")
    return {file: own.get(os.path.abspath(file), splits[0].lenses) for file in files}
