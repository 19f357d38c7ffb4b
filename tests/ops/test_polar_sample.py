"""Places of polar_sample's points and values of its pixels, beyond the contract; and polar_embed as
the two steps that it takes at once."""

import math
import time

import pytest
import torch
import torch.nn.functional as F
from cases import (
    NEAR,
    assert_accurate,
    assert_equal_results,
    f32,
    f64,
    places,
    results,
    sampling,
    sampling_call,
)
from torch._dynamo.testing import CompileCounter

from darswin.ops import _module, cpu_capability, polar_embed, polar_sample, use_reference
from darswin.ops.reference import philox

references = pytest.mark.parametrize("reference", [False, True])
jitters = pytest.mark.parametrize("jitter", [0.0, 0.8])
layouts = pytest.mark.parametrize("layout", ["tokens", "image"])
GENERAL = dict(affine=True, offsets=True)


def grid(size=(17, 23), rows=6, columns=8, dtype=f32):
    """An image, radii, azimuths and center."""
    case = sampling(size=size, rows=rows, columns=columns, dtype=dtype)
    inputs = case.inputs
    return inputs["image"], inputs["radii"], case.settings["azimuths"], inputs["center"]


# -- places ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("general", [{}, GENERAL], ids=["circular", "general"])
def test_equals_grid_sample(general):
    case = sampling(rows=12, columns=16, samples=(1, 1), layout="image", dtype=f64, **general)
    image, radii, center, *lens = case.inputs.values()
    x, y, _ = places(radii, case.settings["azimuths"], center, *(lens or [None] * 2), 2, 0, 0)
    height, width = image.shape[2:]
    mesh = torch.stack((2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1), -1)
    expected = F.grid_sample(image, mesh, align_corners=True)
    assert (expected != 0).double().mean() > 0.3
    torch.testing.assert_close(case.run(**case.inputs), expected, rtol=1e-10, atol=1e-10)


def test_layouts_hold_the_same_samples():
    planes, tokens = (
        polar_sample(*arguments, samples=(3, 4), layout=layout)
        for arguments in [grid()]
        for layout in ("image", "tokens")
    )
    assert tokens.shape == (2, 2, 2, 36) and planes.shape == (2, 3, 6, 8)
    # Token (ring 1, sector 0), inner order (S_r, S_φ, C).
    assert torch.equal(tokens[0, 1, 0].reshape(3, 4, 3), planes[0, :, 3:6, 0:4].permute(1, 2, 0))


def test_points_thrown_far_outside_are_zero():
    case = sampling(**GENERAL)
    inputs = case.inputs
    for far in (60.0, 1e6, 1e12, 1e30, 3e38, -60.0, -1e30, -3e38):
        thrown = inputs | dict(radii=inputs["radii"] * 0, offsets=inputs["offsets"] * 0 + far)
        assert (case.run(**thrown) == 0).all()
        away = inputs | dict(radii=inputs["radii"] + 1, affine=inputs["affine"] + 1e3 * far)
        assert case.run(**away).isfinite().all()


def test_outside_is_zero():
    image, center = torch.ones(1, 1, 5, 5), torch.tensor([[2.0, 2.0]])
    radii = torch.tensor([[1.5, 2.25, 2.999, 3.0, 50.0]])
    out = polar_sample(image, radii, torch.zeros(1), center, samples=(1, 1))
    torch.testing.assert_close(out.flatten(), torch.tensor([1.0, 0.75, 0.001, 0.0, 0.0]))


@pytest.mark.parametrize("far", [0.5, 40.0, 1e4])
def test_bands_get_what_offsets_bring_them(threads, far):
    case = sampling(1, size=(200, 180), rows=80, columns=160, samples=(8, 8), far=far, dtype=f64,
                    **GENERAL)  # fmt: skip
    threads(1)
    expected = results(case, is_reference=True)
    threads(7)
    assert_equal_results(results(case), expected, 1e-9)


def test_accuracy_rule_where_all_points_meet():
    # Every point of the innermost rings falls into one pixel: the longest sums of all.
    def make():
        case = sampling(1, rows=64, columns=512, samples=(8, 8))
        center = case.inputs["center"].round() + 0.5
        return case.replace(radii=torch.linspace(0, 0.4, 64)[None], center=center)

    assert_accurate(make)


