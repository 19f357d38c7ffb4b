"""`darswin predict`: what a trained model sees in pictures and videos, taken with known lenses."""

import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import safe_open

from darswin.cli.answers import (
    ANSWERS,
    ANSWERS_OF,
    Answers,
    ClassAnswers,
    claim_folder,
    file_names,
)
from darswin.compat import load_official
from darswin.data.cameras import Calibrations, is_json
from darswin.data.folders import PICTURES, pictures_and_videos_below
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD
from darswin.lens import Lens
from darswin.lens.files.opencv import Coefficients
from darswin.models.registry import list_pretrained, pretrained_file
from darswin.models.saving import ModelCard, NoCardError, load_model, model_of_run
from darswin.utils.files import replace_file
from darswin.utils.image import BrokenImageError, read_oriented
from darswin.utils.tasks import Task
from darswin.utils.video import is_video, read_frames


class File(NamedTuple):
    """A picture or a video that has an answer coming."""

    name: str
    is_video: bool


def predict(
    paths: Sequence[str] = (), *, lens: str | None = None, run: str | None = None,
    model: str | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None, task: Task | None = None, top: int = 5,
    every: int = 1, out: str | None = None,
) -> list[dict]:  # fmt: skip
    """Predicts classes, or a class or a distance for every pixel, of pictures and video frames.

    Prints the most probable classes as JSON, or writes picture files. Pictures and videos that
    their metadata turns are turned upright, with their lens. If some files cannot be predicted, the
    command writes all other predictions first and then names these files. The speed in frames per
    second follows the frames of each video.

    Args:
        paths: image files, videos, and folders of them. A model that comes with darswin has a
            picture and its lens, which are taken if no paths are given.
        lens: the camera's calibration file, in any format that `darswin.lens.load` reads. Or a lens
            as JSON, in pixels of the pictures: {"model": "Spherical", "xi": 0.5, "focal": 300,
            "theta_max": 1.5}; "fov" (rad) can replace the last two if the field of view fills the
            circle inside the picture. For several cameras, either a lenses.json, whose paths are
            relative to its own folder (see `darswin.data.Calibrations`), or a folder with one
            calibration, STEM.json, for each picture or video.
        run: a run's folder; its best model predicts.
        model: a model's safetensors file in place of `run`, or "digits", which comes with darswin.
            `darswin convert` makes such files of the authors' released weights; their classes have
            numbers.
        camera: the name or number of the camera, if the calibration has several.
        coefficients: the distortion model of a calibration of OpenCV or ROS that does not name it.
        task: an error is raised if the model was trained for another task.
        top: number of classes for each image.
        every: the first frame of a video is predicted, and every so many frames after it.
        out: a JSON file to write; without it the classes are printed. For segmentation and
            distance, a folder that is new, empty, or from an earlier predict. It gets
            labels/NAME.png with class ids (255: unknown), or distance/NAME.png with metres × 256
            in 16 bits, up to 255.996 m (0: unknown); overlays/NAME.jpg; and predictions.json.
    """
    if run is not None and model is None:
        weights: str | Path = model_of_run(run)
    elif model is not None and run is None:
        weights = model
    else:
        raise ValueError(
            "predict needs either `run`, a run's folder, or `model`, a safetensors file or one of "
            + ", ".join(list_pretrained())
        )
    for name, value in (("top", top), ("every", every)):
        if value < 1:
            raise ValueError(f"`{name}` must be at least 1, got {value}")
    if not paths and lens is None and model in list_pretrained():
        paths, lens = [str(pretrained_file(model, "png"))], str(pretrained_file(model, "json"))
    if not paths or lens is None:
        raise ValueError("predict needs pictures or videos, and `lens`, the camera's calibration")
    net, card = trained_model(weights)
    if task not in (None, card.task):
        raise ValueError(f"`task` {task} was asked of {weights}, a model for {card.task}")
    files = pictures_and_videos(paths, leave_out=None if card.task == "classification" else out)
    calibrations = _calibrations(lens, camera, coefficients, files)
    if card.task == "classification":
        answers: Answers = ClassAnswers(net, card, top)
    else:
        folder = claim_folder(out)
        out = str(folder / ANSWERS)
        answers = ANSWERS_OF[card.task](net, card, folder, file_names(paths, files))
    bad: list[str] = []
    try:
        for file in files:
            try:
                if file.is_video:
                    answer_video(file.name, every, calibrations, answers)
                else:
                    image, orientation = read_oriented(file.name, net.in_chans)
                    taken_with = _lens(calibrations, file.name, image, orientation)
                    answers.add({"image": file.name}, image, taken_with)
            except BrokenImageError as error:
                bad.append(str(error))
    finally:  # what was found is not lost
        try:
            answers.flush()
        finally:
            found = answers.found
            if found:
                text = json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False)
                print(text) if out is None else replace_file(out, text)
    if bad:
        videos = any(file.is_video for file in files)
        what, kind = (", or not for all frames,", "files") if videos else ("", "pictures")
        count = f"no answer{what} for {len(bad)} of {len(files)} {kind}:\n" if found else ""
        raise BrokenImageError(count + "\n".join(bad))
    return found


