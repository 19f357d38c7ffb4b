"""The most probable classes of a stream of images, several at once."""

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from darswin.data.frames import at_size
from darswin.deploy.optimize import optimize
from darswin.lens import Lens
from darswin.models.encoder import Encoder, Prepared
from darswin.models.saving import ModelCard

BATCH = 8  # images at once take a half or a third of the time of one after the other


class Answers:
    """Collects what a model says of images, in their order.

    Images that follow each other and have the same lens go through the model together, and the grid
    and position biases of that lens are computed once.

    Attributes:
        found: an entry for each image answered. seconds: what the network took for them.

    Args:
        model, card: as `load_model` gives them. top: how many classes of each image.
    """

    def __init__(self, model: Encoder, card: ModelCard, top: int):
        self.model, self.card, self.top = optimize(model), card, top
        self.found: list[dict[str, Any]] = []
        self.seconds = 0.0
        self._lens: Lens | None = None
        self._prepared = Prepared(None, ())  # for the lens
        self._waiting: list[tuple[dict[str, Any], Tensor]] = []

    def add(self, entry: dict[str, Any], image: np.ndarray, lens: Lens) -> None:
        """An image (H, W, C) uint8 and its lens; the same object is the same lens.

        Args:
            entry: what is said of the image beside its classes.
        """
        pixels, resized_lens = resized(self.model, self.card, image, lens)
        if lens is not self._lens:
            self.flush()
            with torch.inference_mode():
                size = (pixels.shape[2], pixels.shape[3])
                self._prepared = self.model.prepare(resized_lens, size)
            self._lens = lens
        self._waiting.append((entry, pixels))
        if len(self._waiting) == BATCH:
            self.flush()

    def flush(self) -> None:
        """Answers the images that wait for others."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        images = torch.cat([pixels for _, pixels in waiting])
        start = time.perf_counter()
        with torch.inference_mode():
            features = self.model.norm(self.model.run(images, self._prepared)[-1])
            probabilities = self.model.forward_head(features).softmax(-1)
        self.seconds += time.perf_counter() - start
        best = probabilities.topk(min(self.top, probabilities.shape[1]))
        for (entry, _), values, indices in zip(waiting, *map(Tensor.tolist, best), strict=True):
            self.found.append(entry | {"top": [*map(self._class, indices, values)]})

    def _class(self, index: int, probability: float) -> dict[str, Any]:
        name = self.card.classes[index] if self.card.classes else index
        return {"class": name, "probability": probability}


def resized(net: Encoder, card: ModelCard, image: np.ndarray, lens: Lens) -> tuple[Tensor, Lens]:
    """A picture as the model saw them in training: (1, C, H, W) uint8 with its lens, in its pixels.

    `darswin.data.frames.at_size` as the model's card says. A model that takes only squares gets one
    in any case.
    """
    fit = "crop" if net.square_images and card.fit == "whole" else card.fit
    image, lens = at_size(image, lens, card.size, fit)
    return torch.from_numpy(image[None]).permute(0, 3, 1, 2).contiguous(), lens
