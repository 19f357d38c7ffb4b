"""The rays that the convolutional U-Net reads; test_models.py has the contract of all models."""

import math

import torch
from helpers import network

from darswin.lens import Spherical


@torch.no_grad()
def test_the_lens_enters_as_three_channels():
    lens = Spherical.from_fov([0.2, 0.9], math.radians(165), 15.9)  # no pixel is at θ_max
    model, blind = (network("conv_unet_nano", rays=rays) for rays in (True, False))
    images = torch.rand(2, 3, 33, 35)
    rays = model.prepare(lens, (33, 35)).rays
    assert rays.shape == (2, 3, 33, 35)
    x, y = torch.meshgrid(torch.arange(35.0), torch.arange(33.0), indexing="xy")
    way = torch.stack((x - 17, y - 16))  # from the principal point
    theta = lens.unproject(way.norm(dim=0).flatten()[None].expand(2, -1)).reshape(2, 33, 35)
    seen = theta <= lens.theta_max[:, None, None]
    torch.testing.assert_close(rays.norm(dim=1), seen.float())
    assert not seen.all() and not rays.permute(0, 2, 3, 1)[~seen].any()
    torch.testing.assert_close(rays[:, 2][seen], theta.cos()[seen], rtol=0, atol=1e-5)
    across = way * rays[:, [1, 0]]  # parallel to the way from the principal point
    torch.testing.assert_close(across[:, 0], across[:, 1], rtol=0, atol=1e-4)
    # The rays go through the last three channels of the first convolution.
    state = model.state_dict()
    state["down.0.0.weight"] = state["down.0.0.weight"][:, :3]
    blind.load_state_dict(state)
    assert not torch.allclose(blind(images), model(images, lens))
    model.down[0][0].weight[:, 3:] = 0
    torch.testing.assert_close(blind(images), model(images, lens))