def test_indices_beyond_two_to_the_31():
    # The pages of a fresh tensor are not there before they are written: this costs little memory.
    side = 46400
    image = torch.empty(1, 1, side, side)
    assert image.numel() > 2**31
    image[0, 0, side - 4 :, side - 4 :] = torch.arange(16.0).reshape(4, 4)
    center = torch.tensor([[side - 3.0, side - 3.0]])
    out = polar_sample(image, torch.tensor([[0.0, 1.0]]), torch.zeros(1), center, samples=(1, 1))
    assert out.flatten().tolist() == [5.0, 6.0]


def test_sizes_beyond_two_to_the_31():
    side = 2**31 + 8
    image = torch.ones(1, 1, 1, 1, dtype=f64).expand(1, 1, side, side)
    center, radii = torch.full((1, 2), 2.0**31, dtype=f64), torch.tensor([[0.0, 3.5, 100.0]])
    out = polar_sample(image, radii.double(), torch.zeros(1, dtype=f64), center, samples=(1, 1))
    assert out.flatten().tolist() == [1.0, 1.0, 0.0]


# -- NaN and infinity ------------------------------------------------------------------------------


@references
@jitters
@pytest.mark.parametrize("rows", [1, 6, 60])  # 60: a near image, see csrc/kernels/polar_image.h
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("spoiled", ["radii", "azimuths", "center", "affine", "offsets"])
def test_points_at_nan_or_infinity_sample_nothing(spoiled, bad, rows, jitter, reference):
    general = GENERAL if spoiled in ("affine", "offsets") or rows == 6 else {}
    case = sampling(rows=rows, columns=40, samples=(1, 1), jitter=jitter, seed=5, layout="image",
                    **general)  # fmt: skip
    good = results(case)["out"]
    value = case.settings["azimuths"] if spoiled == "azimuths" else case.inputs[spoiled]
    if spoiled == "azimuths" and abs(bad) == 1e30:
        return  # a place like any other
    value[(0,) * value.dim()] = bad
    ours, exact = results(case, is_reference=reference), results(case.to(f64), is_reference=True)
    for name, want in exact.items():
        assert ours[name].isfinite().all()
        size = 1 + want.abs().max().item()
        torch.testing.assert_close(ours[name].double(), want, rtol=1e-3, atol=1e-3 * size)
    out = ours["out"]
    lost = dict(radii=out[0, :, 0], azimuths=out[..., 0], offsets=out[0, :, 0, 0])
    assert (lost.get(spoiled, out[0]) == 0).all()
    kept = dict(azimuths=slice(1, None)).get(spoiled, slice(None))
    torch.testing.assert_close(out[1, ..., kept], good[1, ..., kept], rtol=1e-4, atol=1e-4)


@references
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_pixel_spoils_only_the_points_that_touch_it(bad, reference):
    image = torch.ones(1, 1, 9, 9)
    image[0, 0, 4, 4] = bad
    radii, center = torch.tensor([[0.5, 2.5, 4.5]]), torch.tensor([[4.0, 4.0]])
    with use_reference(reference):
        out = polar_sample(image, radii, torch.tensor([0.1, 1.7]), center, samples=(1, 2))
    assert not out[0, 0].isfinite().any() and out[0, 1:].isfinite().all()


# -- jitter ----------------------------------------------------------------------------------------


def jittered(radii, azimuths, jitter, seed, size=64, **general):
    """x and y from the centre at which the points of one image stand, (2, N_r, N_a)."""
    x = torch.arange(size, dtype=f64).expand(size, size)
    middle = torch.full((1, 2), (size - 1) / 2, dtype=f64)
    # The channels of the image are x and y.
    out = polar_sample(torch.stack((x, x.T))[None], radii, azimuths, middle, samples=(1, 1),
                       jitter=jitter, seed=seed, layout="image", **general)  # fmt: skip
    return out[0] - (size - 1) / 2


