import pytest
import torch
import torch.nn.functional as F
from darswin.layers.recompute import recomputed
from torch import nn
from torch.multiprocessing.reductions import StorageWeakRef

from darswin import create_model
from darswin.lens import Spherical

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def gradients(model, images, half):
    model.zero_grad()
    torch.manual_seed(0)  # of jitter and drop path
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        out = model(images, LENSES)
    out.float().square().sum().backward()
    return [p.grad.clone() for p in model.parameters()]


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("name", ["darswin_a_nano", "swin_nano", "dat_nano"])
def test_gradients_are_the_same_bit_for_bit(name, half):
    model = create_model(name, num_classes=10, drop_path_rate=0.2).train()
    images = torch.randn(2, 3, 32, 32)
    want = gradients(model, images, half)
    model.set_grad_checkpointing(True)
    for got, expected in zip(gradients(model, images, half), want, strict=True):
        assert torch.equal(got, expected)


@pytest.mark.parametrize("when", [True, False])
def test_the_value_is_not_kept_but_made_again(when):
    linear, calls = nn.Linear(8, 8), []
    hidden = torch.randn(3, 5, 8, requires_grad=True)

    def gelu(x):
        calls.append(x.requires_grad)
        return F.gelu(x)

    value = gelu(hidden)
    memory = StorageWeakRef(value.untyped_storage())
    with recomputed(value, gelu, hidden, when=when):
        out = linear(value)
    del value
    # Freed, but for what the GELU's own node needs, which is `hidden`.
    assert memory.expired() == when
    out.sum().backward()
    assert calls == [True, False] if when else calls == [True]
    torch.testing.assert_close(linear.weight.grad, F.gelu(hidden.detach()).sum((0, 1)).expand(8, 8))


def test_other_tensors_are_kept():
    hidden, other = torch.randn(2, 6, requires_grad=True), torch.randn(2, 6, requires_grad=True)
    value = F.gelu(hidden)
    with recomputed(value, F.gelu, hidden, when=True):
        (value * other * value[:, :6]).sum().backward()
    exact = F.gelu(hidden.detach())
    torch.testing.assert_close(other.grad, exact.square())


def test_compiled_and_without_gradients_it_does_nothing():
    model = create_model("darswin_a_nano", num_classes=10).eval()
    images = torch.randn(2, 3, 32, 32)
    with torch.no_grad():
        want = model(images, LENSES)
        model.set_grad_checkpointing(True)
        assert torch.equal(model(images, LENSES), want)
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(images, LENSES), want)
