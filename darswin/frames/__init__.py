"""Frames of a camera as NumPy arrays, without torch: sampled for a network, or run through it.

`export_network` writes a network for the frames of one calibrated camera, once, with torch.
`Network` runs it, and its imports are NumPy alone:

    darswin.deploy.camera.export_network(model, lens, (1080, 1920), "camera.safetensors")  # once

    network = darswin.frames.Network("camera.safetensors")  # in the camera's program
    probabilities = network(frame)

For another network behind the same sampling, or for a view of the frames, `plan` finds the places
at which the frames are read, and `Sampler` reads them there:

    darswin.deploy.camera.plan(model, lens, (1080, 1920)).save("plan.safetensors")  # once

    tokens = darswin.frames.Sampler("plan.safetensors")(frame)

A graph that `export_onnx(..., input="tokens")` wrote takes the tokens, with a batch axis in front.
`darswin.frames.onnx` runs other people's networks.
"""

from darswin.frames.network import Network
from darswin.frames.plans import Plan
from darswin.frames.sampler import Sampler

__all__ = ["Network", "Plan", "Sampler"]
