import pytest
import torch


@pytest.fixture
def device():
    """The device of the operators. tests/gpu runs some of these tests on a CUDA device."""
    return torch.device("cpu")
