"""Any network of pictures in an ONNX file, run by ONNX Runtime; needs NumPy and onnxruntime."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from darswin.boxes import Instances
from darswin.frames.forms import RGB, Form, decode
from darswin.frames.recognise import FORMS, Network, form_of, imgsz_of, names_of, unused
from darswin.utils.extras import lack
from darswin.utils.files import check_is_file
from darswin.utils.parameters import check, naming
from darswin.utils.text import parse_json, read_text

__all__ = ["OnnxNetwork"]

_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_CHANNELS = (1, 3)
# The inputs beside the pictures, and their types.
_SIZES = ("orig_target_sizes", "pixel_mask")
_INTEGERS = {"tensor(int64)": np.int64, "tensor(int32)": np.int32, "tensor(bool)": np.bool_}
_KNOWN = (
    "known are the forms of public detectors, which the how-to about detectors lists; maps "
    "(B, K, H, W) of the size of the picture or of a whole fraction of it; and numbers (B, K). "
    "Another detector needs its decoder in the graph: boxes (B, N, 4), scores (B, N) and labels "
    "(B, N) by these names, or one output (B, N, 6) of x0, y0, x1, y1, score and class"
)


# What is given in place of an ONNX file, by its first bytes.
_OTHERS = {
    "a pointer of Git LFS in place of the network: run `git lfs pull`": rb"version https://git-lfs",
    "a page of HTML or XML, not a network: perhaps its download failed":
        rb"(\xef\xbb\xbf)?\s*<(!doctype|!--|\?xml|html|head)",
    "a file of another kind, such as a checkpoint of torch or Keras: export the network to ONNX":
        rb"PK\x03\x04|\x80[\x02-\x05]|\x1f\x8b|\x89HDF|ftrt|.{4}TFL3|.{7}\0\{",
    "text, not a network in ONNX": rb"[^\x00-\x08\x0e-\x1f]{9,}\Z",
}  # fmt: skip


class OnnxNetwork:
    """A network in an ONNX file: `network(pictures)` is what it finds in them.

    A call takes one or several pictures as a `darswin.frames.Sampler` makes them: (n, C, H, W)
    float32, already normalised, or (n, H, W, C) uint8. It returns a list of `Instances` for a
    detector, and otherwise a dict of the outputs: numbers (n, K), and maps (n, K, H/k, W/k) with a
    whole number k. Maps of integers, such as ids of classes, may lack K.

    The graph takes pictures (B, C, H, W) or (B, H, W, C), or one picture without B; maps then have
    the same order of axes. If the graph does not name its channels, they come first, and are 3. An
    input `orig_target_sizes` gets the size of the pictures, and `pixel_mask` ones. The outputs of a
    detector may have any form of the public ones. Boxes are in pixels of the picture. To see what
    the outputs are, the network runs once on black pictures.

    Args:
        path: the ONNX file. A config.json of transformers beside it, or above its folder "onnx",
            says what its outputs do not.
        size: (H, W) of the pictures. None means that of the graph, or else of the metadata of
            Ultralytics, one of which must then have one.
        count: the usual number of pictures in a call. They are one batch if the network takes it.
        threshold: the lowest score of a detection. Others are left out.
        form: of the outputs of a detector that do not tell it, a word of the how-to about
            detectors; "numbers" if it is none.
        names: of the classes, by their numbers. The default are those of the file.

    Raises:
        ModuleNotFoundError: onnxruntime is not installed.
        ValueError: the file is no ONNX file that onnxruntime can run, its inputs or outputs are of
            no known form, or of several, or the size is missing or not one that the graph takes.
        FloatingPointError: the network computes NaN or infinity. Boxes may be infinite.
        TypeError: in a call, the pictures are not those of `output`.

    Attributes:
        size: (H, W) of the pictures; has_size: whether the graph takes no others.
        channels: 1 or 3. batch: the number of pictures in a run.
        output: the output of a `darswin.frames.Plan` that the network takes, "uint8" or "image".
        kind: "detections", "maps", or "numbers".
        shapes: the shapes of the outputs for one picture, by name; empty for a detector.
        form: the word for a detector's form, or None. overlaps: whether several boxes show one
            thing, and `darswin.boxes.merge(…, inside=1)` must keep the best.
        unused: the names of outputs that a detector has beside this form.
        names: the names of the classes, by their numbers, as far as they are known.
        pixels: what networks of this form expect: a named tuple of mean, std and channels.
    """

    def __init__(
        self, path: str | os.PathLike, size: tuple[int, int] | None = None, count: int = 1,
        threshold: float = 0.3, form: str | None = None, names: Mapping[int, str] | None = None,
    ):  # fmt: skip
        if (without := lack("onnx", ("onnxruntime",))) is not None:
            raise ModuleNotFoundError(without)
        check("form", form, form in (None, *FORMS), f"one of {', '.join(FORMS)}")
        self.path, self.threshold = os.fspath(path), threshold
        self._session = _session(self.path)
        self._metadata = self._read_metadata()
        self.names = dict(names or names_of(self._metadata))
        own, batch = self._read_input()
        self.has_size = None not in own
        if size is None and not self.has_size:
            size = imgsz_of(self._metadata)
        if size is None and not self.has_size:
            text = f"missing `size`: {self.path} takes pictures of any size, so choose one"
            raise naming(ValueError(text), "size")
        if size is not None:
            fits = all(side in (None, of) for side, of in zip(own, size, strict=True))
            wanted = ",".join("any" if side is None else str(side) for side in own)
            check("size", ",".join(map(str, size)), fits, f"{wanted} for {self.path}")
        self.size: tuple[int, int] = size or own
        self._form: Form | None = None
        self._asked, self._is_seen = form, False
        black = np.zeros((count, self.channels, *self.size), np.float32)
        self.batch = batch or (count if count > 1 and self._takes(black) else 1)
        answers = self(black)
        self._is_seen = True
        self.form = None if self._form is None else self._form.name
        self.overlaps = self._form is not None and self._form.overlaps
        self.pixels = RGB if self._form is None else self._form.pixels
        outputs = [put.name for put in self._session.get_outputs()]
        self.unused: list[str] = [] if self._form is None else unused(self._form, outputs)
        self.kind: Literal["detections", "maps", "numbers"] = "detections"
        self.shapes: dict[str, tuple[int, ...]] = {}
        if isinstance(answers, dict):
            self.kind = "maps" if any(v.ndim == 4 for v in answers.values()) else "numbers"
            self.shapes = {name: values.shape[1:] for name, values in answers.items()}
            self._check_heads()

    def _read_metadata(self) -> dict[str, Any]:
        """The metadata of the file, and the configuration of transformers beside it."""
        metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        folder = Path(self.path).absolute().parent
        file = (folder.parent if folder.name == "onnx" else folder) / "config.json"
        if file.is_file() and "pred_boxes" in {put.name for put in self._session.get_outputs()}:
            config = parse_json(read_text(file))
            metadata |= {key: config[key] for key in ("model_type", "id2label") if key in config}
        return metadata

    def _read_input(self) -> tuple[tuple[Any, Any], int | None]:
        """Reads the axes of the input in the graph. Returns its (H, W) and its batch, None for
        those that are free."""
        puts = self._session.get_inputs()
        sizes = [put for put in puts if put.name in _SIZES]
        first, *others = [put for put in puts if put not in sizes] or puts
        axes = [side if isinstance(side, int) and side > 0 else None for side in first.shape]
        if others or first.type not in _TYPES or len(axes) not in (3, 4):
            named = [f"{put.name} {_text(put.shape)} of {put.type}" for put in puts]
            raise ValueError(
                f"{self.path} has the inputs {', '.join(named)}; it must have one, pictures "
                "(B, C, H, W) or (B, H, W, C) of float or uint8, and may have " + ", ".join(_SIZES)
            )
        self._more_inputs = sizes
        first_axes = {put.name: put.shape[0] for put in self._session.get_outputs() if put.shape}
        self._batched = {  # the outputs whose first axis counts the pictures
            name for name, axis in first_axes.items()
            if len(axes) == 3 or (axis is not None and axis == first.shape[0])
        }  # fmt: skip
        self._input, self._type, self._is_single = first.name, _TYPES[first.type], len(axes) == 3
        batch, *rest = [1] * self._is_single + axes
        self._is_last = rest[2] in _CHANNELS and rest[0] not in _CHANNELS
        channels = rest.pop(2 if self._is_last else 0)
        if channels not in (None, *_CHANNELS):
            raise ValueError(
                f"{self.path} takes pictures {_text(first.shape)}, but they must have 1 or 3 "
                "channels"
            )
        self.channels = channels or 3
        self.output: Literal["uint8", "image"] = "uint8" if self._type is np.uint8 else "image"
        return (rest[0], rest[1]), batch

    def _takes(self, pictures: np.ndarray) -> bool:
        """False if the graph makes its batch 1 inside, though that of its input is free."""
        try:
            self._run(pictures)
        except ValueError:
            return False
        return True

    def __call__(self, pictures: np.ndarray) -> list[Instances] | dict[str, np.ndarray]:
        is_uint8 = pictures.dtype == np.uint8
        if self._is_seen and is_uint8 != (self.output == "uint8"):
            wanted = "uint8" if self.output == "uint8" else "floating point, normalized"
            raise TypeError(f"{self.path} takes pictures of {wanted}, got {pictures.dtype}")
        if is_uint8:
            pictures = np.moveaxis(pictures.reshape(-1, *self.size, self.channels), -1, 1)
        pictures = pictures.reshape(-1, self.channels, *self.size)
        answers: list[Any] = []
        for start in range(0, max(1, len(pictures)), self.batch):
            part = pictures[start : start + self.batch]
            spare = np.zeros((self.batch - len(part), *part.shape[1:]), part.dtype)
            answers += self._run(np.concatenate((part, spare)))
        count = len(pictures)
        if isinstance(answers[0], Instances):
            return answers[:count]
        return {name: np.stack([each[name] for each in answers])[:count] for name in answers[0]}

    def _run(self, pictures: np.ndarray) -> list[Any]:
        """What one batch (B, C, H, W) shows, for each picture: `Instances`, or its outputs."""
        if self._is_last:
            pictures = np.moveaxis(pictures, 1, -1)
        batch = np.ascontiguousarray(pictures[0] if self._is_single else pictures, self._type)
        puts = {self._input: batch} | self._sizes(len(pictures))
        try:
            values = self._session.run(None, puts)
        except Exception as error:  # onnxruntime has a class of its own for each kind of failure
            raise self._error(f"onnxruntime cannot run {self.path}: {_line(error)}") from error
        outputs = {
            put.name: np.asarray(value)[None] if self._is_single else np.asarray(value)
            for put, value in zip(self._session.get_outputs(), values, strict=True)
        }
        try:
            return self._answers(outputs, len(pictures))
        except ValueError as error:
            shapes = [f"{name} {_text(value.shape)}" for name, value in outputs.items()]
            text = f"{self.path} has the outputs {', '.join(shapes)}; {error}"
            raise ValueError(text) from error

    def _error(self, text: str) -> ValueError:
        """An error that the size may cause, if the graph leaves it free."""
        height, width = self.size
        hint = (
            f". Perhaps {height},{width} is no `size` that it takes: mostly it has multiples of 32"
        )
        return naming(ValueError(text + hint * (not self.has_size)), "size")

    def _sizes(self, count: int) -> dict[str, np.ndarray]:
        """The inputs beside the pictures, which tell their size."""
        values = {}
        for put in self._more_inputs:
            if put.name == "pixel_mask":
                axes = zip((count, *self.size), put.shape, strict=True)
                value = np.ones([side if isinstance(side, int) else own for own, side in axes])
            else:
                value = np.tile(self.size[::-1], (count, 1))
            values[put.name] = value.astype((_TYPES | _INTEGERS)[put.type])
        return values

    def _answers(self, outputs: dict[str, np.ndarray], count: int) -> list[Any]:
        """What the outputs (B, …) of `count` pictures show."""
        if any(value.dtype.kind not in "biuf" for value in outputs.values()):
            raise ValueError(_KNOWN)
        if self._form is None and not self._is_seen:
            classes = max(self.names, default=-1) + 1
            network = Network(outputs, self.size, self._metadata, classes, self._batched)
            self._form = form_of(network, self._asked)
        if self._form is None:
            if not (others := self._others(outputs, count)):
                raise self._error(_KNOWN)
            return others
        self._form, detections = decode(self._form, outputs, count, self.size, self.threshold)
        for instances in detections:
            # Boxes may end nowhere.
            labels = instances.labels
            self._check_numbers(instances.boxes.clip(-1e9, 1e9), instances.scores, labels)
            if (labels % 1).any():
                raise ValueError(f"it finds the class {labels[labels % 1 > 0][0]:g}; {_KNOWN}")
        return [replace(of, labels=of.labels.astype(np.int64)) for of in detections]

    def _others(self, outputs: dict[str, np.ndarray], count: int) -> list[Any]:
        """Maps (K, H', W') and numbers (K,) of each picture; [] if there are other outputs."""
        answers = {}
        for name, values in outputs.items():
            if values.ndim == 4 and self._is_last:
                values = np.moveaxis(values, -1, 1)
            # Tables of numbers that are no ids have the size of a fraction by chance.
            is_map = values.shape[1:] == self.size or values.dtype.kind in "biu"
            if values.ndim == 3 and is_map and self._scale_of(values.shape):
                values = values[:, None]
            elif values.ndim == 4 and values.shape[2:] == (1, 1) != self.size:
                values = values[:, :, 0, 0]
            is_known = self._scale_of(values.shape) if values.ndim == 4 else values.ndim < 3
            if not (values.ndim and is_known and len(values) == count):
                return []
            self._check_numbers(values)
            answers[name] = values
        return [{name: values[k] for name, values in answers.items()} for k in range(count)]

    def _scale_of(self, shape: Sequence[int]) -> int | None:
        """The pixels of the picture along each side of a pixel of a map, (…, H', W')."""
        scales = {of // max(to, 1) for of, to in zip(self.size, shape[-2:], strict=True)}
        scale = scales.pop()
        whole = tuple(scale * side for side in shape[-2:]) == self.size
        return scale if whole and not scales else None

    def _check_heads(self) -> None:
        """ValueError for maps that are the heads of a detector."""
        scales: dict[int, dict[str, int | None]] = {}
        for name, shape in self.shapes.items():
            if len(shape) == 3 and shape[0] > 1:
                scales.setdefault(shape[0], {})[name] = self._scale_of(shape)
        for of_names in scales.values():
            if len(set(of_names.values())) > 1 and 1 not in of_names.values():
                shapes = ", ".join(f"{name} {_text(self.shapes[name])}" for name in of_names)
                raise ValueError(
                    f"{self.path} has the same channels at several scales, {shapes}, as the heads "
                    f"of a detector, which are no maps of pixels; {_KNOWN}"
                )

    def _check_numbers(self, *outputs: np.ndarray) -> None:
        if not all(np.isfinite(values).all() for values in outputs):
            raise FloatingPointError(f"{self.path} computes NaN or infinity")


def _session(path: str) -> Any:
    """The graph of an ONNX file, ready to run."""
    import onnxruntime

    check_is_file(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"there is no file {path}")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are raised, and need not be printed as well
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        with open(path, "rb") as file:
            head = file.read(1024)
        for kind, mark in _OTHERS.items():
            if re.match(mark, head, re.IGNORECASE | re.DOTALL):
                raise ValueError(f"{path} is {kind}") from error
        raise ValueError(f"onnxruntime cannot read {path}: {_line(error)}") from error


def _text(shape: Sequence[int | str | None]) -> str:
    return "(" + ", ".join("?" if side is None else str(side) for side in shape) + ")"


def _line(error: Exception) -> str:
    """An error of onnxruntime in one line: its reason, without the place in its code."""
    text = " ".join(str(error).split())
    if newer := re.search(r"IR version: (\d+), max supported IR version: (\d+)", text):
        text = "it has the IR version {}, and onnxruntime reads {} at most"
    elif newer := re.search(r"Opset (\d+) is under .* domain (\S+) is till opset (\d+)", text):
        text = "it has the operator set {} of {}, and onnxruntime knows {} at most"
    else:
        return re.sub(r"\S+onnxruntime\S*\.\w+:\d+ (.*\) (?=[A-Z]))?", "", text)
    return text.format(*newer.groups()) + ": install a newer one, or export to an older version"
