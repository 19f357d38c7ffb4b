"""The models on the cameras that people have: beyond 90°, off centre, rectangular, not round."""

import math

import pytest
import torch

from darswin import PolarSample, create_model, polar_grid
from darswin.lens import Mei, Polynomial, Spherical, Tabulated, cat
from darswin.ops import use_reference

FRONT = Polynomial(
    [350.4, -17.5, 27.5, -2.4], math.radians(94.99), [641.3, 486.1],
    affine=[[1.0, 0.0], [0.0, 1.0004]], image_size=(966, 1280),
)  # fmt: skip
MEI = Mei(
    2.35, 1390.0, [0.032, 2.4], math.radians(98.9), [708.5, 697.0], tangential=[6e-4, -3.5e-4],
    affine=[[1.0, 0.0], [0.0, 1389.2 / 1390.0]], image_size=(1400, 1400),
)  # fmt: skip


@pytest.mark.parametrize("name", ["darswin_a_nano", "darswin_ra_nano"])
@pytest.mark.parametrize(("lens", "size"), [(FRONT, (96, 128)), (MEI, (140, 140))])
def test_a_calibrated_camera_runs(name, lens, size):
    lens = lens.resized(size)
    model = create_model(name, num_classes=5, jitter=0.0)
    images = torch.rand(2, 3, *size, requires_grad=True)
    out = model(images, lens)
    out.square().sum().backward()
    grad, images.grad = images.grad.clone(), None
    assert out.isfinite().all() and grad.isfinite().all() and grad.abs().sum() > 0
    with use_reference():
        expected = model(images, lens)
        expected.square().sum().backward()
    torch.testing.assert_close(out, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(grad, images.grad, rtol=1e-3, atol=1e-6)


def test_rays_keep_their_place_in_the_polar_image():
    """Two cameras that see the same scene give the same polar image, but for interpolation."""
    sample = PolarSample(8, 32, (4, 4), layout="image")
    views = []
    for lens in (FRONT, MEI):
        size = tuple(int(s) // 2 for s in lens.image_size[0].tolist())
        lens = lens.resized(size).with_theta_max(1.3)
        y, x = torch.meshgrid(*(torch.arange(float(s)) for s in size), indexing="ij")
        theta, azimuth = lens.with_theta_max(None).unproject_pixels(torch.stack((x, y), -1))
        scene = torch.stack((torch.cos(3 * theta), torch.cos(2 * azimuth), torch.sin(azimuth)))
        views.append(sample(scene.nan_to_num(0)[None], lens))
    grid = polar_grid(lens, size, rings=8, sectors=32, samples=(4, 4))
    apart = (views[0] - views[1])[..., 2:, :].abs().amax((0, 2, 3))  # azimuths have no centre
    # Most beside the principal point, where the azimuth changes from pixel to pixel.
    assert apart[0] < 1e-3 and apart.max() < 2e-2, (apart, grid.radii[0, :3])


def test_a_batch_of_several_models_is_each_of_them():
    lenses = [
        FRONT.resized((96, 128)),
        Spherical.from_fov(0.7, 3.0, 48.0, center=[63.5, 47.5], image_size=(96, 128)),
        MEI.replace(tangential=None).resized((96, 128)),
    ]
    batch = cat(lenses)
    assert isinstance(batch, Tabulated)
    model = create_model("darswin_a_nano", num_classes=5).eval()
    images = torch.rand(3, 3, 96, 128)
    together = model(images, batch)
    for k, lens in enumerate(lenses):
        torch.testing.assert_close(
            model(images[k : k + 1], lens)[0], together[k], rtol=0, atol=2e-5
        )


def test_images_of_another_size_than_the_lens_are_refused():
    model = create_model("darswin_a_nano", num_classes=5)
    for net in (model, PolarSample(8, 32, (2, 2))):
        with pytest.raises(ValueError, match=r"belongs to images of \(H, W\) = \(966, 1280\), got"):
            net(torch.rand(1, 3, 96, 128), FRONT)
    many = FRONT.resized((96, 128)).expand(2)
    assert model(torch.rand(2, 3, 96, 128), many).shape == (2, 5)


@pytest.mark.parametrize("lens", [FRONT, MEI, cat([MEI.replace(tangential=None), FRONT])[:1]])
def test_a_calibrated_camera_compiles(lens):
    sample = PolarSample(8, 32, (2, 2))
    images, lens = torch.rand(1, 3, 96, 128), lens.resized((96, 128))
    compiled = torch.compile(sample, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(images, lens), sample(images, lens))
