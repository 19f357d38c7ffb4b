"""`darswin predict`: what a trained model sees in pictures taken through a known lens."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from darswin.data.sources import read_image
from darswin.files import replace_file
from darswin.lens import Lens, from_dict
from darswin.models.saving import ModelCard, load_model, model_of_run


def predict(
    pictures: Sequence[str], *, lens: str, run: str | None = None, model: str | None = None,
    top: int = 5, out: str | None = None,
) -> list[dict]:  # fmt: skip
    """The most probable classes of pictures that one camera took, as JSON.

    Args:
        pictures: image files.
        lens: the camera's lens, in pixels of the pictures, as JSON or the name of a JSON file:
            {"model": "Spherical", "xi": 0.5, "focal": 300, "theta_max": 1.5}, or with "fov" (rad)
            in place of the last two where the field of view fills the circle inside the picture.
        run: the folder of a run, whose best model is taken.
        model: a model's safetensors file, instead.
        top: how many classes.
        out: a JSON file to write; without it, the classes are printed.
    """
    if (run is None) == (model is None):
        raise ValueError(
            "predict needs either --run, a run's folder, or --model, a safetensors file"
        )
    net, card = load_model(model or model_of_run(run))
    description = read_description(lens)
    found = []
    for name in pictures:
        image, taken_with = resized(net, card, read_image(name, net.in_chans), description)
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


def read_description(lens: str) -> dict[str, Any]:
    """A lens as JSON, or in a file of that name."""
    text = lens if lens.lstrip().startswith("{") else Path(lens).read_text()
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"the lens is no JSON: {error}: {text!r}") from error


def resized(
    net: nn.Module, card: ModelCard, image: np.ndarray, description: Mapping[str, Any]
) -> tuple[Tensor, Lens]:
    """A picture as the model saw them in training: (1, C, H, W) uint8 with its lens, in its pixels.

    The shorter side becomes the model's size. A model that takes only squares gets the middle one.
    """
    lens = from_dict(description, image.shape[:2])
    lens = lens.replace(center=lens.center_in(image.shape[:2]))
    height, width = image.shape[:2]
    side = min(height, width)
    if hasattr(net, "image_size"):
        top, left = (height - side) // 2, (width - side) // 2
        image = image[top : top + side, left : left + side]
        lens = lens.replace(center=lens.center - lens.center.new_tensor([left, top]))
    scale = card.size / side
    height, width = (round(length * scale) for length in image.shape[:2])
    channels = image.shape[2]
    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    image = torch.from_numpy(image.reshape(1, height, width, channels)).permute(0, 3, 1, 2)
    return image.contiguous(), lens.resized(scale)
