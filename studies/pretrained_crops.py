"""Classification of crops in the pretrained study: EfficientNet-Lite0 on things of known boxes.

The teacher is the same network on the flat picture around each thing. The other crops are made from
the camera's picture, and are compared with the teacher's answer.
"""

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from pretrained_files import CLASSIFIER, Files
from pretrained_graphs import same_padding
from pretrained_methods import told_lens
from pretrained_scenes import SIZE, Scene, Thing
from pretrained_scores import ZONES, interval
from torch import Tensor, nn

from darswin import boxes
from darswin.lens import Lens
from darswin.views import make_view

SIDE = 224  # px, of a crop
MARGIN = 1.15  # the side of a crop over the larger side of the box
STRIDES = 1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1, 1, 1, 1  # of the blocks


class Convolution(nn.Module):
    """A convolution with TensorFlow's padding, its batch normalisation, and ReLU6 if wanted."""

    def __init__(self, weights: dict[str, Tensor], name: str, norm: str, stride=1, active=True):
        super().__init__()
        scale = weights[f"{norm}.weight"] / (weights[f"{norm}.running_var"] + 1e-3).sqrt()
        self.weight = weights[f"{name}.weight"] * scale[:, None, None, None]
        self.bias = weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * scale
        self.stride, self.active = (stride, stride), active

    def forward(self, x: Tensor) -> Tensor:
        x = F.pad(x, same_padding(x, tuple(self.weight.shape[2:]), self.stride))
        groups = x.shape[1] // self.weight.shape[1]
        x = F.conv2d(x, self.weight, self.bias, self.stride, groups=groups)
        return F.relu6(x) if self.active else x


class Classifier(nn.Module):
    """EfficientNet-Lite0: RGB images (B, 3, 224, 224) of 0 … 255 → logits of 1000 classes."""

    def __init__(self, weights: dict[str, Tensor]) -> None:
        super().__init__()
        self.stem = Convolution(weights, "_conv_stem", "_bn0", 2)
        self.blocks = nn.ModuleList()
        for number, stride in enumerate(STRIDES):
            at = f"_blocks.{number}."
            layers = [
                Convolution(weights, f"{at}_depthwise_conv", f"{at}_bn1", stride),
                Convolution(weights, f"{at}_project_conv", f"{at}_bn2", active=False),
            ]
            if f"{at}_expand_conv.weight" in weights:
                layers.insert(0, Convolution(weights, f"{at}_expand_conv", f"{at}_bn0"))
            self.blocks.append(nn.Sequential(*layers))
        self.head = Convolution(weights, "_conv_head", "_bn1")
        self.weight, self.bias = weights["_fc.weight"], weights["_fc.bias"]

    def forward(self, images: Tensor) -> Tensor:
        x = self.stem((images - 127) / 128)
        for block in self.blocks:
            found = block(x)
            x = x + found if found.shape == x.shape else found
        return F.linear(self.head(x).mean((2, 3)), self.weight, self.bias)


