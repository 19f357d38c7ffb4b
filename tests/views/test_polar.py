"""The polar view: its grid, its samples, and their embedding."""

import math

import pytest
import torch
import torch.nn.functional as F
from helpers import CAMERAS, refused
from torch.testing import assert_close

from darswin.layers.embed import PolarPatchEmbed
from darswin.lens import Equidistant, Mei, Perspective, Polynomial, Spherical, cat
from darswin.lens.pixels import pixel_rays
from darswin.lens.solve import direction_of, length_of
from darswin.lens.spacing import SPACINGS
from darswin.ops import polar_sample, polar_to_image
from darswin.views import PolarView

f64 = torch.float64
SIZES = dict(rings=16, sectors=64, samples=(10, 10))


def spherical(xi=0.0, fov=3.0479112779, radius=32.0):
    return Spherical.from_fov(torch.tensor(xi, dtype=f64), fov, radius)


def test_ring_borders_in_pixels():
    for xi, spacing, radii in (  # the borders of rings 1, 2, 4, 8, 12 and 15 in a 64 px image
        (0.0, "tan", (2, 4, 8, 16, 24, 30)),
        (0.0, "theta", (0.14, 0.29, 0.60, 1.43, 3.29, 10.49)),
        (0.2, "tan", (7.9, 13.4, 20.2, 26.8, 30.1, 31.6)),
        (0.2, "theta", (0.63, 1.27, 2.61, 5.91, 11.7, 22.9)),
        (0.5, "tan", (12.7, 19.3, 25.2, 29.4, 31.1, 31.8)),
        (0.5, "theta", (1.11, 2.24, 4.56, 9.88, 17.4, 27.0)),
        (1.0, "tan", (16.8, 23.2, 27.8, 30.5, 31.5, 31.9)),
        (1.0, "theta", (1.60, 3.20, 6.47, 13.4, 21.6, 29.1)),
        (0.7, "radius", (2, 4, 8, 16, 24, 30)),
    ):
        borders = PolarView(**SIZES, spacing=spacing).grid(spherical(xi), (64, 64)).borders[0]
        expected = torch.tensor((0, *radii, 32), dtype=f64)
        assert_close(borders[[0, 1, 2, 4, 8, 12, 15, 16]], expected, rtol=0, atol=0.06)


@pytest.mark.parametrize(
    ("spacing", "degrees"),
    [  # DarSwin-Unet at a field of view of 175°
        ("g", (0, 13.7, 30.4, 45.3, 54.7, 60.9, 65.5, 69.2, 72.3, 74.9, 77.3, 79.4, 81.3, 83.0,
               84.6, 86.1, 87.5)),
        ("tan", (0, 55.1, 70.8, 76.9, 80.1, 82.1, 83.4, 84.3)),
        ("theta", [87.5 * k / 16 for k in range(17)]),
    ],
)  # fmt: skip
def test_ring_borders_in_degrees(spacing, degrees):
    lens = spherical(0.3, math.radians(175))
    borders = PolarView(**SIZES, spacing=spacing).grid(lens, (64, 64)).borders
    got = torch.rad2deg(lens.unproject(borders))[0, : len(degrees)]
    assert_close(got, torch.tensor(degrees, dtype=f64), rtol=0, atol=0.06)


@pytest.mark.parametrize("sample_spacing", SPACINGS)
def test_sample_spacing_splits_each_ring_equally(sample_spacing):
    lens = spherical(0.4, 2.8)
    options = dict(spacing="theta", sample_spacing=sample_spacing, placement="edges")
    grid = PolarView(4, 4, (6, 2), **options).grid(lens, (64, 64))
    measure = {
        "theta": lambda t: t,
        "tan": torch.tan,
        "radius": lens.project,
        "g": lambda t: (
            8.31578947368421 / 3 * (t / 1.4) ** 5
            + 2 / 3 * (1 - (1 - (t / 1.4).clamp(max=1)) ** 2.288135593220339)
        ),
    }[sample_spacing]
    steps = measure(lens.unproject(grid.radii)).unflatten(1, (4, 6)).diff(dim=2)
    assert_close(steps, steps[..., :1].expand_as(steps), rtol=1e-6, atol=1e-9)
    assert_close(lens.unproject(grid.borders)[0], 1.4 * torch.arange(5, dtype=f64) / 4)


