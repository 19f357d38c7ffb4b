"""What a polar map loses on the way to pixels: the figures of docs/explanation/dense.md.

Run it with `.venv/bin/python docs/resampling.py`; tests/docs/test_claims.py holds the page to it.
The lens is that of the demo's middle, ξ = 0.5 and 175° wide, its circle as wide as the picture.
"""

import math
import statistics

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, one_hot

from darswin import PolarView
from darswin.lens import Lens, Spherical
from darswin.lens.pixels import pixel_angles
from darswin.ops import polar_sample, polar_to_image

CLASSES, REGIONS, PICTURES = 10, 60, 5


def main() -> None:
    for rings, sectors in ((16, 64), (32, 128), (64, 256), (128, 512)):
        row = [f"{rings}×{sectors}"]
        for size in (64, 256):
            for samples in (1, 4):
                row.append(f"{ceiling(size, rings, sectors, samples):.2f}")
        print(" | ".join(row))
    print("bilinear, four nearest, share of samples: {:.4f} {:.4f} {:.2f}".format(*four_nearest()))


def ceiling(size: int, rings: int, sectors: int, samples: int) -> float:
    """Mean IoU of labels that were brought to a polar map and back, over a few pictures.

    Args:
        samples: along each side of a patch, whose mean is what the map holds.
    """
    lens = Spherical.from_fov(0.5, math.radians(175), size / 2)
    seen = ~pixel_angles(lens, (size, size))[0].isnan()
    scores = []
    for seed in range(PICTURES):
        labels = regions(size, seed)
        shares = one_hot(labels, CLASSES).permute(2, 0, 1)[None].float()
        back = there_and_back(shares, lens, rings, sectors, samples)[0].argmax(0)
        scores.append(mean_iou(labels[seen], back[seen]))
    return statistics.mean(scores)


def there_and_back(image: Tensor, lens: Lens, rings: int, sectors: int, samples: int) -> Tensor:
    """An image (1, C, H, W) as a polar map of mean samples, and the map as an image again."""
    size = (image.shape[2], image.shape[3])
    grid = PolarView(rings=rings, sectors=sectors, samples=(samples, samples)).grid(lens, size)
    fine = polar_sample(
        image, grid.radii, grid.azimuths, grid.center, samples=(samples, samples), layout="image"
    )
    polar = avg_pool2d(fine, samples).permute(0, 2, 3, 1).contiguous()
    middle = PolarView(rings=rings, sectors=sectors, samples=(1, 1)).grid(lens, size).radii
    return polar_to_image(polar, middle, grid.center, size, r_max=lens.r_max)


def regions(size: int, seed: int) -> Tensor:
    """Labels (size, size): cells around random points, each of a random class."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(REGIONS, 2, generator=generator) * size
    classes = torch.randint(CLASSES, (REGIONS,), generator=generator)
    return classes[torch.cdist(places(size), points).argmin(1)].reshape(size, size)


def places(size: int) -> Tensor:
    """x and y of all pixels, (size², 2)."""
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return torch.stack((x, y), -1).reshape(-1, 2).float()


def mean_iou(truth: Tensor, found: Tensor) -> float:
    """Over the classes that are there."""
    scores = []
    for k in truth.unique():
        both, either = (truth == k) & (found == k), (truth == k) | (found == k)
        scores.append((both.sum() / either.sum()).item())
    return statistics.mean(scores)


def four_nearest(
    size: int = 64, rings: int = 400, sectors: int = 256
) -> tuple[float, float, float]:
    """A smooth field's mean error where pixels are bilinear in a polar map, and where they are the
    mean of the four samples that are nearest; and which share of all samples those are."""
    lens = Spherical.from_fov(0.5, math.radians(175), size / 2)
    grid = PolarView(rings=rings, sectors=sectors, samples=(1, 1)).grid(lens, (size, size))
    x, y = (
        grid.radii[0][:, None] * grid.azimuths.cos(),
        grid.radii[0][:, None] * grid.azimuths.sin(),
    )
    samples = torch.stack((x, y), -1) + grid.center[0]
    seen = ~pixel_angles(lens, (size, size))[0].isnan().flatten()
    pixels = places(size)
    truth = field(pixels, size)
    polar = field(samples, size)
    bilinear = polar_to_image(
        polar[None, ..., None], grid.radii, grid.center, (size, size)
    ).flatten()
    flat = samples.reshape(-1, 2)
    parts = [torch.cdist(part, flat).topk(4, largest=False).indices for part in pixels.split(256)]
    nearest = torch.cat(parts)
    mean = polar.flatten()[nearest].mean(1)
    errors = ((found - truth)[seen].abs().mean().item() for found in (bilinear, mean))
    return *errors, nearest[seen].unique().numel() / (rings * sectors)


def field(place: Tensor, size: int) -> Tensor:
    """A smooth function of x and y (…, 2), px, in [-1, 1]."""
    return torch.sin(place[..., 0] * 9 / size) * torch.cos(place[..., 1] * 7 / size)


if __name__ == "__main__":
    main()
