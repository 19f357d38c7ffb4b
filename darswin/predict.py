"""`darswin predict`: what a trained model sees in pictures taken through a known lens."""

import json
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from darswin.data.sources import read_image
from darswin.files import replace_file
from darswin.lens import Lens, load
from darswin.lens.files import loads
from darswin.models.saving import ModelCard, load_model, model_of_run


def predict(
    pictures: Sequence[str], *, lens: str, run: str | None = None, model: str | None = None,
    camera: str | None = None, top: int = 5, out: str | None = None,
) -> list[dict]:  # fmt: skip
    """The most probable classes of pictures that one camera took, as JSON.

    Args:
        pictures: image files.
        lens: the camera's calibration file, of any format that `darswin.lens.load` reads; or its
            lens as JSON, in pixels of the pictures: {"model": "Spherical", "xi": 0.5, "focal": 300,
            "theta_max": 1.5}, or with "fov" (rad) in place of the last two where the field of view
            fills the circle inside the picture.
        run: the folder of a run, whose best model is taken.
        model: a model's safetensors file, instead.
        camera: which, of a calibration of several.
        top: how many classes.
        out: a JSON file to write; without it, the classes are printed.
    """
    if (run is None) == (model is None):
        raise ValueError(
            "predict needs either --run, a run's folder, or --model, a safetensors file"
        )
    net, card = load_model(model or model_of_run(run))
    found = []
    for name in pictures:
        image = read_image(name, net.in_chans)
        image, taken_with = resized(net, card, image, lens_of(lens, image.shape[:2], camera))
        with torch.inference_mode():
            probabilities = net(image, taken_with).softmax(-1)[0]
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
    text = json.dumps(found, indent=1, ensure_ascii=False)
    if out is None:
        print(text)
    else:
        replace_file(out, text)
    return found


def lens_of(lens: str, image_size: tuple[int, int], camera: str | None = None) -> Lens:
    """A picture's lens, from JSON or the name of a calibration file.

    Args:
        image_size: (H, W) of the picture, which may be resized from the calibration's.

    Raises:
        ValueError: as `darswin.lens.load`; a picture of another shape than the calibration's.
    """
    read = loads if lens.lstrip().startswith("{") else load
    found = read(lens, camera=camera, image_size=image_size).in_picture(image_size)
    return found.replace(center=found.center_in())


def resized(net: nn.Module, card: ModelCard, image: np.ndarray, lens: Lens) -> tuple[Tensor, Lens]:
    """A picture as the model saw them in training: (1, C, H, W) uint8 with its lens, in its pixels.

    The shorter side becomes the model's size. A model that takes only squares gets the middle one.
    """
    height, width = image.shape[:2]
    side = min(height, width)
    if hasattr(net, "image_size"):
        top, left = (height - side) // 2, (width - side) // 2
        image = image[top : top + side, left : left + side]
        lens = lens.cropped(top, left, side, side)
    scale = card.size / side
    height, width = (round(length * scale) for length in image.shape[:2])
    channels = image.shape[2]
    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    image = torch.from_numpy(image.reshape(1, height, width, channels)).permute(0, 3, 1, 2)
    return image.contiguous(), lens.resized(scale)
