"""Tests of the kernels in `darswin.ops.triton`. They run on a CUDA device (`make test-gpu`), or
without one in Triton's interpreter on the CPU (`make test-triton`)."""

import dataclasses
import os
import warnings

import pytest
import torch

from darswin.ops import triton


@pytest.fixture(scope="session")
def device():
    """The device of the kernels. In the interpreter the kernels replace the CPU's operators. Tests
    must not pass arguments that a kernel does not support (`kernel_takes` of `_library.run`)."""
    if not triton.INSTALLED:
        pytest.skip("triton is not installed; `make test-triton` puts it into a folder of its own")
    if torch.cuda.is_available():
        yield torch.device("cuda")
        return
    if os.environ.get("TRITON_INTERPRET") != "1":
        pytest.skip("no CUDA device, and TRITON_INTERPRET=1 is not set, as `make test-triton` does")
    from triton.runtime.interpreter import interpreter_builder as builder

    # The interpreter multiplies in float32 at any precision, but does not know the name "bf16x3".
    names = (*builder.options.allowed_dot_input_precisions, "bf16x3")
    builder.options = dataclasses.replace(builder.options, allowed_dot_input_precisions=names)
    library = torch.library.Library("darswin", "IMPL")
    with warnings.catch_warnings(action="ignore"):  # torch warns about each replaced operator
        for operator in triton.LAUNCHERS:
            library.impl(operator, triton.launcher(operator), "CPU", allow_override=True)
    yield torch.device("cpu")
    library._destroy()