def test_works_beyond_90_degrees_except_for_tan():
    lens = Polynomial([350.4, -17.5, 27.5, -2.4], math.radians(112))
    for spacing in ("theta", "radius", "g"):
        grid = PolarView(**SIZES, spacing=spacing).grid(lens, (966, 1280))
        assert grid.radii.isfinite().all() and (grid.borders.diff(dim=1) > 0).all()
    wide = Spherical(0.9, 30.0, math.pi / 2)
    for options in (dict(spacing="tan"), dict(spacing="theta", sample_spacing="tan")):
        for one in (lens, wide):
            with pytest.raises(ValueError, match=r"spacing='tan' needs .* below 90°.*got \d+\.\d°"):
                PolarView(**SIZES, **options).grid(one, (966, 1280))


def test_center_and_batch():
    view, lens = PolarView(**SIZES), Perspective([10.0, 20.0], 1.0, center=[[3.0, 4.0], [5.0, 6.0]])
    grid = view.grid(lens, (48, 64))
    assert grid.center.tolist() == [[3.0, 4.0], [5.0, 6.0]]
    assert_close(grid.radii[1], 2 * grid.radii[0])
    assert view.grid(Perspective(10.0, 1.0), (48, 64)).center.tolist() == [[31.5, 23.5]]
    assert PolarView(**SIZES, spacing="tan").grid(lens[:0], (48, 64)).radii.shape == (0, 160)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("sample_spacing", SPACINGS)
def test_gradients_reach_the_lens(spacing, sample_spacing):
    xi = torch.tensor([0.3, 0.6], dtype=f64, requires_grad=True)
    focal = torch.tensor([20.0, 25.0], dtype=f64, requires_grad=True)
    theta_max = torch.tensor([1.2, 1.3], dtype=f64, requires_grad=True)

    view = PolarView(3, 4, (3, 2), spacing=spacing, sample_spacing=sample_spacing)

    def radii(xi, focal, theta_max):
        return view.grid(Spherical(xi, focal, theta_max), (64, 64)).radii

    assert torch.autograd.gradcheck(radii, (xi, focal, theta_max))


def test_wrong_settings():
    for change, message in (
        (dict(rings=0), "rings must be an int of at least 1, got 0"),
        (dict(sectors=2.0), "sectors must be an int"),
        (dict(samples=(0, 3)), r"samples must be \(S_r, S_φ\)"),
        (dict(samples=(3,)), r"samples must be \(S_r, S_φ\)"),
        (dict(spacing="log"), "spacing must be one of"),
        (dict(sample_spacing="log"), "sample_spacing must be one of"),
        (dict(placement="middle"), "placement must be one of"),
        (dict(placement="edges", samples=(1, 4)), "2 or more samples"),
        (dict(theta_max=4), r"theta_max must be in \(0, π\), got 4"),
        (dict(theta_max=1.0, spacing="g"), "a fixed theta_max needs spacing='theta', got 'g'"),
        (dict(theta_max=1.0, sample_spacing="tan"), "needs spacing='theta', got 'tan'"),
        (dict(jitter=2.0), "jitter"),
        (dict(layout="rows"), "layout"),
    ):
        refused(message, PolarView, **(SIZES | change))


@pytest.mark.parametrize("spacing", ["theta", "g", "radius"])
@pytest.mark.parametrize(
    "aside",
    [
        {},
        {"affine": [[1.0, 0.01], [0.0, 0.9996]]},
        {"tangential": [6e-4, -3.5e-3]},
        {"affine": [[1.0, 0.0], [0.0, 1.2]], "prism": [1e-3, 0.0, -2e-3, 0.0]},
    ],
)
def test_points_are_where_the_lens_projects_their_rays(spacing, aside):
    xi = torch.tensor([2.35], dtype=f64)  # as in tests/lens/files/kitti360_02.yaml, to 95°
    lens = Mei(xi, 1390.0, [0.032, 2.4], math.radians(95), [708.5, 697.0], **aside)
    grid = PolarView(**SIZES, spacing=spacing).grid(lens, (1400, 1400))
    around = grid.radii[0, :, None, None] * direction_of(grid.azimuths)
    matrix = torch.eye(2, dtype=f64) if grid.affine is None else grid.affine[0]
    points = grid.center[0] + around @ matrix.T
    if grid.offsets is not None:
        points = points + grid.offsets[0].permute(1, 2, 0)
    theta = lens.unproject(grid.radii[0])
    expected = lens.project_rays(theta[:, None], grid.azimuths[None])
    assert_close(points, expected, rtol=0, atol=1e-8)
    assert (grid.affine is None) == ("affine" not in aside)
    assert (grid.offsets is None) == (not {"tangential", "prism"} & aside.keys())
    if grid.offsets is not None:
        assert grid.offsets.shape == (1, 2, 160, 640) and 0.5 < grid.offsets.abs().max() < 10


