"""Random arguments of every operator, for hypothesis. They cover the sizes 0 and 1 on every axis,
every layout, dtype, stride and storage offset, and sizes near those of the kernels' blocks and
registers.

Hypothesis draws shapes and a seed; the numbers in the tensors come from torch's own generator."""

import math

import cases
import torch
from cases import Case, f32, f64, on_polar_plane
from hypothesis import strategies as st
from torch import Tensor


def sizes(*values: int):
    return st.sampled_from(values)


def one_in(count: int):
    """True in one of `count` draws."""
    return st.integers(1, count).map(lambda drawn: drawn == count)


@st.composite
def strided(draw, tensor: Tensor) -> Tensor:
    """The same values in another memory layout: with an offset, with gaps, or in another order."""
    kind = draw(st.sampled_from(["plain", "plain", "offset", "gaps", "turned", "expanded"]))
    if kind == "offset":
        room = tensor.new_empty(tensor.numel() + 3)
        return room[3:].view(tensor.shape).copy_(tensor)
    if kind == "gaps" and tensor.dim():
        room = tensor.new_full((*tensor.shape, 2), math.nan)
        room[..., 1] = tensor
        return room[..., 1]
    if kind == "turned":
        order = draw(st.permutations(range(tensor.dim())))
        back = [order.index(axis) for axis in range(tensor.dim())]
        return tensor.permute(order).contiguous().permute(back)
    if kind == "expanded" and tensor.dim() and tensor.shape[0] > 1:
        return tensor[:1].expand_as(tensor)  # other values, with stride 0
    return tensor


@st.composite
def of_lens(draw, tensor: Tensor) -> Tensor:
    """A tensor with one row for each image, or with one row for all images."""
    return draw(strided(tensor[:1] if draw(st.booleans()) else tensor))


@st.composite
def grids(draw):
    """Rings, sectors and samples of a patch, with at most 4,000 points in all."""
    rings, sectors = draw(sizes(0, 1, 2, 3, 5)), draw(sizes(0, 1, 2, 3, 8, 17, 64, 257, 300))
    across = sizes(1, 2, 3, 4, 5, 10, 33)
    if draw(one_in(7)):
        across = sizes(341, 512, 1023, 1024, 1025, 1026, 1030)  # the kernels have blocks of 1024
    samples = draw(sizes(1, 2, 3, 4, 7, 10)), draw(across)
    while rings * samples[0] * sectors * samples[1] > 4000:
        if sectors > 2:
            sectors = (sectors + 1) // 2
        elif rings > 1:
            rings -= 1
        else:  # two sectors with one radius always fit
            samples = samples[0] // 2, samples[1]
    return rings, sectors, samples


