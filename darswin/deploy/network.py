"""Any network of pictures in an ONNX file, run by ONNX Runtime; needs NumPy and onnxruntime."""

import os
from typing import Any, Literal, NamedTuple

import numpy as np

from darswin.utils.extras import lack
from darswin.utils.files import check_is_file
from darswin.utils.parameters import check, naming

__all__ = ["Detections", "OnnxNetwork"]

_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_CHANNELS = (1, 3)
_DETECTIONS = ("boxes", "scores", "labels")
_KNOWN = (
    "known are boxes (B, N, 4), scores (B, N) and labels (B, N) of these names, one output "
    "(B, N, 6) of x0, y0, x1, y1, score and class, maps (B, K, H, W), and numbers (B, K); a "
    "network that needs a decoder must have it in its graph"
)


class Detections(NamedTuple):
    """What a detector finds in a picture, in the order of its output.

    Shapes: boxes (K, 4), the corners x0, y0, x1, y1 in px, where the picture covers (0, 0) to
    (W, H); scores (K,); labels (K,), the numbers of the classes.
    """

    boxes: np.ndarray
    scores: np.ndarray
    labels: np.ndarray


class OnnxNetwork:
    """A network in an ONNX file: `network(pictures)` is what it finds in them.

    A call takes the pictures as a `darswin.frames.Sampler` makes them: one or several of float32,
    (n, C, H, W), already normalised, or of uint8, (n, H, W, C). It returns a list of `Detections`
    for a detector, and otherwise a dict of the outputs, maps (n, K, H', W') or numbers (n, K).

    The graph has one input: pictures (B, C, H, W) or (B, H, W, C), or one picture without B; maps
    then have the same order of axes. If the graph names no channels, it is (B, C, H, W) with 3. The
    outputs of a detector are boxes, scores and labels by these names, in any order, (B, N, …) or
    (N, …) for one picture; or one output (B, N, 6) of x0, y0, x1, y1, score and class. Boxes are in
    pixels of the picture. To see what the outputs are, the network runs once on black pictures.

    Args:
        path: the ONNX file.
        size: (H, W) of the pictures. None means that of the graph, which must then have one.
        count: the number of pictures in a call. They are one batch if the network takes it.
        threshold: the lowest score of a detection. Others are dropped.

    Raises:
        ModuleNotFoundError: onnxruntime is not installed.
        ValueError: the file is no ONNX file that onnxruntime can run, its inputs or outputs are of
            no known form, or the size is missing or not that of the graph.
        FloatingPointError: in a call, the network computes NaN.

    Attributes:
        size: (H, W) of the pictures. channels: 1 or 3.
        output: the output of a `darswin.frames.Plan` that the network takes, "uint8" or "image".
        kind: "detections", "maps", or "numbers". batch: the number of pictures in a run.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        size: tuple[int, int] | None = None,
        count: int = 1,
        threshold: float = 0.3,
    ):
        if (without := lack("onnx", ("onnxruntime",))) is not None:
            raise ModuleNotFoundError(without)
        self.path, self.threshold = os.fspath(path), threshold
        self._session = _session(self.path)
        self._outputs = [put.name for put in self._session.get_outputs()]
        own = self._read_input()
        if size is None and None in own:
            text = f"missing `size`: {self.path} takes pictures of any size, so give one"
            raise naming(ValueError(text), "size")
        if size is not None:
            fits = all(side in (None, of) for side, of in zip(own, size, strict=True))
            wanted = ",".join("any" if side is None else str(side) for side in own)
            check("size", ",".join(map(str, size)), fits, f"{wanted} for {self.path}")
        self.size: tuple[int, int] = size or own
        black = np.zeros((count, self.channels, *self.size), np.float32)
        self.batch = self._batch or (count if self._takes(black) else 1)
        found = self(black)
        self.kind: Literal["detections", "maps", "numbers"] = "detections"
        if isinstance(found, dict):
            self.kind = "maps" if any(v.ndim == 4 for v in found.values()) else "numbers"

    def _read_input(self) -> tuple[Any, Any]:
        """Reads the axes of the input in the graph; returns (H, W), None for a free side."""
        inputs = self._session.get_inputs()
        axes = [side if isinstance(side, int) and side > 0 else None for side in inputs[0].shape]
        kind = _TYPES.get(inputs[0].type)
        if len(inputs) != 1 or kind is None or len(axes) not in (3, 4):
            given = (f"{put.name} {_shape(put.shape)} of {put.type}" for put in inputs)
            raise ValueError(
                f"{self.path} has the inputs {', '.join(given)}; it must have one, pictures "
                "(B, C, H, W) or (B, H, W, C) of float or uint8"
            )
        self._type, self._is_single = kind, len(axes) == 3
        self._batch, first, middle, last = [1] * self._is_single + axes
        self._is_last = last in _CHANNELS and first not in _CHANNELS
        channels = last if self._is_last else first
        if channels not in (None, *_CHANNELS):
            raise ValueError(
                f"{self.path} takes pictures {_shape(inputs[0].shape)}, but they must have 1 or 3 "
                "channels"
            )
        self.channels = channels or 3
        self.output: Literal["uint8", "image"] = "uint8" if kind is np.uint8 else "image"
        return (first, middle) if self._is_last else (middle, last)

    def _takes(self, pictures: np.ndarray) -> bool:
        """False if the graph fixes its batch to 1 inside, though its input is free."""
        try:
            self._run(pictures)
        except ValueError:
            return False
        return True

    def __call__(self, pictures: np.ndarray) -> list[Detections] | dict[str, np.ndarray]:
        if pictures.dtype == np.uint8:
            pictures = np.moveaxis(pictures.reshape(-1, *self.size, self.channels), -1, 1)
        pictures = pictures.reshape(-1, self.channels, *self.size)
        found: list[Any] = []
        for start in range(0, len(pictures), self.batch):
            part = pictures[start : start + self.batch]
            spare = np.zeros((self.batch - len(part), *part.shape[1:]), part.dtype)
            found += self._run(np.concatenate((part, spare)))
        found = found[: len(pictures)]
        if isinstance(found[0], Detections):
            return found
        return {name: np.stack([each[name] for each in found]) for name in found[0]}

    def _run(self, pictures: np.ndarray) -> Any:
        """What one batch (B, C, H, W) shows, for each picture: `Detections`, or its outputs."""
        if self._is_last:
            pictures = np.moveaxis(pictures, 1, -1)
        pictures = np.ascontiguousarray(pictures[0] if self._is_single else pictures, self._type)
        try:
            values = self._session.run(None, {self._session.get_inputs()[0].name: pictures})
        except Exception as error:
            raise ValueError(f"onnxruntime cannot run {self.path}: {_line(error)}") from error
        named = dict(zip(self._outputs, values, strict=True))
        found = None
        if all(isinstance(value, np.ndarray) for value in values):
            count = 1 if self._is_single else len(pictures)
            with_batch = [value[None] if self._is_single else value for value in values]
            found = self._read(dict(zip(self._outputs, with_batch, strict=True)), count)
        if found is None:
            given = (f"{name} {_shape(np.shape(value))}" for name, value in named.items())
            raise ValueError(f"{self.path} has the outputs {', '.join(given)}; {_KNOWN}")
        return found

    def _read(self, outputs: dict[str, np.ndarray], count: int) -> list[Any] | None:
        """The outputs for each of `count` pictures; None if their form is unknown."""
        named = {name.lower(): value for name, value in outputs.items()}
        (first, *others) = outputs.values()
        if named.keys() >= set(_DETECTIONS):
            boxes, scores, labels = (named[name] for name in _DETECTIONS)
            boxes = boxes[None] if boxes.ndim == 2 else boxes
        elif not others and first.ndim == 3 and first.shape[2] == 6:
            boxes, scores, labels = first[..., :4], first[..., 4], first[..., 5]
        else:
            return self._read_others(outputs, count)
        shape = boxes.shape[:-1]
        if boxes.ndim != 3 or (len(boxes), boxes.shape[2]) != (count, 4):
            return None
        if not scores.size == labels.size == boxes.size // 4:
            return None
        each = zip(boxes, scores.reshape(shape), labels.reshape(shape), strict=True)
        return [self._kept(*one) for one in each]

    def _kept(self, boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray) -> Detections:
        """The detections of one picture whose score is high enough."""
        keep = ~(scores < self.threshold)
        boxes, scores, labels = boxes[keep].astype(float), scores[keep].astype(float), labels[keep]
        for values in (boxes, scores, labels):
            self._check_numbers(values)
        return Detections(boxes, scores, labels.astype(np.int64))

    def _read_others(self, outputs: dict[str, np.ndarray], count: int) -> list[Any] | None:
        """Maps (K, H', W') and numbers (K,) of each picture."""
        found = {}
        for name, values in outputs.items():
            if values.ndim == 3 and values.shape[1:] == self.size:
                values = values[:, None]
            elif values.ndim == 4 and self._is_last:
                values = np.moveaxis(values, -1, 1)
            if values.ndim not in (1, 2, 4) or len(values) != count:
                return None
            self._check_numbers(values)
            found[name] = values
        return [{name: values[k] for name, values in found.items()} for k in range(count)]

    def _check_numbers(self, values: np.ndarray) -> None:
        if np.isnan(values).any():
            raise FloatingPointError(f"{self.path} computes NaN")


def _session(path: str) -> Any:
    """The graph of an ONNX file, ready to run."""
    import onnxruntime

    if not os.path.isfile(path):
        check_is_file(path)
        raise FileNotFoundError(f"there is no file {path}")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are raised, and need not be printed as well
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class of its own for each kind of failure
        raise ValueError(
            f"{path} is no ONNX file that onnxruntime can run: {_line(error)}"
        ) from error


def _shape(sides: Any) -> str:
    return "(" + ", ".join("?" if side is None else str(side) for side in sides) + ")"


def _line(error: Exception) -> str:
    """The last part of an error of onnxruntime, in one line."""
    return " ".join(str(error).split())[:300]
