import torch

from darswin import polar_grid
from darswin.layers.embed import PolarPatchEmbed
from darswin.layers.polar import PolarGridSpec
from darswin.lens import Spherical
from darswin.ops import polar_embed

LENS = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def test_general_lenses():
    images = torch.randn(2, 3, 32, 33, dtype=torch.float64)
    affine, offsets = torch.eye(2) + 0.3 * torch.randn(2, 2, 2), torch.randn(1, 2, 12, 16)

    grid = polar_grid(LENS, (32, 33), rings=4, sectors=8, samples=(3, 2))
    radii, azimuths, center = (t.double() for t in grid[:3])
    embed = PolarPatchEmbed(PolarGridSpec(4, 8, (3, 2))).double()
    tokens = polar_embed(
        images, radii, azimuths, center, embed.proj.weight, embed.proj.bias,
        affine=affine.double(), offsets=offsets.double(), samples=(3, 2),
    )  # fmt: skip
    got = embed(images, grid._replace(affine=affine, offsets=offsets))
    assert torch.equal(got, embed.norm(tokens))
