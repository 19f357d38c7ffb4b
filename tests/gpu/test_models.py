"""Whole models on a CUDA device: eager, compiled and as CUDA graphs. `make test-gpu` runs them."""

import copy

import pytest
import torch

from darswin import create_model, lens

MODELS = ["darswin_a_nano", "darswin_ra_nano", "swin_nano"]


@pytest.fixture
def cuda(device):
    if device.type != "cuda":
        pytest.skip("no CUDA device")
    return device


def make(name, device):
    """A model in eval mode, pictures and their lens, all on the device."""
    model = create_model(name, num_classes=7).to(device).eval()
    images = torch.randn(3, 3, 64, 64, device=device)
    return model, images, lens.Spherical.from_fov(xi=0.5, fov=2.9, radius=32).to(device)


def gradients(model, images, view):
    model.zero_grad()
    model(images, view).square().sum().backward()
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("name", MODELS)
def test_logits_and_gradients_are_those_of_the_cpu_in_any_run(name, cuda):
    model, images, view = make(name, cuda)
    there = copy.deepcopy(model).cpu(), images.cpu(), view.to("cpu")
    with torch.no_grad():
        torch.testing.assert_close(model(images, view).cpu(), there[0](*there[1:]), rtol=1e-3,
                                   atol=1e-4)  # fmt: skip
    ours, expected = gradients(model, images, view), gradients(*there)
    assert ours.keys() == expected.keys()
    for key, want in expected.items():
        size = want.abs().max().item()
        torch.testing.assert_close(ours[key].cpu(), want, rtol=1e-2, atol=1e-3 * size, msg=key)
    again = gradients(model, images, view)
    assert all(torch.equal(ours[key], again[key]) for key in ours)


@pytest.mark.parametrize("mode", ["default", "reduce-overhead"])
def test_compiled(mode, cuda):
    model, images, view = make("darswin_a_nano", cuda)
    torch._dynamo.reset()
    compiled = torch.compile(model, mode=mode, dynamic=False)
    with torch.no_grad():
        expected = model(images, view)
        for _ in range(3):  # the second call records the graph, and the third call replays it
            torch.testing.assert_close(compiled(images, view), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_cuda_graphs(dtype, cuda):
    model, images, view = make("darswin_a_nano", cuda)
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    with torch.no_grad(), torch.autocast("cuda", dtype, enabled=dtype != torch.float32):
        with torch.cuda.stream(stream):  # compiles the kernels
            model(images, view)
        torch.cuda.current_stream().wait_stream(stream)
        with torch.cuda.graph(graph):
            out = model(images, view)
        images.copy_(torch.randn_like(images))
        graph.replay()
        torch.testing.assert_close(out, model(images, view), rtol=0, atol=0)
