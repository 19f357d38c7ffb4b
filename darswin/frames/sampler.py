"""The sampler, which reads frames at the places of a plan."""

import os
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from darswin.frames.compiled import frames
from darswin.frames.plan_files import read_plan
from darswin.frames.plans import Plan
from darswin.frames.rig_plans import RigPlan
from darswin.utils.named import in_order


class Sampler:
    """Samples frames at the points of a plan: `sampler(frame, out=None, threads=1)`.

    A call takes a frame of uint8, (H, W, 3) or (H, W), in any memory layout, so that
    `frame[..., ::-1]` turns OpenCV's BGR into RGB at no cost. With a plan of several cameras, it
    takes a list of their frames in the order of `plan.names`, or a mapping from these names, in
    any order; each frame may have a layout of its own. It returns the plan's `output`. It runs
    without Python's lock, and several threads may call one sampler.

    `out` is an array for the result: C-contiguous, with its shape and type, and in other memory
    than the frames. `threads` is the most threads to use; small plans use fewer. The result does
    not depend on it. The tokens and the polar image are those of `darswin.ops.polar_sample`, bit
    for bit.

    Args:
        plan: a `Plan` or a `RigPlan`, or its file.

    Raises:
        TypeError: in a call, a frame is no array of uint8, or several are neither a list nor a
            mapping.
        ValueError: the plan is damaged; in a call, a frame or `out` does not fit the plan, they
            share memory, a frame is missing or has an unknown name, or not all have as many
            channels.
        OSError: the file cannot be read.
    """

    def __init__(self, plan: Plan | RigPlan | str | os.PathLike):
        if not isinstance(plan, Plan | RigPlan):
            plan = cast(Plan | RigPlan, read_plan(plan, Plan, RigPlan))
        scale = [1 / (255 * std) for std in plan.std]
        offset = [-mean / std for mean, std in zip(plan.mean, plan.std, strict=True)]
        places = plan.columns, plan.rows, plan.right, plan.lower
        try:
            if isinstance(plan, Plan):
                self._sample = frames.sampler(
                    *places, plan.size, scale, offset, plan.output, plan.supersampling
                )
            else:
                self._sample = frames.rig_sampler(
                    plan.counts, plan.sources, *places, plan.weights, plan.sizes, plan.names,
                    scale, offset, plan.output,
                )  # fmt: skip
        except TypeError as error:
            raise ValueError("the parts of the plan do not fit together") from error
        self.plan = plan

    def __call__(
        self,
        frame: np.ndarray | Sequence[np.ndarray] | Mapping[str, np.ndarray],
        out: np.ndarray | None = None,
        threads: int = 1,
    ) -> np.ndarray:
        if isinstance(self.plan, RigPlan):
            frame = in_order(frame, self.plan.names)
        return self._sample(frame, out, threads)
