"""Programs that are written by a network's own forward: what torch computes is the oracle."""

import pytest
import torch
import torch.nn.functional as F
from helpers import network, refused, relative_error
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from darswin import optimize
from darswin.deploy.own import OwnLinear, OwnNorm, packed_weights
from darswin.deploy.program import Weights
from darswin.deploy.record import traced
from darswin.lens import Spherical
from darswin.lens.pixels import sample_at
from darswin.models.pixel import distances


def run(forward, *images, for_file=False):
    """What the program of a function computes of images (B, ...)."""
    weights, (x, *more) = Weights(), images
    pixels = tuple(more[0].shape[1:]) if more else None
    trace = traced(nn.Identity(), forward, weights, x.shape[1:], None, pixels, for_file=for_file)
    inputs = [x, *more]
    if more and for_file:
        inputs[1] = more[0].permute(0, 2, 3, 1).contiguous()
    return trace.returned(trace.program.checked()([*inputs, *trace.given]))


CONV, CONV2 = nn.Conv2d(3, 5, 3, padding=1), nn.Conv2d(5, 5, 3, padding=1)
LINEAR, NORM = nn.Linear(6, 7), nn.LayerNorm(6)
OWN_LINEAR, OWN_NORM = OwnLinear(packed_weights(LINEAR), 7), OwnNorm(NORM)
PLACE = torch.randn(1, 4, 6, 6)
WIDE = torch.randn(1, 5, 4, 6)
POINTS = torch.rand(1, 3, 4, 2) * 6 - 1


def split(x, linear=lambda x: x):
    """Tokens (1, 4, 6, 12) each as two below each other, as in a decoder."""
    x = x.unflatten(3, (2, 6)).permute(0, 1, 3, 2, 4).flatten(1, 2)
    return linear(x)


TOKENS = {  # functions of tokens (1, 4, 6, 6), of ours and of torch
    "linear": (OWN_LINEAR, LINEAR),
    "norm": (OWN_NORM, NORM),
    "linear of other rows": (
        lambda x: OWN_LINEAR(x.transpose(1, 2)), lambda x: LINEAR(x.transpose(1, 2)),
    ),
    "norm of other columns": (
        lambda x: OWN_NORM(x.transpose(2, 3)), lambda x: NORM(x.transpose(2, 3)),
    ),
    "norm of a part": (lambda x: OWN_NORM(x[:, 1:3]), lambda x: NORM(x[:, 1:3])),
    "norm, whose map is read later": (
        lambda x: OWN_NORM(F.gelu(x)) + F.gelu(x), lambda x: NORM(F.gelu(x)) + F.gelu(x),
    ),
    "split": (
        lambda x: split(torch.cat((x, x + x), -1), OWN_LINEAR),
        lambda x: split(torch.cat((x, x + x), -1), LINEAR),
    ),
    "split and joined": (
        lambda x: torch.cat((split(torch.cat((x, x), -1)), split(torch.cat((x, x), -1))), -1),
    ) * 2,
    "places": (lambda x: x + PLACE,) * 2,
    "a sum with itself": (lambda x: (y := x + x) + y,) * 2,
    "a sum of other orders": (lambda x: x.transpose(1, 3) + F.gelu(x).transpose(1, 3),) * 2,
    "a gelu that is read twice": (lambda x: F.gelu(y := x + x) + y,) * 2,
    "mean": (lambda x: x.mean((1, 2)),) * 2,
    "columns around": (lambda x: torch.cat((x[..., -1:], x, x[..., :1]), -1),) * 2,
    "flattened": (lambda x: x.permute(0, 2, 1, 3).flatten(2).contiguous(),) * 2,
    "maps": (lambda x: [x, x, x.permute(0, 3, 1, 2).contiguous(), F.gelu(x)],) * 2,
    "distances": (lambda x: distances(x, 3.0),) * 2,
    "chosen": (lambda x: torch.where(PLACE[:, :1] > 0, x, 0.0),) * 2,
}  # fmt: skip
IMAGES = {  # functions of images (1, 3, 4, 6)
    "conv": lambda x: CONV(x),
    "conv and gelu": lambda x: F.gelu(CONV(x)),
    "conv that is read twice": lambda x: F.gelu(y := CONV(x)) + y,
    "conv that is read before its gelu": lambda x: ((y := CONV(x)) + y) + F.gelu(y),
    "conv and relu": lambda x: F.relu(CONV(x)),
    "conv and two functions": lambda x: F.relu(F.gelu(CONV(x))),
    "relu": lambda x: F.relu(x),
    "pooled": lambda x: F.max_pool2d(F.max_pool2d(CONV(x), 2, ceil_mode=True), 2, ceil_mode=True),
    "conv and a sum": lambda x: CONV(x) + WIDE,
    "conv, a sum and a function": lambda x: F.relu(WIDE + CONV(x)),
    "conv, a function, a sum and a function": lambda x: F.gelu(F.relu(CONV(x)) + WIDE),
    "conv, two sums and a function": lambda x: F.gelu((CONV(x) + WIDE) + WIDE),
    "conv, a sum and two functions": lambda x: F.gelu(F.relu(CONV(x) + CONV(x + x))),
    "conv that is read after its sum": lambda x: F.gelu((y := CONV(x)) + WIDE) + y,
    "convs": lambda x: (y := F.gelu(CONV(x))) + F.gelu(CONV2(y)),
    "conv of two": lambda x: CONV(torch.cat((x[:, 1:], x[:, :1]), 1)),
    "resized": lambda x: F.interpolate(x, (7, 3), mode="bilinear"),
    "sampled": lambda x: sample_at(x, POINTS),
    "sampled after a conv": lambda x: sample_at(CONV(x), POINTS).permute(0, 2, 3, 1),
}


