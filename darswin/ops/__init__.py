"""The operators: compiled on CPU, in Triton on CUDA devices where it is installed, the PyTorch
reference elsewhere and within `use_reference`.

They run on torch's number of threads. A process that is forked after such a call must not make
another one on several: use `spawn`, or `torch.set_num_threads(1)` in the child.
"""

from darswin.ops import triton
from darswin.ops._library import reference_in_use, use_reference
from darswin.ops._module import cpu_capability
from darswin.ops.polar_sample import polar_embed, polar_sample
from darswin.ops.polar_to_image import polar_to_image
from darswin.ops.window_attention import window_attention

triton.register()

__all__ = [
    "cpu_capability",
    "polar_embed",
    "polar_sample",
    "polar_to_image",
    "reference_in_use",
    "use_reference",
    "window_attention",
]
