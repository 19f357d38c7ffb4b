"""The kernels of `darswin.ops.triton`: on a CUDA device where there is one (`make test-gpu`), else
in Triton's interpreter, on the CPU (`make test-triton`)."""

import dataclasses
import os
import warnings

import pytest
import torch

from darswin.ops import triton


@pytest.fixture(scope="session")
def device():
    """Where the kernels run. In the interpreter they stand in for the CPU's operators: tests must
    not give them arguments that they do not take on a device (`kernel_takes` of `_library.run`)."""
    if not triton.INSTALLED:
        pytest.skip("triton is not installed; `make test-triton` puts it into a folder of its own")
    if torch.cuda.is_available():
        yield torch.device("cuda")
        return
    if os.environ.get("TRITON_INTERPRET") != "1":
        pytest.skip("no CUDA device, and TRITON_INTERPRET=1 is not set, as `make test-triton` does")
    from triton.runtime.interpreter import interpreter_builder as builder

    # It multiplies in float32 whatever the precision, but does not know all of a GPU's names.
    names = (*builder.options.allowed_dot_input_precisions, "bf16x3")
    builder.options = dataclasses.replace(builder.options, allowed_dot_input_precisions=names)
    library = torch.library.Library("darswin", "IMPL")
    with warnings.catch_warnings(action="ignore"):  # torch tells of each that it is replaced
        for operator in triton.LAUNCHERS:
            library.impl(operator, triton.launcher(operator), "CPU", allow_override=True)
    yield torch.device("cpu")
    library._destroy()