@pytest.mark.parametrize("lens", [spherical(0.4), *(c.to(f64).resized(0.05) for c in CAMERAS)])
def test_a_fixed_theta_max_is_the_end_of_the_grid_for_every_lens(lens):
    end, size = lens.theta_max.item(), (64, 64)
    if lens.image_size is not None:
        size = tuple(int(side) for side in lens.image_size[0])
    sizes = dict(rings=8, sectors=12, samples=(3, 2))
    # A lens that sees more.
    spec, usual = (PolarView(**sizes, theta_max=t) for t in (0.7 * end, None))
    cut = lens.with_theta_max(0.7 * end)
    for made in ("grid", "pixel_grid"):
        found, expected = (getattr(s, made)(a, size) for s, a in ((spec, lens), (usual, cut)))
        for a, b in zip(found[:-1], expected[:-1], strict=True):
            assert (a is None) == (b is None)
            if b is not None:  # `cut` has no points beyond its θ_max
                assert_close(a[~b.isnan()], b[~b.isnan()])
    # A lens that sees less: no points beyond its θ_max, and the ring of a pixel is that of its θ.
    spec = PolarView(**sizes, theta_max=1.5 * end)
    theta = (torch.arange(24, dtype=f64) + 0.5) / 24 * 1.5 * end
    grid = spec.grid(lens, size)
    assert torch.equal(grid.radii.isnan()[0], theta > end)
    seen = theta[theta <= end][None]
    assert_close(grid.radii[:, : seen.shape[1]], lens.project(seen))
    assert (grid.borders.diff() > 0).all() and grid.borders.isfinite().all()
    *pixels, _ = spec.pixel_grid(lens, size)
    r_max, center, affine, points = pixels[1:]
    angles = (torch.arange(8, dtype=f64) + 0.5) / 8 * 1.5 * end
    of_ring = angles[None, :, None, None].expand(1, 8, 12, 1)
    options = dict(r_max=r_max, affine=affine, points=points)
    found = polar_to_image(of_ring, pixels[0], center, size, **options)[0, 0]
    exact = pixel_rays(lens, size)[0][0]
    inner = (exact > angles[0]) & (exact < end)
    assert inner.any() and (found[inner] - exact[inner]).abs().max() < 0.1 * end
    assert not found[exact.isnan()].any()


@pytest.mark.parametrize("placement", ["centers", "edges"])
@pytest.mark.parametrize("samples", [(2, 2), (2, 3), (4, 2)])
def test_polar_images_come_back_to_their_pixels(samples, placement):
    options = dict(layout="image", placement=placement, spacing="g", sample_spacing="theta")
    view, lens = PolarView(8, 32, samples, **options), Equidistant.from_fov([3.0, 3.0], 40.0)
    r = length_of(torch.stack(torch.meshgrid(*[torch.arange(80.0) - 39.5] * 2, indexing="ij"), -1))
    for lenses in (lens[:1], lens):  # one lens has a plan
        prepared = view.prepare(lenses, (80, 80))
        back = view.back(view.see(r.expand(2, 1, 80, 80), prepared), prepared)
        inner = (r > 16) & (r < 34)  # not around the pole, and not beyond the picture
        assert (back - r)[..., inner].abs().max() < 0.05
    places = prepared.grid.radii[..., None, None] * direction_of(prepared.grid.azimuths) + 39.5
    rays = view.ray_channels(lens, (80, 80)).movedim(1, -1)
    assert_close(rays, lens.unproject_points(places, (80, 80)), rtol=0, atol=1e-5)


# -- samples and their embedding ----------------------------------------------------------------

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def test_polar_sample_replaces_grid_sample_on_a_polar_grid():
    images, view = torch.randn(2, 3, 32, 33), PolarView(4, 8, (3, 2), spacing="tan", layout="image")
    grid = view.grid(LENSES, (32, 33))
    places = grid.radii[:, :, None, None] * direction_of(grid.azimuths) + grid.center[:, None, None]
    mesh = 2 * places / torch.tensor([32.0, 31.0]) - 1
    expected = F.grid_sample(images, mesh, align_corners=True)
    assert_close(view(images, LENSES), expected, rtol=1e-4, atol=1e-4)
    one = view(images, LENSES[:1])  # one lens serves all images
    assert torch.equal(one, view(images, LENSES[[0, 0]]))


