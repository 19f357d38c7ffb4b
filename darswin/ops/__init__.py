"""The operators.

On the CPU they run compiled code. On other devices, within `use_reference`, and where the compiled
module cannot be loaded, they run the PyTorch reference.

They use as many threads as torch. Outside of training these are not the threads of torch, and a
forked process may call them.
"""

from darswin.ops._library import use_reference
from darswin.ops._module import cpu_capability
from darswin.ops.polar_sample import polar_sample
from darswin.ops.polar_to_image import polar_to_image, polar_to_image_plan
from darswin.ops.window_attention import window_attention

__all__ = [
    "cpu_capability",
    "polar_sample",
    "polar_to_image",
    "polar_to_image_plan",
    "use_reference",
    "window_attention",
]
