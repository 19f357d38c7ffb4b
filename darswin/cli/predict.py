"""`darswin predict`: predictions of a trained model for pictures and videos of known lenses."""

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from darswin.cli.answers import ANSWERS_OF, TOP, Answers, ClassAnswers
from darswin.cli.arguments import check_out
from darswin.cli.lenses import Lenses, given_lenses, lenses_of_run
from darswin.cli.options import check_folder
from darswin.cli.pictures import Broken, File, check_paths, claim_folder, file_names, files_at
from darswin.compat import load_official
from darswin.data.cameras import Calibrations
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD
from darswin.lens.files.reader import Coefficients
from darswin.models.registry import list_pretrained, pretrained_file
from darswin.models.saving import ModelCard, NoCardError, load_model, model_file, model_of_run
from darswin.utils.files import replace_file
from darswin.utils.parameters import check, naming
from darswin.utils.tasks import Task
from darswin.utils.tensor_files import read_metadata
from darswin.utils.video import is_stream
from darswin.utils.words import counted

ANSWERS = "predictions.json"


def predict(
    paths: Sequence[str] = (), *, lens: str | None = None, run: str | None = None,
    model: str | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None, task: Task | None = None, top: int | None = None,
    every: int = 1, out: str | None = None,
) -> list[dict]:  # fmt: skip
    """Predicts classes, or a class or a distance for every pixel, of pictures and video frames.
    `darswin predict --network FILE.onnx --help` lists the options for any network in an ONNX file,
    such as a detector.

    Prints the most probable classes as JSON, or writes picture files. Pictures and videos are
    turned upright by their metadata, and their lens with them. If some files cannot be read, the
    command writes all other predictions first and then names these files. For each video, the last
    entry gives the speed in frames per second.

    Args:
        paths: image files, videos, and folders of them; or a camera, by its number, such as 0, its
            device, or an address such as rtsp://…, of which each newest frame is taken until
            Ctrl-C. A model that comes with darswin has an
            example picture, which is used if no paths are given.
        lens: the camera's calibration file, in any format that `darswin.lens.load` reads. Or a lens
            as JSON, in pixels of the pictures: {"model": "Spherical", "xi": 0.5, "focal": 300,
            "theta_max": 1.5}; "fov_deg" can replace the last two if the field of view fills the
            circle inside the picture. For several cameras, either a lenses.json, whose paths are
            relative to its own folder (see `darswin.data.Calibrations`), or a folder with one
            calibration, STEM.json, for each picture or video. The default is the lens of the run:
            its data.lens, or its data set's own.
        run: the folder of a run of `darswin fit`, whose best model is used, and whose lens if
            `lens` is not given.
        model: in place of a run, the safetensors file of a model, or "digits", which comes with
            darswin. `darswin convert` makes such files from the authors' released weights; their
            classes are numbers.
        task: the task that the model must have. Another model is an error.
        top: the number of classes to list for each image. The default is 5.
        out: the JSON file to write; without it, classes are printed. For segmentation and
            distance, a folder that is new, empty, or from an earlier predict. It gets
            labels/NAME.png with class ids (255: unknown), or distance/NAME.png with metres × 256
            in 16 bits, up to 255.996 m (0: unknown); overlays/NAME.jpg; and predictions.json.
    """
    if (run is None) == (model is None):
        raise ValueError(
            "give either --run, the folder of a run, or --model, a safetensors file or one of "
            + ", ".join(list_pretrained())
            + ", or --network, an ONNX file"
        )
    if run is not None:
        check_folder(Path(run), {".safetensors": "--model takes a model"})
        weights: str | Path = model_of_run(run)
    else:
        assert model is not None
        weights = Path(model_file(model))
    if not paths and lens is None and model in list_pretrained():
        paths, lens = [str(pretrained_file(model, "png"))], str(pretrained_file(model, "json"))
    _check(paths, lens or run, top, every)
    net, card = trained_model(weights)
    if task not in (None, card.task):
        raise ValueError(f"--task is {task}, but {weights} is a model for {card.task}")

    def answers_in(folder: Path | None, names: Mapping[str, str]) -> Answers:
        if folder is None:
            return ClassAnswers(net, card, TOP if top is None else top)
        return ANSWERS_OF[card.task](net, card, folder, names)

    def lenses_of(names: Sequence[str]) -> Lenses:
        if lens is not None:
            return given_lenses(lens, camera, coefficients, names)
        return lenses_of_run(str(run), camera, coefficients, names)

    read = [str(weights), *([] if lens is None else [lens])]
    return _predict(paths, card.task, answers_in, lenses_of, read, top, every, out)


