"""Networks of one's own: a program computes what the model computes, or is refused by name."""

import inspect
import random
import re

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from frame_samples import network_of
from helpers import products, refused, slow
from torch import nn
from torch.nn.utils import parametrizations

from darswin import optimize
from darswin.deploy import record
from darswin.deploy.lowering import RELU, _applied
from darswin.lens import Equidistant
from darswin.models.conv_unet import ConvBlock, ConvUnet

SIDE = 8


class Step(nn.Module):
    """A function of a map (B, 4, 8, 8), of a layer, and of the rays of the lens."""

    def __init__(self, function, layer=None):
        super().__init__()
        self.function, self.layer = function, layer

    def forward(self, x, rays):
        return self.function(self.layer, x, rays)


class Network(ConvUnet):
    """A convolution of colours and rays, and steps."""

    def __init__(self, steps):
        super().__init__(4, 3, widths=(4,))
        self.image_size, self.steps = (SIDE, SIDE), nn.ModuleList(steps)

    def forward_network(self, x, prepared, images):
        rays = prepared.rays
        x = self.down[0](torch.cat((x, rays.to(x).expand(x.shape[0], -1, -1, -1)), 1))
        for step in self.steps:
            x = step(x, rays)
        return x


def steps(layers, maps, written, rays):
    """Functions that make a step: of layers, maps, maps that are changed in place, and rays."""
    return [
        *(lambda make=make: Step(lambda layer, x, _: layer(x), make()) for make in layers),
        *(lambda of=of: Step(lambda _, x, __: of(x)) for of in maps),
        *(lambda of=of: Step(lambda _, x, __: (y := x + x, of(y))[0]) for of in written),
        *(lambda of=of: Step(lambda _, x, rays: of(x, rays)) for of in rays),
    ]


def with_(layer, method, function):
    """A layer with a method of its own, or a hook."""
    if method.startswith("register"):
        getattr(layer, method)(function)
    else:
        setattr(layer, method, function)
    return layer


def with_activation(kind):
    block = ConvBlock(4, 4)
    block[2] = kind()
    return block


class Residual(ConvBlock):
    def forward(self, x):
        return super().forward(x) + x


class LayerNorm2d(nn.LayerNorm):
    def forward(self, x):
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Encoder(nn.TransformerEncoderLayer):
    def forward(self, x):
        return super().forward(x[:, 0])[:, None].expand(-1, 4, -1, -1)


class Around(nn.Sequential):
    """A layer that reads the weights of another one."""

    def forward(self, x):
        return F.linear(self[0](x), self[0].weight)


def conv(**options):
    return nn.Conv2d(4, 4, 3, padding=1, **options)


def linear():
    return nn.Linear(SIDE, SIDE)


def shared():
    """Two convolutions with one weight and two biases."""
    convs = nn.Sequential(conv(), conv())
    convs[1].weight = convs[0].weight
    return convs


def doubled(_, given, *out):
    return 2 * out[0] if out else (2 * given[0],)


def resampled(x):
    pooled = F.max_pool2d(x, 2, ceil_mode=True)
    return F.interpolate(pooled, (SIDE, SIDE), mode="bilinear")


def four(rays):
    return torch.cat((rays, rays[:, :1]), 1)


