"""`darswin predict`: what a trained model sees in pictures taken through a known lens."""

import functools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jsonargparse import ArgumentParser
from safetensors import safe_open
from torch import Tensor

from darswin.compat import load_official
from darswin.data.frames import at_size
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD
from darswin.lens import Lens, load
from darswin.lens.files import loads
from darswin.lens.orientation import in_upright_picture, stored_size
from darswin.models.encoder import Encoder
from darswin.models.saving import ModelCard, NoCardError, load_model, model_of_run
from darswin.utils.files import replace_file
from darswin.utils.image import BrokenImageError, read_oriented


def run(argv: list[str]) -> None:
    """Runs `darswin predict` with the arguments that follow it."""
    described = (predict.__doc__ or "").splitlines()[0]
    parser = ArgumentParser(prog="darswin predict", description=described)
    parser.add_argument("pictures", nargs="+", type=str, help="image files")
    parser.add_function_arguments(predict, skip={"pictures"})
    predict(**parser.parse_args(argv).as_dict())


def predict(
    pictures: Sequence[str], *, lens: str, run: str | None = None, model: str | None = None,
    camera: str | None = None, top: int = 5, out: str | None = None,
) -> list[dict]:  # fmt: skip
    """The most probable classes of pictures that one camera took, as JSON.

    A picture that its EXIF turns upright is turned, as in training, and its lens with it. Pictures
    that have no answer are named once the others' answers are written.

    Args:
        pictures: image files.
        lens: the camera's calibration file, of any format that `darswin.lens.load` reads; or its
            lens as JSON, in pixels of the pictures: {"model": "Spherical", "xi": 0.5, "focal": 300,
            "theta_max": 1.5}, or with "fov" (rad) in place of the last two where the field of view
            fills the circle inside the picture.
        run: the folder of a run, whose best model is taken.
        model: a model's safetensors file, instead; also what `darswin convert` makes of the
            authors' released weights, whose classes have numbers.
        camera: which, of a calibration of several.
        top: how many classes.
        out: a JSON file to write; without it, the classes are printed.

    Raises:
        BrokenImageError: a picture that cannot be read, or that the lens does not fit.
        ValueError: arguments that are wrong, a lens that `darswin.lens.load` or the model refuses.
    """
    if run is not None and model is None:
        weights = model_of_run(run)
    elif model is not None and run is None:
        weights = Path(model)
    else:
        raise ValueError(
            "predict needs either --run, a run's folder, or --model, a safetensors file"
        )
    if top < 1:
        raise ValueError(f"--top must be at least 1, got {top}")
    net, card = trained_model(weights)
    calibration = functools.cache(lambda size: read_lens(lens, size, camera))
    found, bad = [], []
    try:
        for name in pictures:
            try:
                image, orientation = read_oriented(name, net.in_chans)
            except BrokenImageError as error:
                bad.append(str(error))
                continue
            size = image.shape[:2]
            calibrated = calibration(stored_size(size, orientation))
            try:
                taken_with = in_upright_picture(calibrated, size, orientation)
            except ValueError as error:
                bad.append(f"{name}: {error}")
                continue
            batch, taken_with = resized(net, card, image, taken_with)
            with torch.inference_mode():
                probabilities = net(batch, taken_with).softmax(-1)[0]
            best = probabilities.topk(min(top, len(probabilities)))
            found.append(
                {
                    "image": str(name),
                    "top": [
                        {"class": card.classes[k] if card.classes else k, "probability": p}
                        for p, k in zip(best.values.tolist(), best.indices.tolist(), strict=True)
                    ],
                }
            )
    finally:  # what was found is not lost
        if found:
            text = json.dumps(found, indent=1, ensure_ascii=False)
            print(text) if out is None else replace_file(out, text)
    if bad:
        count = f"no answer for {len(bad)} of {len(pictures)} pictures:\n" if found else ""
        raise BrokenImageError(count + "\n".join(bad))
    return found


def trained_model(path: str | Path) -> tuple[Encoder, ModelCard]:
    """The model of a file of ours, or of the released DarSwin's weights, and its card.

    The released code normalises pixels as ImageNet's; a model's classes have numbers there.

    Raises:
        ValueError: as `darswin.models.load_model`; weights of neither.
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
    """px of the images that released weights were trained on, 64 unless their configuration says
    another size."""
    with safe_open(path, "pt") as file:
        config = (file.metadata() or {}).get("config", "{}")
    try:
        return int(json.loads(config)["DATA"]["IMG_SIZE"])
    except (KeyError, TypeError, ValueError):
        return 64


def read_lens(lens: str, image_size: tuple[int, int], camera: str | None = None) -> Lens:
    """A lens from JSON or the name of a calibration file.

    Args:
        image_size: (H, W) of pictures as stored, for a lens that does not say it.

    Raises:
        ValueError, OSError: as `darswin.lens.load`.
    """
    read = loads if lens.lstrip().startswith("{") else load
    return read(lens, camera=camera, image_size=image_size)


def resized(net: Encoder, card: ModelCard, image: np.ndarray, lens: Lens) -> tuple[Tensor, Lens]:
    """A picture as the model saw them in training: (1, C, H, W) uint8 with its lens, in its pixels.

    `darswin.data.frames.at_size` as the model's card says. A model that takes only squares gets one
    in any case.
    """
    fit = "crop" if net.square_images and card.fit == "whole" else card.fit
    image, lens = at_size(image, lens, card.size, fit)
    return torch.from_numpy(image[None]).permute(0, 3, 1, 2).contiguous(), lens
