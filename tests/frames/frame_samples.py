"""Random frames and small networks for tests of darswin.frames, and bilinear samples by NumPy."""

import math
from pathlib import Path

import numpy as np
import torch
from torch import nn

from darswin import create_model, frames
from darswin.deploy import camera
from darswin.deploy.quantize import quantize_model
from darswin.lens import Equidistant

MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.25, 0.3)
ROUND = Equidistant.from_fov(3.0, 24.0)


def random_frame(height, width, *channels, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (height, width, *channels), dtype=np.uint8)


def in_layout(frame, kind):
    """The same frame in another memory layout."""
    if kind == "flipped":
        return np.ascontiguousarray(frame[::-1, ::-1])[::-1, ::-1]
    if kind == "gaps":
        room = np.zeros((frame.shape[0] * 2, frame.shape[1] + 5, *frame.shape[2:]), np.uint8)
        room[1::2, 3:-2] = frame
        return room[1::2, 3:-2]
    if kind == "bgr" and frame.ndim == 3:
        return np.ascontiguousarray(frame[..., ::-1])[..., ::-1]
    if kind == "planes" and frame.ndim == 3:
        return np.ascontiguousarray(frame.transpose(2, 0, 1)).transpose(1, 2, 0)
    return np.asfortranarray(frame) if kind == "turned" else frame


LAYOUTS = ("plain", "flipped", "gaps", "bgr", "planes", "turned")


def bilinear(image, x, y):
    """Bilinear samples of (H, W, C) in float64, with 0 outside."""
    padded = np.pad(image.astype(np.float64), ((2, 2), (2, 2), (0, 0)))
    x, y = np.clip(x, -2, image.shape[1]) + 2, np.clip(y, -2, image.shape[0]) + 2
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    column, row = np.minimum(column, padded.shape[1] - 2), np.minimum(row, padded.shape[0] - 2)
    right, lower = (x - column)[..., None], (y - row)[..., None]
    top = padded[row, column] * (1 - right) + padded[row, column + 1] * right
    bottom = padded[row + 1, column] * (1 - right) + padded[row + 1, column + 1] * right
    return top * (1 - lower) + bottom * lower


def by_numpy(plan, frame):
    """The mean of bilinear samples in float64, with normalized zeros outside of the frame."""
    pixels = frame.reshape(*frame.shape[:2], -1).astype(np.float64)
    if plan.output != "uint8":
        pixels = (pixels / 255 - np.array(plan.mean)) / np.array(plan.std)
    right, lower = plan.right.astype(float), plan.lower.astype(float)
    found = bilinear(pixels, plan.columns + right, plan.rows + lower)
    if plan.supersampling > 1:
        found = found.mean(-2)
    if plan.output == "image":
        return np.moveaxis(found, -1, -3)
    if plan.output == "tokens":
        return found.reshape(*found.shape[:2], math.prod(found.shape[2:]))
    return found if frame.ndim == 3 else found[..., 0]


def model_of(family="darswin_a", channels=3, *, size="nano", **options):
    """A model of a family whose signal neither grows nor dies."""
    torch.manual_seed(0)
    if family.startswith("swin_unet"):
        options = dict(image_size=64) | options
    mean, std = (MEAN, STD) if channels == 3 else (0.4, 0.2)
    options = dict(num_classes=10, mean=mean, std=std, in_chans=channels) | options
    model = create_model(f"{family}_{size}", **options).eval()
    for layer in model.modules():
        if isinstance(layer, nn.Linear):
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5)
    for name, parameter in model.named_parameters():
        if parameter.dim() == 1 or ".position_bias." in name:  # norms too
            parameter.data += 0.1 * torch.randn_like(parameter)
    return model


def size_of(model):
    return model.image_size or ((64, 64) if model.square_images else (70, 80))


def quantized_of(model):
    pictures = torch.from_numpy(random_frame(*size_of(model), 3, 2)).permute(3, 2, 0, 1)
    return quantize_model(model, [(pictures, ROUND)])


def network_of(model, folder, lens=ROUND, **options):
    path = Path(folder, "camera.safetensors")
    camera.export_network(model, lens, size_of(model), path, **options)
    return frames.Network(path)