def test_jitter_moves_points_by_the_documented_numbers():
    radii = torch.tensor([[4.0, 7.0, 8.0, 20.0]], dtype=f64)
    azimuths = (torch.arange(16, dtype=f64) + 0.5) * (2 * math.pi / 16) - math.pi
    seed, jitter = 1234, 0.75
    x, y = jittered(radii, azimuths, jitter, seed)
    point = torch.arange(64)
    words = torch.stack(philox(torch.tensor(seed), point // 4, torch.tensor(0)))
    word = words[point % 4, point].reshape(4, 16)
    u, v = ((half / 2**16 - 0.5).double() * jitter for half in (word >> 16, word & 0xFFFF))
    outer = torch.tensor([3.0, 1.0, 12.0, 12.0], dtype=f64)[:, None]
    inner = torch.tensor([3.0, 3.0, 1.0, 12.0], dtype=f64)[:, None]
    torch.testing.assert_close(torch.hypot(x, y), radii.T + u * torch.where(u < 0, inner, outer))
    torch.testing.assert_close(torch.atan2(y, x), azimuths + v * (2 * math.pi / 16))


def test_jitter_moves_points_before_the_matrix_and_leaves_their_offsets():
    case = sampling(1, rows=12, columns=40, samples=(1, 1), dtype=f64, **GENERAL)
    _, radii, _, affine, offsets = case.inputs.values()
    azimuths = case.settings["azimuths"]
    moved = jittered(radii, azimuths, 0.9, 7, 256)
    assert (moved - jittered(radii, azimuths, 0.0, 7, 256)).abs().max() > 0.5
    got = jittered(radii, azimuths, 0.9, 7, 256, affine=affine, offsets=offsets)
    expected = torch.einsum("xy,yra->xra", affine[0], moved) + offsets[0]
    torch.testing.assert_close(got, expected)


def test_jitter_is_uniform_and_independent():
    radii, azimuths = torch.arange(8.0, 24.0)[None].double(), torch.linspace(-3, 3, 400).double()
    x, y = jittered(radii, azimuths, 1.0, seed=9)
    u = (torch.hypot(x, y) - radii.T)[1:-1].flatten()
    v = ((torch.atan2(y, x) - azimuths) / (2 * math.pi / 400))[1:-1].flatten()
    for offset in (u, v):
        assert offset.min() >= -0.5 - 1e-9 and offset.max() < 0.5 + 1e-9
        assert abs(offset.mean()) < 0.02 and abs(offset.std() - 12**-0.5) < 0.01
    assert abs(torch.corrcoef(torch.stack((u, v)))[0, 1]) < 0.05


def test_jitter_never_gives_a_negative_radius():
    radii, azimuths = torch.tensor([[0.0, 8.0]]).double(), torch.zeros(500, dtype=f64)
    r = torch.hypot(*jittered(radii, azimuths, 1.0, seed=2))[0]
    assert (r < 1e-9).double().mean() > 0.3 and r.max() > 1  # about half are clamped


def test_seeds():
    image, *lens = grid()
    lens[0], lens[2], image = lens[0][:1], lens[2][:1], image[:1].expand(2, -1, -1, -1)

    def run(seed, images=image, jitter=1.0):
        return polar_sample(images, *lens, samples=(3, 4), jitter=jitter, seed=seed)

    for seed in (0, 7, 2**62, -(2**63), 2**63 - 1):
        assert torch.equal(run(seed), run(torch.tensor(seed)))
    assert not torch.equal(run(7), run(8))
    assert not torch.equal(run(7)[0], run(7)[1])  # each image has its own numbers
    assert torch.equal(run(7)[:1], run(7, image[:1]))  # whatever else is in the batch
    assert torch.equal(run(7, jitter=0.0), run(8, jitter=0.0))


@pytest.mark.parametrize("columns", [16, 400])
def test_jitter_is_the_same_on_every_path_and_tier(columns):
    # Odd counts of points, so that rows begin in the middle of a group of four random words.
    arguments, best = grid(rows=9, columns=columns - 1), cpu_capability()
    options = dict(samples=(3, 1), jitter=1.0, seed=5)
    with use_reference():
        expected = polar_sample(*arguments, **options)
    try:
        for tier in _module.tiers():
            _module.set_tier(tier)
            ours = polar_sample(*arguments, **options)
            torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)
    finally:
        _module.set_tier(best)


def _signed(value: int) -> torch.Tensor:
    return torch.tensor(value - (1 << 64) if value >= 1 << 63 else value)


@pytest.mark.parametrize(
    ("key", "counter", "words"),
    [
        (0, (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        (2**64 - 1, (2**64 - 1, 2**64 - 1), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            0x299F31D0_A4093822,
            (0x85A308D3_243F6A88, 0x03707344_13198A2E),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_the_generator_gives_the_known_answers_of_its_authors(key, counter, words):
    got = philox(_signed(key), *(_signed(c) for c in counter))
    assert tuple(int(word) for word in got) == words


@pytest.mark.slow
@pytest.mark.unsanitized
def test_a_compiled_function_keeps_neither_jitter_nor_seed():
    torch._dynamo.reset()
    arguments, counter = grid(), CompileCounter()

    def run(jitter, seed):
        return polar_sample(*arguments, samples=(3, 4), jitter=jitter, seed=seed)

    compiled = torch.compile(run, fullgraph=True, backend=counter)
    for seed, jitter in enumerate((0.1, 0.2, 0.3, 0.4, 0.5)):
        expected = run(jitter, torch.tensor(seed))
        assert torch.equal(compiled(jitter, torch.tensor(seed)), expected)
    assert counter.frame_count == 2  # the first one keeps its jitter, as Dynamo does with any float


# -- types of pixels -------------------------------------------------------------------------------


def test_bfloat16_rounds_to_nearest_even_and_keeps_nan():
    values = torch.tensor([1.0, 1.00390625, 1.01171875, 3.4e38, math.inf, math.nan, -1e-40, -0.0])
    for columns in (8, 3):  # whole registers and less
        arguments = values.reshape(1, 1, 1, -1), torch.arange(float(columns))[None], torch.zeros(1)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            out = polar_sample(*arguments, torch.zeros(1, 2), samples=(1, 1))
        expected = polar_sample(*arguments, torch.zeros(1, 2), samples=(1, 1)).bfloat16()
        torch.testing.assert_close(out, expected, rtol=0, atol=0, equal_nan=True)


@jitters
@pytest.mark.parametrize("rows", [6, 60])  # far and near
@pytest.mark.parametrize("features", [None, 20])
@pytest.mark.parametrize("form", ["planes", "frames", "permuted"])
def test_uint8_pixels_are_what_they_stand_for(form, features, rows, jitter):
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    options = dict(jitter=jitter, seed=2)
    case = sampling(rows=rows, columns=40, features=features, **GENERAL, **options)
    frames = torch.randint(256, (2, 17, 23, 3), dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2)
    image = dict(planes=planes.contiguous(), frames=frames, permuted=planes)[form]
    lens = {n: t for n, t in case.inputs.items() if n != "image"}
    norm = dict(mean=mean.tolist(), std=std.tolist(), channels_last=form == "frames")
    azimuths = case.settings["azimuths"]
    raw = sampling_call(case.inputs, azimuths, (3, 4), **options, **norm).run
    ours = sampling_call(case.inputs, azimuths, (3, 4), **options)
    ours.inputs, ours.mask = lens, None
    ours.run = lambda **lens: raw(image=image, **lens)
    found = [results(ours, is_reference=reference) for reference in (False, True)]
    normalized = (planes / 255 - mean[:, None, None]) / std[:, None, None]
    ours.run = lambda **lens: case.run(image=normalized, **lens)
    expected = results(ours, is_reference=True)
    # The reference normalizes the pixels that it has gathered, by the same operations.
    assert torch.equal(found[1]["out"], expected["out"])
    for gotten in found:
        assert_equal_results(gotten, expected, 1e-4)
    with torch.autocast("cpu", dtype=torch.bfloat16), torch.no_grad():
        assert torch.equal(raw(image=image, **lens), found[0]["out"].bfloat16())


@references
@pytest.mark.parametrize("dtype", [f32, f64, torch.bfloat16])
def test_images_that_are_not_uint8_count_as_they_are(dtype, reference):
    image, *lens = grid(dtype=f64 if dtype == f64 else f32)
    plain = polar_sample(image.to(dtype), *lens, samples=(3, 4))
    with use_reference(reference):
        out = polar_sample(image.to(dtype), *lens, samples=(3, 4), mean=0.5, std=(0.2, 0.3, 0.25))
    torch.testing.assert_close(out, plain)


READINGS = [  # shape, channels_last as it is given, and what is read
    ((2, 17, 23, 1), None, True),
    ((2, 17, 23, 3), None, True),
    ((2, 17, 23, 4), None, True),
    ((2, 1, 17, 23), None, False),
    ((2, 3, 17, 23), None, False),
    ((2, 4, 17, 23), None, False),
    ((2, 12, 23, 3), None, True),
    ((2, 3, 23, 12), None, False),
    ((2, 1, 1, 1), None, False),
    ((2, 1, 17, 3), False, False),
    ((2, 1, 17, 3), True, True),
    ((2, 3, 17, 3), False, False),
    ((2, 3, 17, 3), True, True),
    ((2, 12, 17, 23), False, False),
    ((2, 17, 23, 12), True, True),
]


@references
@pytest.mark.parametrize(("shape", "given", "last"), READINGS)
def test_the_axis_of_the_channels(shape, given, last, reference):
    frames = torch.randint(256, shape, dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2) if last else frames
    _, *lens = grid(planes.shape[2:])
    expected = polar_sample(planes / 255, *lens, samples=(3, 4))
    # What is given holds for an image of any type; without it floating point has channels first.
    images = (frames, frames / 255) if given is not None else (frames, planes / 255)
    with use_reference(reference):
        for image in images:
            got = polar_sample(image, *lens, samples=(3, 4), channels_last=given)
            torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", [(2, 17, 3, 3), (2, 3, 17, 1), (2, 17, 23, 4), (2, 12, 9, 8)])
def test_gradients_of_images_with_channels_last(shape):
    first = sampling(2, shape[1], shape[2:], channels_last=False)
    plain = sampling_call(first.inputs, first.settings["azimuths"], (3, 4))
    last = sampling_call(first.inputs, first.settings["azimuths"], (3, 4), channels_last=True)
    expected = results(plain)
    assert_equal_results(results(first), expected)
    ours, run = first, last.run
    ours.run = lambda image, **lens: run(image=image.permute(0, 2, 3, 1), **lens)
    assert_equal_results(results(ours), expected, 1e-4)


@pytest.mark.slow
@pytest.mark.unsanitized
@pytest.mark.parametrize("last", [False, True])
def test_one_graph_for_uint8_images_of_any_size(last):
    torch._dynamo.reset()
    (_, *lens), counter = grid(), CompileCounter()

    def run(image):
        return polar_sample(image, *lens, samples=(3, 4))

    compiled = torch.compile(run, fullgraph=True, dynamic=True, backend=counter)
    for height, width in ((17, 23), (23, 17), (12, 5), (6, 40)):
        image = torch.randint(256, (2, 3, height, width), dtype=torch.uint8)
        image = image.permute(0, 2, 3, 1).contiguous() if last else image
        assert torch.equal(compiled(image), run(image))
    assert counter.frame_count == 1


# -- blocks of the kernels, and how images lie in memory -------------------------------------------


def test_nothing_is_written_beyond_the_last_token():
    # Rows of three channels are stored four at a time.
    image, radii, *lens = grid((31, 33), 40, 64)
    for channels in (1, 2, 3):
        for count in (1, 2, 3):  # rings that different threads may write
            whole, part = (
                polar_sample(image[:, :channels], r, *lens, samples=(4, 4))
                for r in (radii, radii[:, : 4 * count])
            )
            assert torch.equal(part, whole[:, :count])


@pytest.mark.parametrize(
    ("size", "rows", "columns"),
    [(9, 6, 12), (40, 8, 1031), (40, 1, 2500), (700, 12, 90), (9, 7, 1)],
)
def test_the_patch_does_not_matter_to_an_image(size, rows, columns):
    """Near and far images, rows longer than a block, and rows of no other divisor than 1."""
    arguments = grid((size, size), rows, columns)
    options = dict(layout="image", jitter=1.0, seed=3)
    sampled = [
        polar_sample(*arguments, samples=samples, **options)
        for samples in ((1, 1), (1, columns), (rows, 1), (rows, columns))
    ]
    assert all(torch.equal(sampled[0], other) for other in sampled[1:])
    with use_reference():
        expected = polar_sample(*arguments, samples=(1, 1), **options)
    # The reference computes places in float32.
    torch.testing.assert_close(sampled[0], expected, rtol=0, atol=2e-6 * (10 + size))


@pytest.mark.parametrize("columns", [1025, 1026, 1027, 2049])
@pytest.mark.parametrize("dtype", [f32, f64])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_a_token_longer_than_a_block_ends_where_it_ends(channels, dtype, columns, threads):
    """What is left of it behind a block may be less than the block's last store writes."""
    image, *lens = grid((30, 30), 3, columns, dtype)
    image = image[:, :channels]
    threads(1)
    alone = polar_sample(image, *lens, samples=(1, columns))
    threads(2)
    for _ in range(20):
        assert torch.equal(polar_sample(image, *lens, samples=(1, columns)), alone)
    with use_reference():
        expected = polar_sample(image, *lens, samples=(1, columns))
    torch.testing.assert_close(alone, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("dtype", [f32, torch.bfloat16, torch.uint8])
@pytest.mark.parametrize("samples", [(4, 5), (3, 2), (1, 1), (6, 40)])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
def test_the_layout_of_a_far_image_does_not_matter(channels, samples, dtype):
    """Planes, pixels whose channels lie together, both with gaps, and one value after another."""
    size = 150  # far: more than four pixels for each of the 24 x 120 points
    image = (torch.rand(2, channels, size, size) * 255).to(dtype)
    radii = torch.stack((torch.linspace(0, 75, 24), torch.linspace(10, 90, 24)))
    lens = (radii, torch.linspace(0, 6.2, 120), torch.full((1, 2), 74.5))
    options = dict(mean=[0.5] * channels, std=[0.25] * channels, channels_last=False)
    together = image.permute(0, 2, 3, 1).contiguous()
    padded = F.pad(together, (0, 3))[..., :channels]
    others = {
        "together": together.permute(0, 3, 1, 2), "padded": padded.permute(0, 3, 1, 2),
        "wide": torch.stack((image, image), -1)[..., 0],
        "turned": image.transpose(2, 3).contiguous().transpose(2, 3),
    }  # fmt: skip
    for output in ("tokens", "image"):
        options |= dict(samples=samples, layout=output)
        planes = polar_sample(image, *lens, **options)
        with use_reference():
            expected = polar_sample(image, *lens, **options)
        torch.testing.assert_close(planes, expected, rtol=1e-2, atol=0.05)
        for name, other in others.items():
            assert torch.equal(polar_sample(other, *lens, **options), planes), name


@pytest.mark.slow
@pytest.mark.unsanitized
def test_an_image_of_patches_of_one_point_is_as_fast_as_one_of_whole_rows(threads):
    threads(1)
    arguments = grid((64, 64), 160, 640)
    best = {(1, 1): math.inf, (1, 640): math.inf}
    for _ in range(40):  # in turns; the fastest of each is the least disturbed
        for samples in best:
            start = time.perf_counter()
            polar_sample(*arguments, samples=samples, layout="image")
            best[samples] = min(best[samples], time.perf_counter() - start)
    assert best[1, 1] < 1.5 * best[1, 640]


# -- polar_embed -----------------------------------------------------------------------------------


@jitters
@pytest.mark.parametrize("sizes", [{}, NEAR, dict(size=(300, 302))], ids=["plain", "near", "far"])
def test_embedding_equals_its_two_steps(sizes, jitter):
    fused = sampling(**sizes | dict(samples=(2, 4), features=20, jitter=jitter, seed=3, dtype=f64))
    expected = results(fused)

    def two_steps(image, radii, center, weight, bias):
        samples = polar_sample(image, radii, fused.settings["azimuths"], center, samples=(2, 4),
                               jitter=jitter, seed=3)  # fmt: skip
        return F.linear(samples, weight, bias)

    fused.run = two_steps
    assert_equal_results(results(fused), expected, 1e-11)


def test_embedding_without_bias():
    case = sampling(features=20)
    bias = case.inputs.pop("bias")
    assert torch.equal(case.run(**case.inputs), case.run(**case.inputs, bias=0 * bias))


def test_gradients_of_very_many_tokens_are_as_accurate_as_torch():
    # 131,072 tokens: sums of float32 one by one had 12 times torch's error.
    radii, azimuths = torch.linspace(1, 6, 64)[None], torch.linspace(0, 6.2, 512)
    image, center = torch.randn(4, 1, 12, 12), torch.full((1, 2), 5.5)
    grad = torch.randn(4, 64, 512, 3) + 0.5

    def gradients(dtype):
        weight = torch.ones(3, 1, dtype=dtype, requires_grad=True)
        bias = torch.zeros(3, dtype=dtype, requires_grad=True)
        lens = (t.to(dtype) for t in (image, radii, azimuths, center))
        out = polar_embed(*lens, weight, bias, samples=(1, 1))
        return torch.autograd.grad(out, (weight, bias), grad.to(dtype))

    ours = gradients(f32)
    with use_reference():
        own, exact = gradients(f32), gradients(f64)
    for got, base, want in zip(ours, own, exact, strict=True):
        rounding = torch.finfo(f32).eps * want.abs().max()
        assert (got - want).abs().max() <= max(2 * (base - want).abs().max(), rounding)
