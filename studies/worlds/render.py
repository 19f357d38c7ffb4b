"""A picture of a world through a lens, with the label and the distance of each pixel."""

from typing import NamedTuple

import numpy as np
import torch

from darswin.lens import Lens
from worlds.poses import Pose
from worlds.scene import NOTHING, Scene

SAMPLES = 3  # per pixel and axis; odd, so that one sample is the centre
GLOW, REACH = 0.35, 4.0  # the light of the player's lamp, and the distance, m, of half of it


class View(NamedTuple):
    """Attributes: image: (H, W, 3) uint8, sRGB; labels: (H, W) uint8, 255 for none; distance:
    (H, W) float32, m along the ray, 0 for unknown: sky, and beyond θ_max."""

    image: np.ndarray
    labels: np.ndarray
    distance: np.ndarray


def rays_of(lens: Lens, samples: int = SAMPLES) -> np.ndarray:
    """Unit vectors (H, W, samples², 3) in the camera's frame through the samples of each pixel; NaN
    without a ray. The middle sample is the centre of the pixel."""
    height, width = (round(side) for side in lens.image_size[0].tolist())
    part = (np.arange(samples) + 0.5) / samples - 0.5
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    dy, dx = (d.ravel() for d in np.meshgrid(part, part, indexing="ij"))
    pixels = np.stack((x[..., None] + dx, y[..., None] + dy), -1)
    with torch.no_grad():
        return lens.to(torch.float64).unproject_points(torch.from_numpy(pixels)[None])[0].numpy()


def render(scene: Scene, pose: Pose, rays: np.ndarray) -> View:
    """The view of a camera at a pose along `rays_of` a lens.

    The ray through the centre of a pixel gives its label and distance. The colour is the mean of
    all rays of the pixel in linear light. Pixels without a ray are black.
    """
    height, width, samples, _ = rays.shape
    flat = rays.reshape(-1, 3)
    seen = ~np.isnan(flat[:, 0])
    hits = scene.cast(pose.position, flat[seen] @ pose.rotation.T)
    light = np.zeros(flat.shape, np.float32)
    light[seen] = to_linear(shaded(hits.colour, hits.light, hits.distance))
    label = np.full(len(flat), NOTHING, np.uint8)
    label[seen] = hits.label
    distance = np.zeros(len(flat), np.float32)
    distance[seen] = np.where(np.isfinite(hits.distance), hits.distance, 0)
    image = to_srgb(light.reshape(height, width, samples, 3).mean(2))
    of_centre = (height, width, samples), (..., samples // 2)
    return View(image, *(a.reshape(of_centre[0])[of_centre[1]] for a in (label, distance)))


def shaded(colour: np.ndarray, light: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Texels (N, 3) in the light of their place and of the player's lamp, which fades, as uint8."""
    level = light + np.where(np.isfinite(distance), GLOW / (1 + distance / REACH), 0)
    return np.round(colour * np.clip(level, 0, 1)[:, None]).astype(np.uint8)


_LEVELS = np.arange(256) / 255
_LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB uint8 → linear light in 0..1, float32 (IEC 61966-2-1)."""
    return _LINEAR.astype(np.float32)[srgb]


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light in 0..1 → sRGB uint8, the inverse of `to_linear`."""
    low, high = linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.round(255 * np.where(linear <= 0.0031308, low, high)).clip(0, 255).astype(np.uint8)