def test_the_operators_take_all_of_a_grid():
    images = torch.randn(2, 3, 32, 33, dtype=torch.float64)
    affine, offsets = torch.eye(2) + 0.3 * torch.randn(2, 2, 2), torch.randn(1, 2, 12, 16)
    grid = PolarView(4, 8, (3, 2)).grid(LENSES, (32, 33))
    grid = grid._replace(affine=affine, offsets=offsets)
    radii, azimuths, center, _, _, affine, offsets = (t.double() for t in grid)
    options = dict(samples=(3, 2), affine=affine, offsets=offsets)
    for layout in ({}, dict(layout="tokens"), dict(layout="image")):  # tokens by default in both
        sample = PolarView(4, 8, (3, 2), **layout)
        sample.grid = lambda lens, size: grid
        expected = polar_sample(images, radii, azimuths, center, **options, **layout)
        assert torch.equal(sample(images, LENSES), expected)
    embed = PolarPatchEmbed(18, 5).double()
    tokens = polar_sample(images, radii, azimuths, center, **options)
    expected = embed.norm(F.linear(tokens, embed.proj.weight, embed.proj.bias))
    assert torch.equal(embed(tokens), expected)


def test_samples_get_the_dtype_of_the_weights():
    frames, view = torch.randint(256, (2, 3, 32, 33)).byte(), PolarView(4, 8, (3, 2))
    embed, taken = PolarPatchEmbed(18, 5), []
    prepared = view.prepare(LENSES, (32, 33))
    wide = embed(view.see(frames, prepared))
    embed.proj.register_forward_pre_hook(lambda _, inputs: taken.append(inputs[0].dtype))
    for dtype in (torch.bfloat16, torch.float64, torch.float32):
        found = embed.to(dtype)(view.see(frames, prepared, dtype))
        assert taken.pop() == found.dtype == dtype
        assert_close(found.float(), wide, rtol=0.05, atol=0.05)
    with torch.autocast("cpu", torch.bfloat16):
        found = embed(view.see(frames, prepared))
    assert_close(found.float(), wide, rtol=0.05, atol=0.05)


def test_it_jitters_only_in_training_and_by_torchs_generator():
    images = torch.randn(2, 3, 32, 32)
    sample = PolarView(4, 8, (3, 2), jitter=1.0).eval()
    assert torch.equal(sample(images, LENSES), sample(images, LENSES))
    sample.train()
    torch.manual_seed(3)
    first, second = sample(images, LENSES), sample(images, LENSES)
    torch.manual_seed(3)
    assert torch.equal(sample(images, LENSES), first) and not torch.equal(first, second)


def test_images_of_uint8_and_those_that_do_not_fit():
    sample = PolarView(4, 8, (3, 2), mean=0.4, std=0.2)
    shapes = ((2, 32, 33, 4), None), ((2, 1, 32, 3), False), ((2, 32, 3, 1), True)
    for shape, given in shapes:
        images = torch.randint(256, shape, dtype=torch.uint8)
        planes = images.permute(0, 3, 1, 2) if given in (None, True) else images
        expected = sample((planes / 255 - 0.4) / 0.2, LENSES)
        assert_close(sample(images, LENSES, given), expected, rtol=1e-4, atol=1e-4)
    refused(r"\(B, C, H, W\), got \(3, 32", sample, torch.zeros(3, 32, 32), LENSES)
    refused("images must be a tensor, got list", sample, [1], LENSES, error=TypeError)
    refused("both .* pass channels_", sample, torch.zeros(2, 1, 32, 3).byte(), LENSES)
    wrong = torch.zeros(2, 1, 9, 9), LENSES, "yes"
    refused("channels_last must be True", sample, *wrong, error=TypeError)


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens", [*CAMERAS, cat([CAMERAS[1].replace(tangential=None), CAMERAS[0]])[:1]]
)
def test_a_calibrated_camera_compiles(lens):
    sample = PolarView(8, 32, (2, 2))
    images, lens = torch.rand(1, 3, 96, 128), lens.resized((96, 128))
    compiled = torch.compile(sample, fullgraph=True, backend="aot_eager")
    assert_close(compiled(images, lens), sample(images, lens))
