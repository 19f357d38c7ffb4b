"""Directions in a camera's frame: what is up, and where a view looks."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from darswin.utils.angles import check_turn, unit_vector
from darswin.utils.arrays import as_tensor

Vector = Sequence[float] | Tensor


def up_of(
    roll: float = 0.0, pitch: float = 0.0, *, extrinsics: Tensor | Sequence | None = None,
    world_up: Vector = (0.0, 0.0, 1.0),
) -> tuple[float, float, float]:  # fmt: skip
    """The direction away from gravity in a camera's frame, for the argument `up` of views.

    Args:
        roll: the angle by which the camera is turned clockwise about its optical axis, as seen from
            behind it, in [-2π, 2π] rad.
        pitch: the angle by which the optical axis is raised above the horizon, in [-2π, 2π] rad.
        extrinsics: in place of roll and pitch, the rotation (3, 3) or pose (3 or 4, 4) that takes
            vectors of the camera to the world's or the vehicle's frame.
        world_up: the direction away from gravity in that frame.

    Raises:
        ValueError: an angle is out of range, roll and pitch are given with extrinsics, or these
            hold no rotation.
    """
    check_turn("roll", roll)
    check_turn("pitch", pitch)
    if extrinsics is None:
        level = math.cos(pitch)
        up = (-level * math.sin(roll), -level * math.cos(roll), math.sin(pitch))
        return unit_vector("up", up)
    if roll or pitch:
        raise ValueError("give either extrinsics, or roll and pitch")
    pose = as_tensor(extrinsics, torch.float64)
    shape = tuple(pose.shape)
    rotation = pose[:3, :3] if shape in ((3, 3), (3, 4), (4, 4)) else pose.new_zeros(3, 3)
    turns = torch.allclose(rotation @ rotation.T, torch.eye(3).double(), atol=1e-4)
    if not (turns and torch.linalg.det(rotation) > 0):
        raise ValueError(f"extrinsics must be a rotation (3, 3) or a pose (4, 4), got {extrinsics}")
    above = torch.tensor(unit_vector("world_up", world_up), dtype=torch.float64)
    return unit_vector("up", rotation.T @ above)


def turned(yaw: float = 0.0, pitch: float = 0.0) -> dict[str, Any]:
    """The options `up` and `direction` of a view that looks `yaw` to the right and `pitch` up.

    The view is pitched about the camera's x axis first, and then turned about its y axis. Give the
    `direction` alone to a view that stays level with another `up`.

    Args:
        yaw, pitch: in [-2π, 2π] rad.
    """
    check_turn("yaw", yaw)
    check_turn("pitch", pitch)
    ahead, above = math.cos(pitch), math.sin(pitch)
    right, forward = math.sin(yaw), math.cos(yaw)
    return dict(
        up=(-above * right, -ahead, -above * forward),
        direction=(ahead * right, -above, ahead * forward),
    )
