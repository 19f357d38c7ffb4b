"""The pictures of the sizes study: textured balls of one size before a textured background.

Nothing but the angular size of a ball reveals its distance. There is no ground, no shading and no
shadow. The textures are painted on the directions from the camera, so their scale is independent of
the distance.
"""

import math
from collections.abc import Callable

import numpy as np
import torch

from darswin.lens import DoubleSphere, Equisolid, KannalaBrandt, Lens, Perspective, Spherical
from darswin.lens.curves import as_curves

SIZE = 64  # px, of the square pictures
SUBPIXELS = 3  # rays along each side of a pixel
BALL = 0.5  # m, the radius of a ball
DISTANCES = 1.2, 6.0  # m, to the centres of the balls
DENSITY = 3.0  # balls per steradian, on average
LEAST_PIXELS = 4  # the distance of a ball that covers fewer pixels is unknown
WAVES = 4  # plane waves in a texture
WAVE_NUMBERS = 5.0, 40.0  # rad per rad

FOVS, XI = (150.0, 165.0), (0.2, 0.35)  # of the training lenses: degrees, and ξ


def spherical(fov_deg: float, xi: float) -> Lens:
    """A spherical lens whose field of view fills the circle in the picture."""
    return Spherical.from_fov(xi, math.radians(fov_deg), SIZE / 2)


def perspective() -> Lens:
    """A perspective lens of 90° from side to side. It sees up to the corners."""
    lens = Perspective.from_fov(math.pi / 2, SIZE / 2)
    return lens.with_theta_max(math.atan(math.sqrt(2)))


def filling(lens: Lens, fov_deg: float) -> Lens:
    """The lens, resized so that a field of view fills the circle in the picture."""
    lens = lens.with_theta_max(math.radians(fov_deg) / 2)
    return lens.resized(SIZE / 2 / lens.r_max.item())


# The test sets with one lens. The lenses of the set "own" are drawn like those of training.
OWN, TRAIN = "own", "train"
LENSES: dict[str, Callable[[], Lens]] = {
    "perspective": perspective,
    "100°": lambda: spherical(100, 0.275),
    "140°": lambda: spherical(140, 0.275),
    "190°": lambda: spherical(190, 0.35),
    "Kannala-Brandt": lambda: filling(KannalaBrandt(30.0, [0.05, -0.01, 0.001]), 160),
    "double sphere": lambda: filling(DoubleSphere(-0.2, 0.55, 30.0), 160),
    "equisolid": lambda: filling(Equisolid(30.0), 160),
}


def lenses_of(name: str, count: int) -> Lens:
    """The lenses of the pictures of a set: one lens, or `count` lenses."""
    if name in LENSES:
        return LENSES[name]()
    rng = np.random.default_rng(0 if name == OWN else 1)  # OWN or TRAIN
    fov, xi = (torch.from_numpy(rng.uniform(*ends, count)).float() for ends in (FOVS, XI))
    return Spherical.from_fov(xi, torch.deg2rad(fov), SIZE / 2)


def with_angles_scaled(lens: Lens, factor: float) -> Lens:
    """A wrong lens: each pixel's angle from the axis is multiplied by `factor`."""
    curves = as_curves(lens)
    return curves.replace(
        angles=curves.angles * factor,
        slopes=curves.slopes / factor,
        theta_max=curves.theta_max * factor,
    )


# -- pictures ---------------------------------------------------------------------------------


def rays_of(lens: Lens) -> np.ndarray:
    """The directions (3·SIZE, 3·SIZE, 3) of the rays of all pixels; NaN beyond θ_max."""
    side = torch.arange(SUBPIXELS * SIZE, dtype=torch.float32)
    side = (side - (SUBPIXELS - 1) / 2) / SUBPIXELS
    pixels = torch.stack(torch.meshgrid(side, side, indexing="xy"), -1)
    return lens.unproject_points(pixels[None], (SIZE, SIZE))[0].numpy()


def random_directions(rng: np.random.Generator, theta_max: float, count: int) -> np.ndarray:
    """Unit vectors (count, 3), equally frequent in each solid angle up to `theta_max`."""
    cos = rng.uniform(math.cos(theta_max), 1, count)
    sin, azimuth = np.sqrt(1 - cos**2), rng.uniform(0, 2 * math.pi, count)
    return np.stack((sin * np.cos(azimuth), sin * np.sin(azimuth), cos), 1).astype(np.float32)


