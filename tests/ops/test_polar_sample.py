"""Tests beyond the contract: positions of polar_sample's points, and values of its pixels."""

import math

import pytest
import torch
import torch.nn.functional as F
from cases import (
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

from darswin.ops import polar_sample, use_reference
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
    tokens = sampling_call(case.inputs, case.settings["azimuths"], (3, 4)).run(**case.inputs)
    # Token (ring 1, sector 0), inner order (S_r, S_φ, C).
    patch = expected[0, :, 3:6, 0:4].permute(1, 2, 0)
    assert tokens.shape == (2, 4, 4, 36)
    torch.testing.assert_close(tokens[0, 1, 0].reshape(3, 4, 3), patch, rtol=1e-10, atol=1e-10)


def test_points_thrown_far_outside_are_zero():
    case = sampling(**GENERAL)
    inputs = case.inputs
    for far in (60.0, 1e6, 1e12, 1e30, 3e38, -60.0, -1e30, -3e38):
        thrown = inputs | dict(radii=inputs["radii"] * 0, offsets=inputs["offsets"] * 0 + far)
        assert (case.run(**thrown) == 0).all()
        away = inputs | dict(radii=inputs["radii"] + 1, affine=inputs["affine"] + 1e3 * far)
        assert case.run(**away).isfinite().all()


def test_accuracy_rule_where_all_points_meet():
    # All points of the innermost rings fall into one pixel, which gives the longest sums.
    def make():
        case = sampling(1, rows=64, columns=512, samples=(8, 8))
        center = case.inputs["center"].round() + 0.5
        return case.replace(radii=torch.linspace(0, 0.4, 64)[None], center=center)

    assert_accurate(make)


def test_indices_and_sizes_beyond_two_to_the_31():
    # This needs little memory: the pages of a new tensor are allocated when they are written.
    side = 46400
    image = torch.empty(1, 1, side, side)
    assert image.numel() > 2**31
    image[0, 0, side - 4 :, side - 4 :] = torch.arange(16.0).reshape(4, 4)
    center = torch.tensor([[side - 3.0, side - 3.0]])
    out = polar_sample(image, torch.tensor([[0.0, 1.0]]), torch.zeros(1), center, samples=(1, 1))
    assert out.flatten().tolist() == [5.0, 6.0]
    side = 2**31 + 8
    image = torch.ones(1, 1, 1, 1, dtype=f64).expand(1, 1, side, side)
    center, radii = torch.full((1, 2), 2.0**31, dtype=f64), torch.tensor([[0.0, 3.5, 100.0]])
    out = polar_sample(image, radii.double(), torch.zeros(1, dtype=f64), center, samples=(1, 1))
    assert out.flatten().tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("dtype", [f32, f64, torch.bfloat16, torch.uint8], ids=str)
def test_a_sample_does_not_depend_on_other_points_or_pixels(dtype, channels):
    """Many points are read from a packed copy and few directly, with the same bits."""
    case = sampling(2, channels, (33, 40), 24, 60, (1, 60), layout="image", mean=0.3, std=0.2,
                    channels_last=False).to(f64 if dtype == f64 else f32)  # fmt: skip
    image, radii, center = case.inputs.values()
    image = (100 + 40 * image).clamp(0, 255).to(dtype)
    out = case.run(image, radii, center)
    assert out.any() and not out.all()  # some points lie outside
    for i in range(radii.shape[1]):
        assert torch.equal(case.run(image, radii[:, i : i + 1], center), out[:, :, i : i + 1])
    one = torch.zeros_like(image, dtype=radii.dtype)
    one[..., 9, 12] = 1
    touched = case.run(one, radii, center) != 0
    image[..., 9, 12] = 255 if dtype == torch.uint8 else math.inf
    changed = case.run(image, radii, center) != out
    assert touched.any() and torch.equal(changed, touched)


# -- NaN and infinity ------------------------------------------------------------------------------


@jitters
@pytest.mark.parametrize("rows", [1, 3])  # an image that is read directly, and a packed one
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_points_at_nan_or_infinity_sample_nothing(bad, rows, jitter):
    # Another input is bad in each image, and one azimuth is bad in all images.
    case = sampling(4, 1, rows=rows, columns=40, samples=(1, 1), jitter=jitter, seed=4,
                    layout="image", **GENERAL)  # fmt: skip
    for b, tensor in enumerate(list(case.inputs.values())[1:]):
        tensor[b].view(-1)[0] = bad
    case.settings["azimuths"][2] = bad
    expected = results(case.to(f64), is_reference=True)
    for found in (results(case), results(case, is_reference=True)):
        assert all(t.isfinite().all() for t in found.values())
        assert_equal_results({n: t.double() for n, t in found.items()}, expected, 1e-3)
    out = expected["out"]
    assert not out[0, :, 0].any() and not out[1:3].any() and not out[3, :, 0, 0].any()
    assert not out[..., 2].any() and out[0].any() == (rows > 1) and out[3].any()


# -- jitter ----------------------------------------------------------------------------------------


def jittered(radii, azimuths, jitter, seed, size=64, **general):
    """Positions (x, y) relative to the centre of the points of one image, (2, N_r, N_a)."""
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


def test_seeds():
    image, *lens = grid()
    lens[0], lens[2], image = lens[0][:1], lens[2][:1], image[:1].expand(2, -1, -1, -1)

    def run(seed, images=image, jitter=1.0):
        return polar_sample(images, *lens, samples=(3, 4), jitter=jitter, seed=seed)

    for seed in (0, 7, 2**62, -(2**63), 2**63 - 1):
        assert torch.equal(run(seed), run(torch.tensor(seed)))
    assert not torch.equal(run(7), run(8))
    assert not torch.equal(run(7)[0], run(7)[1])  # each image has its own random numbers
    assert torch.equal(run(7)[:1], run(7, image[:1]))  # independent of the rest of the batch
    assert torch.equal(run(7, jitter=0.0), run(8, jitter=0.0))


ANSWERS = [  # key, counter and words
    (0, (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    (2**64 - 1, (2**64 - 1, 2**64 - 1), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (0x299F31D0_A4093822, (0x85A308D3_243F6A88, 0x03707344_13198A2E),
     (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)),
]  # fmt: skip


@pytest.mark.parametrize(("key", "counter", "words"), ANSWERS)
def test_the_generator_gives_the_known_answers_of_its_authors(key, counter, words):
    signed = [torch.tensor(n - (1 << 64) if n >= 1 << 63 else n) for n in (key, *counter)]
    assert tuple(int(word) for word in philox(*signed)) == words


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
    assert counter.frame_count == 2  # Dynamo compiles the first float as a constant


# -- types of pixels -------------------------------------------------------------------------------


def test_bfloat16_rounds_to_nearest_even_and_keeps_nan():
    values = torch.tensor([1.0, 1.00390625, 1.01171875, 3.4e38, math.inf, math.nan, -1e-40, -0.0])
    for columns in (8, 3):  # a whole register, and less
        arguments = values.reshape(1, 1, 1, -1), torch.arange(float(columns))[None], torch.zeros(1)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            out = polar_sample(*arguments, torch.zeros(1, 2), samples=(1, 1))
        expected = polar_sample(*arguments, torch.zeros(1, 2), samples=(1, 1)).bfloat16()
        torch.testing.assert_close(out, expected, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("columns", [28, 40])  # read directly, and packed
@pytest.mark.parametrize("form", ["planes", "frames", "permuted"])
def test_uint8_pixels_are_what_they_stand_for(form, columns):
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    norm = dict(mean=mean.tolist(), std=std.tolist(), channels_last=form == "frames")
    options = norm | GENERAL | dict(jitter=0.8, seed=2)
    case = sampling(rows=3, columns=columns, **options)
    frames = torch.randint(256, (2, 17, 23, 3), dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2)
    raw = case.replace(image=dict(planes=planes.contiguous(), frames=frames, permuted=planes)[form])
    lens = [name for name in case.inputs if name != "image"]
    normalized = (planes / 255 - mean[:, None, None]) / std[:, None, None]
    normalized = normalized.permute(0, 2, 3, 1) if form == "frames" else normalized
    expected = results(case.replace(image=normalized), is_reference=True, only=lens)
    # The reference normalizes the gathered pixels with the same operations.
    assert torch.equal(results(raw, is_reference=True, only=lens)["out"], expected["out"])
    found = results(raw, only=lens)
    assert_equal_results(found, expected, 1e-4)
    with torch.autocast("cpu", dtype=torch.bfloat16), torch.no_grad():
        narrow = raw.run(**raw.inputs)
    assert narrow.dtype == torch.bfloat16
    torch.testing.assert_close(narrow.float(), found["out"], rtol=2**-7, atol=0)


@references
@pytest.mark.parametrize("dtype", [f32, f64, torch.bfloat16])
def test_images_that_are_not_uint8_count_as_they_are(dtype, reference):
    image, *lens = grid(dtype=f64 if dtype == f64 else f32)
    plain = polar_sample(image.to(dtype), *lens, samples=(3, 4))
    with use_reference(reference):
        out = polar_sample(image.to(dtype), *lens, samples=(3, 4), mean=0.5, std=(0.2, 0.3, 0.25))
    torch.testing.assert_close(out, plain)


# Value of channels_last → shapes that are read as (B, C, H, W), and shapes read as (B, H, W, C).
READINGS = {
    None: (
        [(2, 1, 17, 23), (2, 3, 17, 23), (2, 4, 17, 23), (2, 3, 23, 12), (2, 1, 1, 1)],
        [(2, 17, 23, 1), (2, 17, 23, 3), (2, 17, 23, 4), (2, 12, 23, 3)],
    ),
    False: ([(2, 1, 17, 3), (2, 3, 17, 3), (2, 12, 17, 23)], []),
    True: ([], [(2, 1, 17, 3), (2, 3, 17, 3), (2, 17, 23, 12)]),
}


@references
@pytest.mark.parametrize("given", READINGS)
def test_the_axis_of_the_channels(given, reference):
    for last, shapes in enumerate(READINGS[given]):
        for frames in (torch.randint(256, shape, dtype=torch.uint8) for shape in shapes):
            planes = frames.permute(0, 3, 1, 2) if last else frames
            _, *lens = grid(planes.shape[2:])
            expected = polar_sample(planes / 255, *lens, samples=(3, 4))
            # A given channels_last holds for every dtype. Without it, floats have channels first.
            images = (frames, planes / 255 if given is None else frames / 255)
            with use_reference(reference):
                for image in images:
                    got = polar_sample(image, *lens, samples=(3, 4), channels_last=given)
                    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)


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


@pytest.mark.parametrize(
    ("size", "rows", "columns"),
    [(9, 6, 12), (40, 8, 1031), (40, 1, 2500), (700, 12, 90), (9, 7, 1)],
)
def test_the_patch_does_not_matter_to_an_image(size, rows, columns):
    """Covers packed images and others, rows longer than a block, and rows of prime length."""
    arguments = grid((size, size), rows, columns)
    options = dict(layout="image", jitter=1.0, seed=3)
    sampled = [
        polar_sample(*arguments, samples=samples, **options)
        for samples in ((1, 1), (1, columns), (rows, 1), (rows, columns))
    ]
    assert all(torch.equal(sampled[0], other) for other in sampled[1:])
    with use_reference():
        expected = polar_sample(*arguments, samples=(1, 1), **options)
    # The reference computes positions in float32.
    torch.testing.assert_close(sampled[0], expected, rtol=0, atol=2e-6 * (10 + size))


@pytest.mark.parametrize("columns", [1025, 1026, 1027, 2049])
@pytest.mark.parametrize("dtype", [f32, f64])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_a_token_longer_than_a_block_ends_where_it_ends(channels, dtype, columns, threads):
    """The rest of a token after a block may be shorter than the width of the block's last store."""
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
def test_the_layout_of_an_image_that_is_read_directly_does_not_matter(channels, samples, dtype):
    """Compares planes, pixels with adjacent channels, both with gaps, and transposed planes."""
    size = 150  # read directly: more than four pixels for each of the 24 x 120 points
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