def predict_network(
    paths: Sequence[str] = (), *, network: str, lens: str | None = None,
    camera: str | None = None, coefficients: Coefficients | None = None,
    view: str | None = None, size: tuple[int, int] | None = None, fov_deg: float | None = None,
    up: tuple[float, float, float] | None = None, mean: Sequence[float] | None = None,
    std: Sequence[float] | None = None, channels: Literal["rgb", "bgr"] | None = None,
    threshold: float | None = None, labels: str | None = None, top: int | None = None,
    form: str | None = None, height: float | None = None, radius: float | None = None,
    format: Literal["json", "coco", "yolo"] | None = None, every: int = 1, out: str | None = None,
) -> list[dict]:  # fmt: skip
    """Runs any network in an ONNX file, such as a detector, on a view of pictures and video frames,
    and gives its results in the pictures. `darswin predict --help` lists the options for models.

    Args:
        paths: image files, videos, folders, and cameras, as of models.
        network: an ONNX file: a detector as the exporters of
            YOLO, RT-DETR, RF-DETR, DETR, torchvision and others write it, with masks, keypoints and
            turned boxes; maps (B, K, H, W) of the size of the view or of a whole fraction of it; or
            numbers (B, K). It needs onnxruntime, of the extra onnx.
        lens: the calibration of the camera, or of several, as of models.
        view: what the network sees of the pictures, by its lens: the name of a view of
            `darswin.views`, such as mercator, panorama, none, or tiles:5, with the number of tiles.
            The default is mercator.
        size: height and width of the view in px, such as 512,512, if the network takes any size.
        mean: of the normalization that the network expects, (pixel/255 - mean) / std, one number or
            one for each channel. The default is that of the form of a detector, which is printed,
            and else 0, also if only std is given.
        std: the same for std, else 1. Divide numbers for pixels from 0 to 255 by 255.
        channels: the order of colours that the network expects. The default is that of the form of
            a detector, and else rgb.
        threshold: the lowest score of boxes. The default is 0.3.
        labels: a file with the names of the network's classes: a text file, whose line k names
            class k, from 0, and whose empty lines are no classes; JSON or YAML with a list or with
            {number: name}, as in a data.yaml; or a label map of TensorFlow (.pbtxt). The default
            is the names in the file of the network, if it has any.
        top: the number of classes to list for each image, if the network gives numbers of classes.
        form: of a detector's outputs, if the file does not say it: detect, pose, obb or segment of
            Ultralytics, softmax or sigmoid of the logits of transformers, or another word of the
            how-to about detectors; numbers if the network is no detector.
        height: of the camera above a flat floor, in metres. Each detection then has
            "floor": where it stands, in metres to the right and ahead of the camera. It needs `up`.
        radius: of objects on the floor, in metres: 0.25 suits people. The default is 0, for their
            nearest points.
        format: what else to write of detections, beside predictions.json: coco writes coco.json,
            the results that pycocotools reads; yolo writes labels/NAME.txt, with class, box and
            score in each line.
        out: a folder that is new, empty, or from an earlier predict. It gets predictions.json and
            overlays/NAME.jpg with the detections, or maps/OUTPUT/NAME.npy. For a network without
            boxes and maps, the JSON file to write; without it, its numbers are printed.
    """
    _check(paths, lens, top, every)
    from darswin.cli.network import NetworkAnswers  # needs the compiled part of frames

    answers = NetworkAnswers(
        network, view=view, size=size, fov_deg=fov_deg, up=up, mean=mean, std=std,
        channels=channels, threshold=threshold, labels=labels, top=top, form=form,
        height=height, radius=radius, format=format,
    )  # fmt: skip
    lenses_of = partial(given_lenses, str(lens), camera, coefficients)
    read = [network, str(lens)]
    return _predict(paths, answers.network.kind, answers.into, lenses_of, read, top, every, out)


COMMANDS = {"": predict, "--network": predict_network}


def _check(paths: Sequence[str], lens: str | None, top: int | None, every: int) -> None:
    """ValueError for arguments that cannot be right, before a model is read."""
    for name, value in (("top", top), ("every", every)):
        check(name, value, value is None or value >= 1, "at least 1")
    if not paths:
        raise ValueError("missing pictures or videos: give files or folders")
    if lens is None:
        raise ValueError("missing --lens: give the camera's calibration file")
    check_paths(path for path in paths if not is_stream(path))


