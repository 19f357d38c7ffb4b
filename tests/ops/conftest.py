import pytest
import torch


@pytest.fixture
def device():
    """Where the operators run: tests/gpu runs some of these tests on a CUDA device."""
    return torch.device("cpu")
