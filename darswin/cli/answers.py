"""What a model says of a stream of images, several at once: their most probable classes."""

import time
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from darswin.data.warp import Framing, at_size
from darswin.deploy.optimize import optimize
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.encoder import Encoder, Prepared
from darswin.models.saving import ModelCard
from darswin.models.unet import Unet

Net = TypeVar("Net", bound=Model)

BATCH = 8  # images at once take a half or a third of the time of one after the other
LENSES = 16  # of which what they decide is kept: as many cameras may take turns in a folder


class Asked(NamedTuple):
    """Attributes: entry: what is said of an image beside the answer; image: (H, W, C) uint8;
    pixels: (1, C, h, w), what the model gets of it."""

    entry: dict[str, Any]
    image: np.ndarray
    pixels: Tensor


class Answers:
    """Collects what a model says of images, in their order.

    Images that follow each other and have the same lens go through the model together, and what a
    lens alone decides is computed once. A subclass says what is asked of the model, in `ask`, and
    what is made of that, in `answer`.

    Attributes:
        found: an entry for each image answered. seconds: what the network took for them.

    Args:
        model: of `create_model`, or what `optimize` makes of one. card: as `load_model` gives it.
    """

    def __init__(self, model: Encoder | Unet, card: ModelCard):
        self.model, self.card = model, card
        self.found: list[dict[str, Any]] = []
        self.seconds = 0.0
        self._lens: Lens | None = None  # of the images that wait
        self._decided: dict[int, tuple[Lens, Any, Any]] = {}  # by the identity of a lens
        self._waiting: list[Asked] = []

    def add(self, entry: dict[str, Any], image: np.ndarray, lens: Lens) -> None:
        """An image (H, W, C) uint8 and its lens; the same object is the same lens.

        Args:
            entry: what is said of the image beside the answer.
        """
        pixels, resized_lens = resized(self.model, self.card, image, lens)
        if lens is not self._lens:
            self.flush()
            self._lens = lens
            if id(lens) not in self._decided:
                if len(self._decided) == LENSES:
                    del self._decided[next(iter(self._decided))]
                with torch.inference_mode():
                    size = (pixels.shape[2], pixels.shape[3])
                    prepared = self.model.prepare(resized_lens, size)
                self._decided[id(lens)] = lens, prepared, self.look_through(lens)
        self._waiting.append(Asked(entry, image, pixels))
        if len(self._waiting) == BATCH:
            self.flush()

    def flush(self) -> None:
        """Answers the images that wait for others.

        Raises:
            FloatingPointError: naming an image for which the model computes NaN or infinity.
        """
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        _, prepared, look = self._decided[id(self._lens)]
        images = torch.cat([asked.pixels for asked in waiting])
        start = time.perf_counter()
        with torch.inference_mode():
            output = self.ask(images, prepared)
        self.seconds += time.perf_counter() - start
        for asked, said in zip(waiting, output, strict=True):
            if not self.is_finite(said, look):
                entry = asked.entry
                name = f"frame {entry['frame']} of {entry['video']}" if "video" in entry else ""
                raise FloatingPointError(
                    f"no answer for {name or entry['image']}: the model computes NaN or infinity; "
                    "its weights may have diverged in training, take others"
                )
            self.found.append(asked.entry | self.answer(asked, said, look))

    def look_through(self, lens: Lens) -> Any:
        """What `answer` needs of a lens."""
        return None

    def is_finite(self, said: Tensor, look: Any) -> bool:
        """Whether all that the network says of an image is finite."""
        return bool(said.isfinite().all())

    def ask(self, images: Tensor, prepared: Any) -> Tensor:
        """What the network says of images (B, C, h, w): (B, …)."""
        raise NotImplementedError

    def answer(self, asked: Asked, said: Tensor, look: Any) -> dict[str, Any]:
        """The answer for an image of which the network says that; `look` is of `look_through`."""
        raise NotImplementedError


class ClassAnswers(Answers):
    """The most probable classes of images.

    Args:
        model, card: as `load_model` gives them. top: how many classes of each image.
    """

    model: Encoder

    def __init__(self, model: Encoder, card: ModelCard, top: int):
        super().__init__(fast(model, card), card)
        self.top = top

    def ask(self, images: Tensor, prepared: Prepared) -> Tensor:
        """The probabilities of all classes, (B, K)."""
        return self.model.run(images, prepared).softmax(-1)

    def answer(self, asked: Asked, said: Tensor, look: Any) -> dict[str, Any]:
        """The most probable classes."""
        best = said.topk(min(self.top, len(said)))
        return {"top": [*map(self._class, best.indices.tolist(), best.values.tolist())]}

    def _class(self, index: int, probability: float) -> dict[str, Any]:
        name = self.card.classes[index] if self.card.classes else index
        return {"class": name, "probability": probability}


def fast(model: Net, card: ModelCard) -> Net:
    """The optimized model: in float32, or as fast as it goes where it is quantized anyway."""
    return optimize(model, "fastest" if card.quantized else torch.float32)


def resized(net: Model, card: ModelCard, image: np.ndarray, lens: Lens) -> tuple[Tensor, Lens]:
    """A picture as the model saw them in training: (1, C, H, W) uint8 with its lens, in its pixels.

    `darswin.data.at_size` as the model's card says, and `fit_of`.
    """
    image, lens = at_size(image, lens, card.size, fit_of(net, card))
    return torch.from_numpy(image[None]).permute(0, 3, 1, 2).contiguous(), lens


def fit_of(net: Model, card: ModelCard) -> Framing:
    """How pictures get the model's size. One that takes only squares gets one in any case."""
    return "crop" if net.square_images and card.fit == "whole" else card.fit
