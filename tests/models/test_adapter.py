import pytest
import torch
from torch import nn

from darswin.lens import BrownConrady, Equidistant, KannalaBrandt, Polynomial, Spherical
from darswin.models import LensAdapter

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 24.0)
GENERAL = KannalaBrandt(
    14.0, [0.01], 1.5, center=[22.0, 27.0], affine=[[1.0, 0.1], [0.0, 1.1]], tangential=[0.02, 0.01]
)


class Network(nn.Module):
    """Answers as segmentation_models_pytorch and timm do: masks of several sizes, a label."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 5, 3, padding=1)
        self.down = nn.Conv2d(5, 6, 2, 2)

    def forward(self, x):
        fine = self.conv(x)
        coarse = self.down(fine)
        return dict(masks=[fine, coarse], label=coarse.mean((2, 3)))


def smooth(height, width):
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    return torch.stack((torch.sin(x / 12), torch.cos(y / 12), torch.sin((x + y) / 16)))[None]


@pytest.mark.parametrize(
    "lens", [LENSES, Polynomial([10.0, 0.4], 2.1), GENERAL], ids=["two", "beyond 90°", "general"]
)
@pytest.mark.parametrize("spacing", ["theta", "g", "radius"])
def test_what_is_taken_to_the_square_comes_back(lens, spacing):
    images = smooth(48, 52).expand(2, -1, -1, -1)
    out = LensAdapter(nn.Identity(), 192, spacing)(images, lens)
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(52.0), indexing="ij")
    theta, _ = lens.unproject_pixels(torch.stack((x, y), -1)[None], (48, 52))
    seen = lens.sees(theta).expand(2, -1, -1)[:, None].expand_as(out)
    inner = (theta < 0.9 * lens.theta_max[:, None, None]).expand(2, -1, -1)[:, None]
    inside = torch.zeros(48, 52, dtype=torch.bool)
    inside[4:-4, 4:-4] = True  # the image ends there, its views do not
    inner = (inner & inside).expand_as(out)
    assert (out[~seen] == 0).all() and inner.float().mean() > 0.3
    assert (out - images).abs()[inner].max() < 0.02
    coarse = LensAdapter(nn.AvgPool2d(4), 192, spacing)(images, lens)
    assert coarse.shape == images.shape and (coarse - images).abs()[inner].mean() < 0.02


def test_a_lens_in_float32_sees_as_much_as_in_float64():
    focal = torch.tensor([40.0], dtype=torch.float64)
    exact = BrownConrady(focal, [-0.22, 0.13, 0.028], tangential=[1e-3, 1e-3], center=[25.0, 24.0])
    adapter, images = LensAdapter(nn.Identity(), 192), 2 + smooth(48, 52)
    for lens in (exact, exact.to(torch.float32)):
        out = adapter(images, lens)[..., 2:-2, 2:-2]
        assert (out - images[..., 2:-2, 2:-2]).abs().max() < 0.2


def test_outputs_of_any_resolution_come_back_and_others_pass_through():
    network = Network().eval()
    adapter, images = LensAdapter(network, 32), torch.randn(2, 3, 48, 40)
    prepared = adapter.prepare(LENSES, (48, 40))
    out = adapter.run(images, prepared)
    assert [m.shape for m in out["masks"]] == [(2, 5, 48, 40), (2, 6, 48, 40)]
    assert out["label"].shape == (2, 6)
    again = adapter(images, LENSES)
    assert all(torch.equal(a, b) for a, b in zip(again["masks"], out["masks"], strict=True))
    one = adapter(images, LENSES[:1])
    assert torch.equal(one["label"][0], out["label"][0])


@pytest.mark.parametrize("general", [False, True])
def test_it_trains_end_to_end_with_its_lens(general):
    adapter, images = LensAdapter(Network(), 32), torch.randn(2, 3, 48, 48, requires_grad=True)
    focal = torch.tensor([14.0], requires_grad=True)
    center = torch.tensor([[22.0, 27.0]], requires_grad=True)
    tangential = dict(tangential=[[0.02, 0.01]]) if general else {}
    lens = KannalaBrandt(focal, [[0.01]], 1.5, center=center, **tangential)
    out = adapter(images, lens)
    (out["masks"][0].square().mean() + out["masks"][1].square().mean()).backward()
    for tensor in (images, focal, center, *adapter.parameters()):
        assert tensor.grad.isfinite().all() and tensor.grad.abs().sum() > 0


def test_double_precision_and_half():
    lens, images = LENSES.to(torch.float64), torch.rand(2, 3, 40, 40)
    exact = LensAdapter(nn.Identity(), 64)(images.double(), lens)
    assert exact.dtype == torch.float64
    rounded = LensAdapter(nn.Identity(), 64)(images, LENSES)
    torch.testing.assert_close(rounded.double(), exact, atol=1e-3, rtol=0)
    half = LensAdapter(nn.Identity(), 64)(images.bfloat16(), LENSES)
    assert half.dtype == torch.bfloat16 and (half - rounded).abs().max() < 0.02


def test_wrong_arguments():
    for size in (0, -1, 2.5, "8"):
        with pytest.raises(ValueError, match="size must be an int of at least 1, got"):
            LensAdapter(nn.Identity(), size)
    with pytest.raises(ValueError, match=r"spacing must be one of .*, got 'r'"):
        LensAdapter(nn.Identity(), 8, "r")
    adapter, images = LensAdapter(nn.Identity(), 8), torch.zeros(3, 3, 40, 40)
    with pytest.raises(TypeError, match=r"lens must be a darswin\.lens\.Lens, got NoneType"):
        adapter(images, None)
    with pytest.raises(TypeError, match=r"images must be in floating point, got torch\.uint8"):
        adapter(images.byte(), LENSES[:1])
    with pytest.raises(TypeError, match=r"images must be in floating point, got torch\.uint8"):
        adapter.run(images[..., :3].byte(), adapter.prepare(LENSES[:1], (40, 3)))
    with pytest.raises(ValueError, match="one lens or one an image, 3, got 2"):
        adapter(images, LENSES)
    with pytest.raises(ValueError, match=r"belongs to images of \(H, W\) = \(20, 20\)"):
        adapter(images, LENSES.replace(image_size=torch.tensor([[20.0, 20.0]] * 2)))
    with pytest.raises(ValueError, match="spacing='tan' needs lenses"):
        LensAdapter(nn.Identity(), 8, "tan")(images, Equidistant(9.0, 1.7))