CHANNELS = torch.arange(4).view(1, 4, 1, 1).expand(1, 4, SIDE, SIDE)
LEFT = (torch.arange(SIDE) < 3).expand(1, 1, SIDE, SIDE)
FIRST = slice(None), slice(2)
INSTRUCTIONS = steps(
    layers=(
        conv, lambda: conv(bias=False), nn.ReLU, nn.GELU, linear, lambda: nn.LayerNorm(SIDE),
        lambda: ConvBlock(4, 4), lambda: nn.Dropout(0.5), shared,
        lambda: parametrizations.weight_norm(conv()),
    ),
    maps=(
        lambda x: x + x, lambda x: torch.cat((x[:, 2:], x[:, :2]), 1), lambda x: x.transpose(2, 3),
        lambda x: x.transpose(1, 3).transpose(3, 1), resampled,
        lambda x: x.flatten(2).unflatten(2, (SIDE, SIDE)).contiguous(),
        lambda x: x.reshape(x.shape[0], -1).reshape(x.shape),
        lambda x: x[:, :1].expand(-1, 4, -1, -1) + x, lambda x: torch.cat(x.chunk(2, 3), 3),
        lambda x: torch.where(LEFT, x, 0.0), lambda x: x.to(torch.float32).float(),
    ),
    written=(),
    rays=(
        lambda x, rays: x + four(rays), lambda x, rays: four(rays).transpose(2, 3) + x,
        lambda x, rays: x + rays[:, :1].expand(-1, 4, -1, -1),
        lambda x, rays: torch.cat((rays.flip(3).expand(x.shape[0], -1, -1, -1), x[:, :1]), 1),
    ),
)  # fmt: skip
OTHERS = steps(
    layers=(
        lambda: nn.SiLU(inplace=True), lambda: nn.ReLU(inplace=True), lambda: Residual(4, 4),
        lambda: LayerNorm2d(4), lambda: nn.LayerNorm((4, SIDE, SIDE)), lambda: Around(linear()),
        lambda: with_(linear(), "register_forward_hook", doubled),
        lambda: with_(conv(), "register_forward_pre_hook", doubled),
        lambda: with_(ConvBlock(4, 4), "register_forward_hook", doubled),
        lambda: with_(linear(), "forward", lambda x: 2 * x),
        lambda: with_(ConvBlock(4, 4), "forward", nn.Hardtanh()),
        lambda: nn.LayerNorm(SIDE, bias=False), lambda: nn.GroupNorm(2, 4),
        lambda: nn.LayerNorm(SIDE, elementwise_affine=False), lambda: with_activation(nn.GELU),
        lambda: with_activation(nn.SiLU), lambda: conv(padding_mode="circular"),
        lambda: conv(groups=2), lambda: ConvBlock(4, 4).append(nn.Dropout(0.1)),
        lambda: nn.Softmax(3), lambda: Encoder(SIDE, 2, 8, batch_first=True),
        lambda: nn.GELU("tanh"), lambda: nn.Conv2d(4, 4, 1), lambda: nn.MaxPool2d(1),
    ),
    maps=(
        # casts
        *(lambda x, dtype=dtype: x.to(dtype).float()
          for dtype in (torch.int32, torch.uint8, torch.bool, torch.float16, torch.bfloat16)),
        lambda x: x.double().float(), lambda x: x.half().float(), lambda x: x.bool() + x,
        lambda x: x.type(torch.int16).type_as(x),
        lambda x: x.contiguous().view(torch.int32).float() * 1e-9,
        # branches
        lambda x: x + x if x.shape[0] > 3 else x, lambda x: x if len(x) < 4 else x + x,
        lambda x: x + x if x.size(0) % 2 else x, lambda x: x + x if x.sum() > 0 else x,
        lambda x: x + x if x.numel() > 999 else x, lambda x: x * x.shape[0], lambda x: x.flip(0),
        lambda x: F.gelu(torch.cat((x.split(4)[0], x[4:]))), lambda x: torch.cat((x[1:], x[:1])),
        lambda x: sum(each[None] for each in x).expand_as(x),
        lambda x: x + x if x.max().item() > 2 else x,
        # arguments that a rule does not take
        lambda x: torch.add(x, F.gelu(x), alpha=0.5), lambda x: 1.0 + x, torch.sin,
        lambda x: x.mean(3, keepdim=True) + x, lambda x: x + torch.ones(4, 1, 1),
        lambda x: x + x.mean((2, 3), keepdim=True).expand_as(x), lambda x: F.max_pool2d(x, 3, 1, 1),
        lambda x: torch.where(CHANNELS > 1, x, 0.0), lambda x: torch.where(x > 0, x, 0.0),
        lambda x: torch.where(LEFT, x, 1.0),
        lambda x: F.interpolate(x, scale_factor=2)[:, :, ::2, ::2],
        lambda x: x.as_strided(x.shape, x.contiguous().transpose(2, 3).stride()),
        lambda x: x[:, :1].squeeze().reshape(x[:, :1].shape).expand(-1, 4, -1, -1),
        lambda x: F.conv2d(x, x[:1, :, :3, :3].expand(4, -1, -1, -1), padding=1),
    ),
    written=(
        lambda x: x.add_(1.0), lambda x: x.__iadd__(x), lambda x: x.clamp_(0, 1),
        lambda x: x.zero_(), lambda x: x.exp_().clamp_(max=9.0), torch.relu_,
        lambda x: x.data.mul_(0.5), lambda x: torch.neg(x, out=x), lambda x: x[:, 1].fill_(2.0),
        lambda x: x.__setitem__(FIRST, 0.0), lambda x: x.__setitem__(FIRST, x[:, 2:4]),
        lambda x: x.transpose_(2, 3), lambda x: x.copy_(x + x), lambda x: x.mT.sub_(1.0),
        lambda x: torch.add(x, x, out=x),
    ),
    rays=(
        lambda x, rays: x + four(rays.clone().mul_(2.0)),
        lambda x, rays: x + x if rays[0, 0, 0, 0] > -0.5 else x,
        lambda x, rays: x + x if rays.mean().item() > 0.7 else x,
        lambda x, rays: F.conv2d(x, four(rays[:1])[..., :3, :3].expand(4, 4, 3, 3), padding=1),
    ),
)  # fmt: skip


