"""Random arguments of every operator, for hypothesis: sizes 0 and 1 in every place, every layout,
dtype, stride and storage offset, and sizes around what the kernels' blocks and registers hold."""

import math

import torch
from cases import Case, attention_call, bf16, f32, f64, map_call, on_polar_plane, sampling_call
from hypothesis import strategies as st
from torch import Tensor


def sizes(*values: int):
    return st.sampled_from(values)


@st.composite
def generators(draw) -> torch.Generator:
    """A generator of tensors; hypothesis draws its seed, and shapes, but not every number."""
    return torch.Generator().manual_seed(draw(st.integers(0, 2**31)))


def normal(generator: torch.Generator, *shape: int, dtype: torch.dtype = f64) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=f64).to(dtype)


@st.composite
def strided(draw, tensor: Tensor) -> Tensor:
    """The same values elsewhere in memory: behind others, with gaps, or in other orders."""
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
        return tensor[:1].expand_as(tensor)  # other values, but of stride 0
    return tensor


@st.composite
def grids(draw):
    """Rings, sectors and samples of a patch, no more than 4,000 points in all."""
    rings, sectors = draw(sizes(0, 1, 2, 3, 5)), draw(sizes(0, 1, 2, 3, 8, 17, 64, 257, 300))
    across = sizes(1, 2, 3, 4, 5, 10, 33)
    if draw(st.integers(0, 6)) == 0:
        across = sizes(341, 512, 1023, 1024, 1025, 1026, 1030)  # a block of the kernels is 1024
    samples = draw(sizes(1, 2, 3, 4, 7, 10)), draw(across)
    while rings * samples[0] * sectors * samples[1] > 4000:
        if sectors > 2:
            sectors = (sectors + 1) // 2
        elif rings > 1:
            rings -= 1
        else:  # two sectors of one radius fit in any case
            samples = samples[0] // 2, samples[1]
    return rings, sectors, samples


@st.composite
def lenses(draw, generator, batch, size, rows, columns, dtype):
    """radii, azimuths, center, and affine and offsets or None, for images of `size` = (H, W)."""
    reach = max(*size, 2)
    count = draw(st.sampled_from([1, batch]))
    spread = draw(st.sampled_from([0.4, 0.7, 1.5, 0.0]))
    radii = torch.rand(count, rows, generator=generator, dtype=f64) * spread * reach
    if draw(st.booleans()):
        radii = radii.sort(1).values
    if draw(st.integers(0, 7)) == 0:
        radii = -radii
    azimuths = (torch.arange(columns, dtype=f64) + 0.37) * (2 * math.pi / max(columns, 1))
    if draw(st.integers(0, 3)) == 0:
        azimuths = 1e6 * normal(generator, columns)
    center = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=f64)
    count = draw(st.sampled_from([1, batch]))
    center = center + draw(st.sampled_from([0.3, 3.0])) * normal(generator, count, 2)
    affine = offsets = None
    if draw(st.integers(0, 2)) == 0:
        count = draw(st.sampled_from([1, batch]))
        affine = torch.eye(2, dtype=f64) + 0.4 * normal(generator, count, 2, 2)
        affine = affine.to(dtype)
    if draw(st.integers(0, 2)) == 0:
        count = draw(st.sampled_from([1, batch]))
        far = draw(st.sampled_from([0.5, 30.0]))
        offsets = (far * normal(generator, count, 2, rows, columns)).to(dtype)
    return radii.to(dtype), azimuths.to(dtype), center.to(dtype), affine, offsets


@st.composite
def sampling(draw, dtypes=(f32, f64), embed: bool = False) -> Case:
    """A call of polar_sample, or of polar_embed."""
    generator, dtype = draw(generators()), draw(st.sampled_from(dtypes))
    batch, channels = draw(sizes(0, 1, 2, 3, 5)), draw(sizes(0, 1, 2, 3, 3, 4, 5, 8, 17))
    size = draw(sizes(0, 1, 2, 7, 16, 33, 90)), draw(sizes(0, 1, 2, 7, 16, 33, 90))
    rings, sectors, samples = draw(grids())
    rows, columns = rings * samples[0], sectors * samples[1]
    image = draw(strided(normal(generator, batch, channels, *size, dtype=dtype)))
    lens = draw(lenses(generator, batch, size, rows, columns, dtype))
    radii, azimuths, center, affine, offsets = (
        None if t is None else draw(strided(t)) for t in lens
    )
    jitter = draw(st.sampled_from([0.0, 0.0, 1.0, 0.3]))
    seed = draw(st.integers(-(2**63), 2**63 - 1))
    options = dict(samples=samples, jitter=jitter, seed=seed)
    inputs = dict(image=image, radii=radii, center=center)
    if affine is not None:
        inputs["affine"] = affine
    if offsets is not None:
        inputs["offsets"] = offsets
    if embed:
        features = draw(sizes(0, 1, 2, 15, 16, 17, 48))
        depth = samples[0] * samples[1] * channels
        inputs["weight"] = draw(strided(normal(generator, features, depth, dtype=dtype)))
        if draw(st.booleans()):
            inputs["bias"] = draw(strided(normal(generator, features, dtype=dtype)))
    else:
        options["layout"] = draw(st.sampled_from(["tokens", "image"]))
    return sampling_call(inputs, azimuths, **options)