@torch.no_grad()
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("for_file", [False, True])
@pytest.mark.parametrize("name", [*TOKENS, *IMAGES])
def test_a_program_computes_what_its_function_computes(name, for_file, batch):
    torch.manual_seed(0)
    own, function = TOKENS[name] if name in TOKENS else (IMAGES[name],) * 2
    x = torch.randn(batch, *((4, 6, 6) if name in TOKENS else (3, 4, 6)))
    found = run(lambda x, *_: own(x), x, for_file=for_file)
    each = [function(one[None]) for one in x]
    if isinstance(found, list):
        each = zip(*each, strict=True)
        pairs = [(a, torch.cat(b)) for a, b in zip(found, each, strict=True)]
    else:
        pairs = [(found, torch.cat(each))]
    for got, want in pairs:
        torch.testing.assert_close(got, want)
        assert not for_file or got.is_contiguous()


@torch.no_grad()
@settings(max_examples=150, deadline=None)
@given(
    batch=st.integers(1, 3), height=st.integers(1, 9) | st.integers(60, 70),
    width=st.integers(1, 9) | st.integers(60, 70) | st.integers(126, 131),
    channels=st.integers(1, 5) | st.integers(14, 15) | st.integers(42, 44),
    columns=st.integers(1, 5) | st.integers(47, 49) | st.integers(96, 98),
    one_for_all=st.booleans(), threads=st.integers(1, 3), seed=st.integers(0, 99),
)  # fmt: skip
def test_convolutions_of_any_size(
    batch, height, width, channels, columns, one_for_all, threads, seed
):
    torch.manual_seed(seed)
    conv = nn.Conv2d(channels, columns, 3, padding=1)
    x = torch.randn(batch, channels, height, width)
    summand = torch.randn(1 if one_for_all else batch, columns, height, width)

    def forward(x, _, more):
        return F.relu(conv(x) + (summand if more is None else more))

    images, before = (x,) if one_for_all else (x, summand), torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = run(forward, *images, for_file=True)
    finally:
        torch.set_num_threads(before)
    conv.double()
    torch.testing.assert_close(found, forward(x.double(), None, summand).float())


@torch.no_grad()
@pytest.mark.parametrize("for_file", [False, True])
def test_images_beside_what_a_network_sees(for_file):
    x, images = torch.randn(2, 4, 6, 5), torch.randn(2, 3, 4, 6)

    def forward(x, _, pixels):
        pixels = pixels.contiguous(memory_format=torch.channels_last)
        return F.gelu(CONV(pixels)) + x.permute(0, 3, 1, 2)

    want = forward(x, None, images)
    torch.testing.assert_close(run(forward, x, images, for_file=for_file), want)


@torch.no_grad()
def test_a_model_that_is_no_program_says_why():
    model, images = network("swin_nano"), torch.randn(2, 3, 32, 32)
    model.head = nn.Sequential(model.head, nn.Softplus())
    fast = optimize(model)
    assert "layer by layer, because of head.1 (Softplus): " in repr(fast)
    assert relative_error(fast(images), model(images)) < 1e-5
    refused("softplus is no instruction", optimize, model, strict=True, error=TypeError)
    assert "layer by layer" not in repr(optimize(network("darswin_unet_ra_nano"), strict=True))


class Twice(nn.Module):
    """A layer of a decoder made of known functions."""

    def __init__(self, layer):
        super().__init__()
        self.layer = layer

    def forward(self, x, skip):
        joined = self.layer(x, skip)
        return F.gelu(joined + joined)


@torch.no_grad()
def test_a_new_layer_of_a_decoder_needs_no_other_file():
    model = network("darswin_unet_a_nano")
    model.decoder.joins[0] = Twice(model.decoder.joins[0]).eval()
    fast = optimize(model, strict=True)
    images = torch.randn(2, 3, 32, 32)
    lens = Spherical.from_fov([0.2, 0.9], 2.8, 16.0)
    assert relative_error(fast(images, lens), model(images, lens)) < 1e-5
