"""polar_embed on CUDA devices: the kernels of polar_sample, and torch's products.

Two launches forward in float32. The samples are float32, whatever the output; backward makes them
again. Products are torch's, so `torch.backends.cuda.matmul` says how exact they are.
"""

from typing import Any

from torch import Tensor

from darswin.ops import reference
from darswin.ops._library import autocast_off
from darswin.ops._sampling import Sampling
from darswin.ops.triton import polar_sample


def _samples(sampling: Sampling) -> Tensor:
    """(B·R·A, S_r·S_φ·C): a matrix, since torch adds the bias of such a product as it goes."""
    return polar_sample.forward(sampling._replace(bfloat16=False), tokens=True).flatten(0, 2)


def polar_embed(*arguments: Any) -> Tensor:
    """`darswin::polar_embed`."""
    *fields, weight, bias = arguments
    sampling = Sampling(*fields)
    with autocast_off(weight.device.type):
        out = reference.embedded(_samples(sampling), sampling, weight, bias)
    return out.view(*sampling.map_size(), len(weight))


def polar_embed_backward(*arguments: Any) -> tuple[Tensor, ...]:
    """`darswin::polar_embed_backward`."""
    *fields, weight, grad_out, image_grad, lens_grad, offsets_grad, weight_grad = arguments
    sampling = Sampling(*fields)
    wanted = image_grad, lens_grad, offsets_grad
    with autocast_off(weight.device.type):
        grad = grad_out.float().flatten(0, 2)
        gradients = sampling.new_gradients(*wanted)
        if any(wanted):
            of_samples = grad @ weight.float()
            gradients = polar_sample.backward(sampling, True, of_samples, *wanted)
        if not weight_grad:
            return *gradients, grad.new_empty((0,)), grad.new_empty((0,))
        return *gradients, grad.t() @ _samples(sampling), grad.sum(0)
