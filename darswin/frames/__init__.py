"""Frames of a camera as NumPy arrays, without torch: sampled for a network, or run through it.

`export` writes a network for the frames of one calibrated camera, once, with torch. `Network` runs
it, and its imports are NumPy alone:

    darswin.frames.export(model, lens, (1080, 1920), "camera.npz")  # once

    network = darswin.frames.Network("camera.npz")  # in the camera's program
    probabilities = network(frame)

For another network behind the same sampling, or for a view of the frames, `plan` finds the places
at which the frames are read, and `Sampler` reads them there:

    darswin.frames.plan(model, lens, (1080, 1920)).save("plan.npz")  # once

    tokens = darswin.frames.Sampler("plan.npz")(frame)

A graph that `export_onnx(..., input="tokens")` wrote takes the tokens, with a batch axis in front.
"""

from darswin.frames.network import Network, export
from darswin.frames.plans import Plan, Sampler, plan

__all__ = ["Network", "Plan", "Sampler", "export", "plan"]