@st.composite
def attention(draw, dtypes=(f32, f64)) -> Case:
    """A call of window_attention."""
    generator, dtype = draw(generators()), draw(st.sampled_from(dtypes))
    batch, heads = draw(sizes(0, 1, 2, 3)), draw(sizes(0, 1, 2, 3))
    head_dim = draw(sizes(1, 2, 5, 8, 16, 17, 32, 33))
    window = draw(sizes(1, 2, 3, 4, 8)), draw(sizes(1, 2, 3, 4, 5, 16, 65))
    rings, sectors = window[0] * draw(sizes(1, 2, 3)), window[1] * draw(sizes(1, 2, 3))
    if rings * sectors > 600:
        rings, sectors = window
    rows = draw(st.sampled_from([1, batch]))
    table = (rows, heads, 2 * window[0] - 1, 2 * window[1] - 1)
    options = dict(
        window=window,
        shift=(draw(st.integers(0, rings - 1)), draw(st.integers(0, sectors - 1))),
        periodic=(draw(st.booleans()), draw(st.booleans())),
        scale=draw(st.sampled_from([None, 0.7, 0.0])),
    )
    qkv = normal(generator, batch, rings, sectors, 3, heads, head_dim, dtype=dtype)
    bias = normal(generator, *table, dtype=f32 if dtype == bf16 else dtype)
    inputs = dict(qkv=draw(strided(qkv)), bias=draw(strided(bias)))
    return attention_call(inputs, **options)


@st.composite
def polar_maps(draw, dtypes=(f32, f64)) -> Case:
    """A call of polar_to_image."""
    generator, dtype = draw(generators()), draw(st.sampled_from(dtypes))
    real = f32 if dtype == bf16 else dtype
    batch, channels = draw(sizes(0, 1, 2, 3)), draw(sizes(0, 1, 2, 3, 8, 10, 16, 17, 31, 33, 65))
    rings, sectors = draw(sizes(1, 2, 3, 5, 16)), draw(sizes(1, 2, 3, 8, 17, 64))
    size = height, width = draw(sizes(0, 1, 2, 7, 16, 33)), draw(sizes(0, 1, 2, 7, 16, 33, 90))
    rows = st.sampled_from([1, batch])
    spread = draw(st.sampled_from([0.2, 0.5, 1.5])) * max(*size, 2)
    radii = (torch.rand(draw(rows), rings, generator=generator, dtype=f64) + 0.3).cumsum(1)
    radii = radii / rings * spread
    if draw(st.integers(0, 4)) == 0:
        radii = radii - radii[:, :1]  # a ring at the pole itself
    options = dict(size=size, layout=draw(st.sampled_from(["tokens", "image"])))
    inputs = dict(x=normal(generator, batch, rings, sectors, channels, dtype=dtype))
    inputs["radii"] = radii.to(real)
    general = draw(st.sampled_from(["circular", "affine", "points"]))
    if general == "points":
        points = 0.4 * max(*size, 2) * normal(generator, draw(rows), *size, 2)
        inputs["points"] = points.to(real)
    else:
        center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=f64)
        spread = draw(st.sampled_from([0.3, 3.0]))
        inputs["center"] = (center + spread * normal(generator, draw(rows), 2)).to(real)
    if general == "affine":
        skew = normal(generator, draw(rows), 2, 2).clamp(-2, 2)
        inputs["affine"] = (torch.eye(2, dtype=f64) + 0.15 * skew).to(real)
    r, _ = on_polar_plane(size, **{name: t.double() for name, t in inputs.items() if name != "x"})
    if draw(st.booleans()) and r.numel() > 1:
        # Between two pixels, since what lies on the border may count as inside or outside.
        radius = r.flatten().sort().values
        gap = radius.diff().argmax()
        options["r_max"] = (radius[gap] + radius[gap + 1]).item() / 2
    inputs = {name: draw(strided(t)) if name != "radii" else t for name, t in inputs.items()}
    return map_call(inputs, **options)


WIDTHS = (1, 2, 3, 7, 15, 16, 17, 31, 33, 64, 96, 200, 384, 1500)


@st.composite
def norms(draw, dtypes=(f32,)) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, y, weight and bias of add_norm_."""
    generator, dtype = draw(generators()), draw(st.sampled_from(dtypes))
    shape = (*draw(st.lists(sizes(0, 1, 2, 3, 9), max_size=3)), draw(sizes(*WIDTHS)))
    mean = draw(st.sampled_from([0.0, 300.0, -1e4]))
    room = draw(sizes(0, 1, 5))  # an odd storage offset
    x, y = (
        (normal(generator, math.prod(shape) + room) + m).to(dtype)[room:].view(shape)
        for m in (mean, 0.0)
    )
    return x, y, normal(generator, shape[-1], dtype=f32), normal(generator, shape[-1], dtype=f32)


@st.composite
def matrices(draw) -> Tensor:
    """x of transpose_sum."""
    generator = draw(generators())
    counts = sizes(0, 1, 2, 3, 15, 16, 17, 33, 63, 64, 65, 130, 700)
    room, mean = draw(sizes(0, 1, 5)), draw(st.sampled_from([0.0, 1.0, 1e4]))
    rows, columns = draw(counts), draw(counts)
    values = normal(generator, rows * columns + room) + mean
    return values.to(f32)[room:].view(rows, columns)