@st.composite
def sampling(draw, dtypes=(f32, f64)) -> Case:
    """A call of polar_sample."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    rings, sectors, samples = draw(grids())
    pairs = st.tuples(*[sizes(0, 1, 2, 7, 16, 33, 90)] * 2)
    options = dict(
        jitter=draw(sizes(0.0, 0.0, 1.0, 0.3)), seed=draw(st.integers(-(2**63), 2**63 - 1)),
        layout=draw(sizes("tokens", "image")),
    )  # fmt: skip
    case = cases.sampling(
        draw(sizes(0, 1, 2, 3, 5)), draw(sizes(0, 1, 2, 3, 3, 4, 5, 8, 17)), draw(pairs),
        rings * samples[0], sectors * samples[1], samples, shared=draw(st.booleans()),
        affine=draw(one_in(3)), offsets=draw(one_in(3)), far=draw(sizes(0.5, 30.0)),
        dtype=draw(st.sampled_from(dtypes)), **options,
    )  # fmt: skip
    inputs, settings = case.inputs, case.settings
    inputs["radii"] = inputs["radii"] * draw(sizes(0.5, 1.0, 2.0, 0.0, -1.0))
    if draw(st.booleans()):  # unsorted
        inputs["radii"] = inputs["radii"][:, torch.randperm(inputs["radii"].shape[1])]
    inputs["center"] += draw(sizes(0.3, 3.0)) * torch.randn_like(inputs["center"])
    if draw(one_in(4)):
        settings["azimuths"] = 1e6 * torch.randn_like(settings["azimuths"])
    settings["azimuths"] = draw(strided(settings["azimuths"]))
    for name, tensor in inputs.items():
        inputs[name] = draw(strided(tensor) if name == "image" else of_lens(tensor))
    return case


@st.composite
def attention(draw, dtypes=(f32, f64)) -> Case:
    """A call of window_attention."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    window = draw(sizes(1, 2, 3, 4, 8)), draw(sizes(1, 2, 3, 4, 5, 16, 65))
    rings, sectors = window[0] * draw(sizes(1, 2, 3)), window[1] * draw(sizes(1, 2, 3))
    if rings * sectors > 600:
        rings, sectors = window
    batch = draw(sizes(0, 1, 2, 3))
    case = cases.attention(
        batch, rings, sectors, draw(sizes(0, 1, 2, 3)), draw(sizes(1, 2, 5, 8, 16, 17, 32, 33)),
        window, draw(sizes(1, batch)), draw(st.sampled_from(dtypes)),
        shift=(draw(st.integers(0, rings - 1)), draw(st.integers(0, sectors - 1))),
        periodic=(draw(st.booleans()), draw(st.booleans())), scale=draw(sizes(None, 0.7, 0.0)),
    )  # fmt: skip
    return case.replace(**{name: draw(strided(t)) for name, t in case.inputs.items()})


@st.composite
def polar_maps(draw, dtypes=(f32, f64)) -> Case:
    """A call of polar_to_image."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    batch, side = draw(sizes(0, 1, 2, 3)), sizes(0, 1, 2, 7, 16, 33)
    size = draw(side), draw(side | sizes(90))
    case = cases.polar_map(
        batch, draw(sizes(1, 2, 3, 5, 16)), draw(sizes(1, 2, 3, 8, 17, 64)),
        draw(sizes(0, 1, 2, 3, 8, 10, 16, 17, 31, 33, 65)), size, draw(sizes(1, batch)),
        draw(sizes(None, "affine", "points")), draw(sizes(0.2, 0.5, 1.5)) * max(*size, 2),
        draw(st.sampled_from(dtypes)), layout=draw(sizes("tokens", "image")),
    )  # fmt: skip
    inputs = case.inputs
    if draw(one_in(5)):
        inputs["radii"] = inputs["radii"] - inputs["radii"][:, :1]  # first ring at the pole
    if "center" in inputs:
        inputs["center"] += draw(sizes(0.3, 3.0)) * torch.randn_like(inputs["center"])
    r, _ = on_polar_plane(size, **{name: t.double() for name, t in inputs.items() if name != "x"})
    r_max = None
    if draw(st.booleans()) and r.numel() > 1:
        # Between two pixels, since a pixel on the border may count as inside or outside.
        radius = r.flatten().sort().values
        gap = radius.diff().argmax()
        r_max = (radius[gap] + radius[gap + 1]).item() / 2
    for name, tensor in inputs.items():
        inputs[name] = tensor if name == "radii" else draw(strided(tensor))
    return cases.map_call(inputs, **case.settings, r_max=r_max)


WIDTHS = (1, 2, 3, 7, 15, 16, 17, 31, 33, 64, 96, 200, 384, 1500)


@st.composite
def norms(draw) -> tuple[Tensor, Tensor]:
    """The tokens and the parameters (2, D) of _norm."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    shape = (*draw(st.lists(sizes(0, 1, 2, 3, 9), max_size=3)), draw(sizes(*WIDTHS)))
    mean = draw(sizes(0.0, 300.0, -1e4))
    room = draw(sizes(0, 1, 5))  # an odd storage offset
    x = (torch.randn(math.prod(shape) + room) + mean)[room:].view(shape)
    return x, torch.randn(2, shape[-1])