def _predict(
    paths: Sequence[str], kind: str,
    answers_in: Callable[[Path | None, Mapping[str, str]], Answers],
    lenses_of: Callable[[Sequence[str]], Lenses],
    read: Sequence[str], top: int | None, every: int, out: str | None,
) -> list[dict]:  # fmt: skip
    """Predicts all files, and writes or prints the entries. `answers_in` takes the folder and the
    names of files, `lenses_of` the paths; `read` names the files of the model and of its lens."""
    prints = kind in ("classification", "numbers")
    if top is not None and not prints:
        text = f"`top` is for the classes of pictures, but {read[0]} is a model for {kind}"
        raise naming(ValueError(text), "top")
    files = files_at(paths, leave_out=None if prints else out, streams=True)
    names = [file.said for file in files]
    check_out(out, [*names, *read], may_be_folder=not prints)
    lenses = lenses_of(names)
    folder = None if prints else claim_folder(out, ANSWERS)
    out = out if folder is None else str(folder / ANSWERS)
    answers = answers_in(folder, file_names(paths, files))
    broken = Broken()
    try:
        for file in files:
            with broken.skipped():
                answer(file, lenses[file.said], every, answers)
    finally:  # keep the predictions so far
        try:
            answers.flush()
        finally:
            entries = answers.found
            if entries:
                text = json.dumps(entries, indent=1, ensure_ascii=False, allow_nan=False)
                print(text) if out is None else replace_file(out, text)
    if (wrong := answers.finish()) is not None:
        raise ValueError("\n".join([wrong, *broken.errors]))
    if out is not None and entries:
        print(_summary(entries, out, answers.shown))
    videos = any(file.is_video for file in files)
    what, kind = ("complete prediction", "file") if videos else ("prediction", "picture")
    count = f"no {what} for {len(broken.errors)} of {counted(len(files), kind)}:"
    broken.report(count if entries else "")
    return entries


def _summary(entries: Sequence[Mapping[str, Any]], out: str, shown: str) -> str:
    """How many pictures have predictions, and where; shown: what the network sees, in words."""
    pictures = [entry for entry in entries if "frames_per_second" not in entry]
    counts = [len(entry["detections"]) for entry in pictures if "detections" in entry]
    text = f"{out}: {counted(len(pictures), 'picture')}{shown}"
    text += f", {counted(sum(counts), 'detection')}" if counts else ""
    drawn = any("overlay" in entry for entry in pictures)
    return text + f"; {Path(out).parent / 'overlays'} shows them" * drawn


def answer(file: File, lenses: Calibrations, every: int, answers: Answers) -> None:
    """Predicts a picture, or the frames of a video or a camera, and prints the speed. Ctrl-C ends a
    camera."""
    if file.is_video:
        answers.flush()
    done, before, start = len(answers.found), answers.seconds, time.perf_counter()
    try:
        for picture in file.pictures(lenses, answers.channels, every):
            answers.add(*picture)
    except KeyboardInterrupt:
        if not is_stream(file.name):
            raise
    finally:
        if file.is_video:
            answers.flush()
            seconds, network = time.perf_counter() - start, answers.seconds - before
            if frames := len(answers.found) - done:
                speed = {
                    "frames": frames,
                    "frames_per_second": round(frames / seconds, 1),
                    "network_frames_per_second": round(frames / network, 1),
                }
                answers.found.append({"video": file.said, **speed})
                print(
                    f"darswin: {file.said}: {frames} frames at {frames / seconds:.1f} frames/s; "
                    f"the network alone: {frames / network:.1f} frames/s",
                    file=sys.stderr,
                )


def trained_model(path: str | Path) -> tuple[Any, ModelCard]:
    """The model of a safetensors file and its card. The file is ours, or has the released weights.

    The released code normalises pixels by the statistics of ImageNet, and its classes are numbers.
    """
    try:
        return load_model(path)
    except NoCardError as error:
        normalization = dict(mean=IMAGENET_MEAN, std=IMAGENET_STD)
        try:
            net = load_official(path, **normalization)
        except ValueError as other:
            raise ValueError(
                f"{error}, and are {other}; commands run models of `darswin fit`, and a network of "
                "your own, such as one in a LensAdapter, runs in Python"
            ) from error
        return net, ModelCard("", normalization, size=_released_size(path))


def _released_size(path: str | Path) -> int:
    """The image size (px) in the configuration of released weights."""
    config = read_metadata(path).get("config", "{}")
    try:
        return int(json.loads(config)["DATA"]["IMG_SIZE"])
    except (KeyError, TypeError, ValueError):
        return 64