def near(found, expected, share=1.0):
    """Whether this share of the numbers is equal up to rounding."""
    assert found.shape == expected.shape and found.dtype == expected.dtype
    atol = 1e-4 * expected.nan_to_num(0.0, 0.0, 0.0).abs().max()
    same = torch.isclose(found, expected, rtol=1e-4, atol=atol.item(), equal_nan=True)
    return same.float().mean() >= share


def check(parts, folder, refuses=None):
    """A network of steps, optimized and in a file; `refuses`: whether it must be no program."""
    model = Network(parts)
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.4)
    model.eval()
    lenses = Equidistant.from_fov(torch.linspace(1.0, 4.0, 5), SIDE / 2)
    with torch.no_grad():
        fast = optimize(model)
        assert not fast.lack or fast.lack.startswith("layer by layer, because of ")
        assert refuses is None or bool(fast.lack) == refuses
        assert not refuses or re.search(r"of steps\.0.* \(\w+\): .* is no instruction", fast.lack)
        share = 0.99 if fast.lack else 1.0  # a cast may round to the other side
        for count, lens in ((1, lenses[4:]), (3, lenses[:3]), (5, lenses[:1]), (5, lenses)):
            images = torch.randn(count, 3, SIDE, SIDE)
            assert near(fast(images, lens), model(images, lens), share)
        try:
            network = network_of(model, folder, lenses[4], mean=0.5, std=0.2)
        except TypeError as error:
            assert "one that a file can contain, got Network: " in str(error)
            return
        frame = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), np.uint8)
        image = (torch.from_numpy(frame).permute(2, 0, 1)[None].float() / 255 - 0.5) / 0.2
        assert near(torch.from_numpy(network(frame))[None], model(image, lenses[4]))


def drawn(seed):
    """The steps of a random network, and whether all are instructions."""
    chance = random.Random(seed)
    torch.manual_seed(seed)
    tables = chance.choices([INSTRUCTIONS, OTHERS], [3, 1], k=chance.randint(1, 5))
    return [chance.choice(table)() for table in tables], OTHERS not in tables


@pytest.mark.parametrize("k", range(len(OTHERS)))
def test_what_is_no_instruction_is_refused(k, tmp_path):
    torch.manual_seed(k)
    check([OTHERS[k]()], tmp_path, refuses=True)


@pytest.mark.parametrize(
    "seeds", [range(40), pytest.param(range(40, 2000), marks=[slow, products])], ids=len
)
def test_random_networks_are_equal_or_refused(seeds, tmp_path):
    for seed in seeds:
        parts, known = drawn(seed)
        check(parts, tmp_path, refuses=False if known else None)


def test_what_differs_is_not_used_and_named(monkeypatch):
    def wrong(x: record.Recorded, approximate="none"):
        return _applied(x, x.writer.program.apply, RELU)

    monkeypatch.setitem(record.RULES, F.gelu, (wrong, inspect.signature(wrong)))
    model = Network([INSTRUCTIONS[0](), INSTRUCTIONS[3](), INSTRUCTIONS[0]()]).eval()
    said = r"steps\.1\.layer \(GELU\): torch\.nn\.functional\.gelu computes something else"
    refused(said, optimize, model, strict=True, error=TypeError)
    images, lens = torch.randn(2, 3, SIDE, SIDE), Equidistant.from_fov(3.0, SIDE / 2)
    with torch.no_grad():
        assert near(optimize(model)(images, lens), model(images, lens))


def test_the_comparison_leaves_the_model_and_random_numbers_as_they_were():
    model = Network([Step(lambda _, x, __: x + torch.rand(1, 4, SIDE, SIDE))]).train()
    model.register_buffer("calls", torch.zeros(()))
    model.register_forward_hook(lambda module, *_: module.calls.add_(1))
    state, before = torch.get_rng_state(), {k: v.clone() for k, v in model.state_dict().items()}
    fast = optimize(model)
    assert "torch.Tensor.add computes something else" in fast.lack
    assert torch.equal(torch.get_rng_state(), state) and model.training and model.steps.training
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())
    assert all(p.requires_grad for p in model.parameters()) and model._forward_hooks