def pictures_and_videos(paths: Sequence[str], leave_out: str | None = None) -> list[File]:
    """The files of paths, of which folders mean all pictures and videos in them."""
    files = []
    for path in paths:
        names = [str(path)]
        if os.path.isdir(path) and not _is_picture(path):
            below = pictures_and_videos_below(Path(path))
            names = [n for n in below if leave_out is None or not _is_below(n, leave_out)]
        files += [File(name, not _is_picture(name) and is_video(name)) for name in names]
    return files


def _is_picture(path: str) -> bool:
    return os.path.splitext(path)[1].lower() in PICTURES


def _is_below(path: str, folder: str) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def answer_video(name: str, every: int, calibrations: Calibrations, answers: Answers) -> None:
    """Answers the frames of a video, and prints how fast that went."""
    answers.flush()
    done, before, start = len(answers.found), answers.seconds, time.perf_counter()
    try:
        for frame in read_frames(name, answers.model.in_chans, every):
            taken_with = _lens(calibrations, name, frame.image, frame.orientation)
            entry = {"video": name, "frame": frame.number, "time": round(frame.time, 6)}
            answers.add(entry, frame.image, taken_with)
    finally:
        answers.flush()
        seconds, network = time.perf_counter() - start, answers.seconds - before
        if frames := len(answers.found) - done:
            speed = {
                "frames": frames,
                "frames_per_second": round(frames / seconds, 1),
                "network_frames_per_second": round(frames / network, 1),
            }
            answers.found.append({"video": name, **speed})
            print(
                f"darswin: {name}: {frames} frames at {frames / seconds:.1f} a second, by the "
                f"network alone {frames / network:.1f}",
                file=sys.stderr,
            )


def _calibrations(
    lens: str, camera: str | None, coefficients: str | None, files: Sequence[File]
) -> Calibrations:
    """The lenses that took the files."""
    if is_json(lens) or not os.path.isdir(lens):
        root = "." if is_json(lens) else Path(lens).parent
        return Calibrations(lens, root, camera, coefficients)
    if camera is not None:
        raise ValueError(f"`camera` {camera} is one of a calibration file, and {lens} is a folder")
    own = {Path(file.name): Path(lens, f"{Path(file.name).stem}.json") for file in files}
    there = {file: calibration for file, calibration in own.items() if calibration.is_file()}
    if not there:
        raise FileNotFoundError(
            f"no calibration in {lens}: the first would be {next(iter(own.values()))}"
        )
    return Calibrations(None, coefficients=coefficients, files=there)


def _lens(calibrations: Calibrations, name: str, image: np.ndarray, orientation: int) -> Lens:
    """The lens in an upright picture or frame; BrokenImageError where there is none that fits."""
    try:
        return calibrations.lens_of(Path(name), (image.shape[0], image.shape[1]), orientation)
    except ValueError as error:
        raise BrokenImageError(str(error)) from error


def trained_model(path: str | Path) -> tuple[Any, ModelCard]:
    """The model of a file of ours, or of the released DarSwin's weights, and its card.

    The released code normalises pixels as ImageNet's; a model's classes have numbers there.
    """
    try:
        return load_model(path)
    except NoCardError as error:
        try:
            net = load_official(path, mean=IMAGENET_MEAN, std=IMAGENET_STD)
        except ValueError as other:
            raise ValueError(f"{error}, and are {other}") from error
        return net, ModelCard("", size=_released_size(path))


def _released_size(path: str | Path) -> int:
    """px of the images that released weights were trained on, as their configuration says."""
    with safe_open(path, "pt") as file:
        config = (file.metadata() or {}).get("config", "{}")
    try:
        return int(json.loads(config)["DATA"]["IMG_SIZE"])
    except (KeyError, TypeError, ValueError):
        return 64