def texture(rng: np.random.Generator, rays: np.ndarray, background: bool) -> np.ndarray:
    """Random smooth colours (P, 3) at directions (P, 3): dark grey, or bright colours of balls."""
    lowest, highest = np.log(WAVE_NUMBERS)
    scale = math.exp(rng.uniform(lowest, highest))
    waves = random_directions(rng, math.pi, WAVES) * rng.uniform(0.5, 1.5, (WAVES, 1)) * scale
    phases = rng.uniform(0, 2 * math.pi, WAVES)
    if background:
        mean, strengths = rng.uniform(0.15, 0.35), rng.normal(0, 0.04, (WAVES, 1)) * np.ones(3)
    else:
        mean, strengths = (
            rng.permutation([1, *rng.uniform(0.3, 1, 2)]),
            rng.normal(0, 0.08, (WAVES, 3)),
        )
    angles = rays @ waves.T.astype(np.float32) + phases.astype(np.float32)
    return mean + np.sin(angles) @ strengths.astype(np.float32)


def picture(
    rng: np.random.Generator, rays: np.ndarray, theta_max: float
) -> tuple[np.ndarray, np.ndarray]:
    """A random picture (H, W, 3) uint8 and the distances (H, W) along the rays of the pixels, m.

    The distance is 0 where it is unknown: off the balls, and on balls of few pixels.
    """
    seen = np.flatnonzero(~np.isnan(rays[..., 0]))
    directions = rays.reshape(-1, 3)[seen]
    colours = texture(rng, directions, background=True)
    count = max(1, rng.poisson(DENSITY * 2 * math.pi * (1 - math.cos(theta_max))))
    nearest, farthest = DISTANCES
    # Far balls are more frequent, so that all distances have about the same number of pixels.
    centers = np.sqrt(rng.uniform(nearest**2, farthest**2, count))
    depth = np.full(len(seen), np.inf, np.float32)
    ball_of = np.full(len(seen), -1, np.int32)
    middles = random_directions(rng, theta_max, count)
    for ball, (middle, center) in enumerate(zip(middles, centers, strict=True)):
        cosines = directions @ middle
        hit = np.flatnonzero(cosines > math.sqrt(1 - (BALL / center) ** 2))
        along = center * cosines[hit]
        near = along - np.sqrt(np.maximum(along**2 - center**2 + BALL**2, 0))
        first = near < depth[hit]
        hit = hit[first]
        depth[hit], ball_of[hit] = near[first], ball
        colours[hit] = texture(rng, directions[hit], background=False)
    fine = np.zeros((rays.shape[0] * rays.shape[1], 3), np.float32)
    fine[seen] = colours.clip(0, 1)
    blocks = fine.reshape(SIZE, SUBPIXELS, SIZE, SUBPIXELS, 3)
    image = (255 * blocks.mean((1, 3)) + 0.5).astype(np.uint8)
    return image, _distances(seen, depth, ball_of, rays.shape[:2])


def _distances(
    seen: np.ndarray, depth: np.ndarray, ball_of: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """The distances at the centres of the pixels, without balls that cover few pixels."""
    balls, distance = np.full(size, -1, np.int32), np.zeros(size, np.float32)
    balls.flat[seen] = ball_of
    distance.flat[seen] = np.where(ball_of < 0, 0, depth)
    middle = slice(SUBPIXELS // 2, None, SUBPIXELS)
    balls, distance = balls[middle, middle], distance[middle, middle]
    pixels = np.bincount(balls.ravel() + 1, minlength=ball_of.max(initial=0) + 2)
    return np.where(pixels[balls + 1] < LEAST_PIXELS, 0, distance).astype(np.float32)


def pictures(name: str, count: int, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """The pictures `first` to `last` of the `count` of a set: images uint8 (N, H, W, 3) and
    distances float16 (N, H, W)."""
    lenses = lenses_of(name, count)
    rays, made = rays_of(lenses[0]), []
    for index in range(first, last):
        lens = lenses[index] if len(lenses) > 1 else lenses
        if len(lenses) > 1:
            rays = rays_of(lens)
        rng = np.random.default_rng([index, *name.encode()])
        made.append(picture(rng, rays, lens.theta_max.item()))
    images, distances = zip(*made, strict=True)
    return np.stack(images), np.stack(distances).astype(np.float16)
