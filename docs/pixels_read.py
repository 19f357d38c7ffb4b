"""The pixels of a large picture that a polar grid reads: the figures of docs/explanation/large.md.

Run it with `.venv/bin/python docs/pixels_read.py`; tests/docs/test_claims.py holds the page to it.
The lenses are 175° wide, and their circle is as wide as the picture.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from darswin import PolarView
from darswin.data import SphericalLenses, WideAngle, open_source
from darswin.lens import Lens, Spherical
from darswin.lens.pixels import pixel_angles
from darswin.models.registry import pretrained_file
from darswin.models.saving import load_model

SIZES = (128, 256, 512, 1024, 2048)
SAMPLES = (10, 4)  # along each side of a patch
XI = (0.0, 0.5, 1.0)
REDUCED = 128  # px
DEVIATIONS = (0, 0.1, 0.25, 0.5)  # of the noise, where white is 1
DIGITS, LARGE = 100, 1024


def main() -> None:
    for row_of in (share_row, noise_row):
        for size in SIZES:
            print(" | ".join(row_of(size)))
    for deviation in DEVIATIONS:
        print(" | ".join((f"{deviation}", *(f"{share:.0f} %" for share in accuracy(deviation)))))


def share_row(size: int) -> list[str]:
    """A row of the table of pixels."""
    shares = [share_read(size, samples, xi) for samples in SAMPLES for xi in XI]
    return [f"{size} × {size}", *(f"{share:.0f} %" for share in shares)]


def noise_row(size: int) -> list[str]:
    """A row of the table of noise."""
    errors = [error for samples in SAMPLES for error in noise(size, samples)]
    return [f"{size} × {size}", *(f"{error:.2f}" for error in errors)]


def lens_of(xi: float, size: int) -> Lens:
    return Spherical.from_fov(xi, math.radians(175), size / 2)


def grid_of(samples: int) -> PolarView:
    return PolarView(rings=16, sectors=64, samples=(samples, samples))


def share_read(size: int, samples: int, xi: float) -> float:
    """The share of the pixels inside the circle that have a weight in any sample, percent."""
    lens = lens_of(xi, size)
    image = torch.zeros(1, 1, size, size, requires_grad=True)
    grid_of(samples)(image, lens).sum().backward()
    assert image.grad is not None
    seen = ~pixel_angles(lens, (size, size))[0].isnan()
    return 100 * (image.grad[0, 0] > 0)[seen].float().mean().item()


def noise(size: int, samples: int) -> tuple[float, float]:
    """The standard deviation of a patch's mean sample in white noise with a deviation of 1: read
    from the picture, and from the picture reduced by area. The lens has ξ = 0.5."""
    picture = torch.randn(1, 1, size, size, generator=torch.Generator().manual_seed(0))
    reduced = interpolate(picture, (REDUCED, REDUCED), mode="area")
    return patch_noise(picture, samples), patch_noise(reduced, samples)


def patch_noise(image: Tensor, samples: int) -> float:
    means = grid_of(samples)(image, lens_of(0.5, image.shape[-1])).mean(-1)
    return means.square().mean().sqrt().item()


@torch.inference_mode()
def accuracy(deviation: float) -> tuple[float, float]:
    """The accuracy of darswin's digits model on large noisy pictures, percent: read directly, and
    reduced by area to the size of its training. The lens has ξ = 0.5."""
    model, card = load_model(pretrained_file("digits", "safetensors"))
    source = open_source("digits", "test", channels=1)
    lenses = SphericalLenses(0.5, 0.5)
    pictures = WideAngle(source, lenses, size=LARGE, render=LARGE, fov=card.fov, mean=[0], std=[1])
    correct = torch.zeros(2)
    for k in range(DIGITS):
        picture, lens, label = pictures[k]
        noise = torch.randn(picture.shape, generator=torch.Generator().manual_seed(k))
        large = (picture + deviation * noise)[None]
        small = interpolate(large, (card.size, card.size), mode="area")
        logits = model(large, lens), model(small, lens.resized(card.size / LARGE))
        correct += torch.tensor([x.argmax().item() == label for x in logits])
    return tuple((100 * correct / DIGITS).tolist())


if __name__ == "__main__":
    main()