def square_crop(image: np.ndarray, box: np.ndarray) -> np.ndarray:
    """The square around a box, with a margin, as (SIDE, SIDE, 3); black outside of the image."""
    side = max(2.0, MARGIN * max(box[2] - box[0], box[3] - box[1]))
    left, top = (box[:2] + box[2:]) / 2 - side / 2
    reads = max(1, math.ceil(side / SIDE))
    fine = SIDE * reads
    steps = (np.arange(fine) + 0.5) * (side / fine) - 0.5
    places = np.stack(np.meshgrid(left + steps, top + steps), -1).astype(np.float32)
    crop = cv2.remap(image, places, None, cv2.INTER_LINEAR)
    return cv2.resize(crop, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


class Crops:
    """The crops of the things of one picture."""

    def __init__(self, scene: Scene, picture: np.ndarray) -> None:
        self.scene, self.picture = scene, picture
        self.image = torch.from_numpy(picture.transpose(2, 0, 1).copy())[None].float()
        self._views: dict[str, tuple] = {}

    def flat(self, thing: Thing) -> np.ndarray:
        return square_crop(*self.scene.flat(thing))

    def raw(self, thing: Thing) -> np.ndarray:
        return square_crop(self.picture, thing.box)

    def in_view(self, name: str) -> Callable[[Thing], np.ndarray]:
        """Crops of a view of the whole picture, with as many pixels."""

        def crop(thing: Thing) -> np.ndarray:
            lens = self.scene.lens
            if name not in self._views:
                view = make_view(name, (SIZE, SIZE))
                seen = view(self.image, lens.to(torch.float32))[0].permute(1, 2, 0).numpy()
                remap = view.at(lens, (SIZE, SIZE))
                self._views[name] = remap, seen.clip(0, 255).astype(np.uint8)
            remap, seen = self._views[name]
            box, _ = boxes.carry(thing.box[None], remap.to_view)
            return square_crop(seen, box[0])

        return crop

    def tangent(self, lens: Lens) -> Callable[[Thing], np.ndarray]:
        """Perspective pictures that look at each box, level with gravity."""

        def crop(thing: Thing) -> np.ndarray:
            def to_rays(points: np.ndarray) -> np.ndarray:
                given = torch.from_numpy(np.asarray(points, float))[None]
                return lens.unproject_points(given, (SIZE, SIZE))[0].numpy()

            found = boxes.spherical(thing.box[None], to_rays)
            widest = max(found.width[0], found.height[0])
            view = make_view(
                "perspective", (SIDE, SIDE), up=tuple(self.scene.up), direction=tuple(found.ray[0]),
                fov=2 * math.atan(MARGIN * math.tan(min(widest, 2.5) / 2)),
            )  # fmt: skip
            seen = view(self.image, lens.to(torch.float32))
            return seen[0].permute(1, 2, 0).clip(0, 255).numpy().astype(np.uint8)

        return crop

    def all(self) -> dict[str, Callable[[Thing], np.ndarray]]:
        views = {
            name: self.in_view(name) for name in ("stereographic", "equirectangular", "mercator")
        }
        return {
            "tangent picture": self.tangent(self.scene.lens),
            "the camera's picture": self.raw,
            **views,
            "concentric square": self.in_view("square"),
            "tangent picture, wrong lens": self.tangent(told_lens(self.scene.lens_name, True)),
        }


@torch.inference_mode()
def compare_crops(files: Files, scenes: Sequence[tuple[Scene, np.ndarray]]) -> dict:
    """For each kind of crop, how often the answer is that for the flat picture."""
    weights = torch.load(files(CLASSIFIER), map_location="cpu", weights_only=True)
    network = Classifier(weights).eval()

    def answers(crops: list[np.ndarray]) -> np.ndarray:
        batch = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float()
        return network(batch).argmax(1).numpy()

    same: dict[str, list[bool]] = {}
    for scene, picture in scenes:
        of_scene = Crops(scene, picture)
        teacher = answers([of_scene.flat(thing) for thing in scene.things])
        for name, crop in of_scene.all().items():
            found = answers([crop(thing) for thing in scene.things])
            same.setdefault(name, []).extend((found == teacher).tolist())
    theta = np.array([thing.theta_deg for scene, _ in scenes for thing in scene.things])
    rng = np.random.default_rng(0)
    made: dict = dict(things=len(theta), crops={})
    for name, values in same.items():
        agree = np.array(values, float)
        drawn = agree[rng.integers(len(agree), size=(1000, len(agree)))].mean(1)
        zones = [agree[(theta >= low) & (theta < high)] for low, high in ZONES]
        made["crops"][name] = dict(
            same=round(float(agree.mean()), 4), interval=interval(drawn),
            zones=[round(float(of.mean()), 4) if len(of) else None for of in zones],
        )  # fmt: skip
    return made
