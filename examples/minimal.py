"""DarSwin-A in one file, to be read from top to bottom.

DarSwin (Athwale et al., ICCV 2023) is a vision transformer for wide-angle images. It is given the
lens of every image, so a network that was trained with some lenses also works with others. It cuts
an image into rings and sectors, turns each of these patches into a token, and lets the tokens
attend to each other, with a position bias that depends on the angles between them.

This file uses two operators of `darswin.ops` and `torch.nn`, and nothing else of the package. It
takes the package's weights and computes the same logits:

    reference = darswin.create_model("darswin_a_small")
    model = DarSwinA()
    model.load_state_dict(reference.state_dict())

The package adds other lenses, sizes and models, checks of the inputs, speed, and drop path.

Shapes: B images, R rings, A sectors, D channels per token. A polar map is (B, R, A, D).
"""

import math
from collections import OrderedDict

import torch
from torch import Tensor, nn

from darswin.ops import polar_sample, window_attention

WINDOW = 16  # the number of tokens in a window
MERGE = 4  # the number of sectors that merging joins


def project(theta: Tensor, xi: Tensor, focal: Tensor) -> Tensor:
    """Incident angles θ (B, N) in rad → radii (B, N) in pixels: the spherical lens model (eq. 5).

    A ray at the angle θ to the optical axis lands at this radius from the image centre. Each image
    has its own lens, with its own ξ and focal length.
    """
    return focal[:, None] * torch.sin(theta) / (xi[:, None] + torch.cos(theta))


class PatchEmbed(nn.Module):
    """Images and their lenses → the first polar map."""

    def __init__(self, rings: int, sectors: int, samples: int, channels: int, dim: int):
        super().__init__()
        self.rings, self.sectors, self.samples = rings, sectors, samples
        self.proj = nn.Linear(samples * samples * channels, dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, images: Tensor, xi: Tensor, focal: Tensor, theta_max: Tensor) -> Tensor:
        # Rings are equal steps of the incident angle θ, and sectors are equal steps of the azimuth
        # φ. A patch has S × S cells with a sample at the centre of each.
        radial, around = self.rings * self.samples, self.sectors * self.samples
        theta = theta_max[:, None] * (torch.arange(radial) + 0.5) / radial
        azimuths = 2 * math.pi * (torch.arange(around) + 0.5) / around
        height, width = images.shape[2:]
        samples = polar_sample(  # (B, R, A, S · S · C)
            images,
            project(theta, xi, focal),
            azimuths,
            center=torch.tensor([[(width - 1) / 2, (height - 1) / 2]]),
            samples=(self.samples, self.samples),
            # In training, each sample moves at random within its cell.
            jitter=1.0 if self.training else 0.0,
            seed=torch.randint(2**62, ()),
        )
        return self.norm(self.proj(samples))


class PositionBias(nn.Module):
    """The angular relative position bias, a sin Δ + b cos Δ for θ plus the same for φ (eq. 9-11).

    Δ is the angle between two tokens. a and b are learned, for each head and for each offset that
    two tokens in a window of M_r × M_φ can have: from 1 - M_r to M_r - 1 rings, and likewise for
    the sectors.
    """

    def __init__(self, window: tuple[int, int], sectors: int, heads: int):
        super().__init__()
        self.window, self.sectors = window, sectors
        radial, around = 2 * window[0] - 1, 2 * window[1] - 1  # the number of offsets
        self.a_theta, self.b_theta, self.a_phi, self.b_phi = (
            nn.Parameter(nn.init.trunc_normal_(torch.empty(count, heads), std=0.02))
            for count in (radial, radial, around, around)
        )

    def forward(self, ring_width: Tensor) -> Tensor:
        """The width of a ring of each lens (B,), rad → the bias of each offset, by head."""
        rings, sectors = (torch.arange(1 - size, size) for size in self.window)
        theta = ring_width[:, None, None] * rings[:, None]
        phi = 2 * math.pi / self.sectors * sectors[:, None]
        # The rows are in the order 0, 1, …, -2, -1, so an offset is the index of its row.
        a_theta, b_theta = self.a_theta[rings], self.b_theta[rings]
        a_phi, b_phi = self.a_phi[sectors], self.b_phi[sectors]
        radial = a_theta * torch.sin(theta) + b_theta * torch.cos(theta)  # (B, 2·M_r-1, heads)
        around = a_phi * torch.sin(phi) + b_phi * torch.cos(phi)  # (2·M_φ-1, heads)
        return radial.mT[..., None] + around.T[:, None]  # (B, heads, 2·M_r-1, 2·M_φ-1)


class Attention(nn.Module):
    """Multi-head attention in the windows of a polar map, which is periodic in azimuth."""

    def __init__(
        self, dim: int, heads: int, sectors: int, window: tuple[int, int], shift: tuple[int, int]
    ):
        super().__init__()
        self.heads, self.window, self.shift = heads, window, shift
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        self.position_bias = PositionBias(window, sectors, heads)

    def forward(self, x: Tensor, ring_width: Tensor) -> Tensor:
        qkv = self.qkv(x).unflatten(-1, (3, self.heads, -1))  # (B, R, A, 3, heads, D / heads)
        bias = self.position_bias(ring_width)
        return self.proj(window_attention(qkv, bias, window=self.window, shift=self.shift))


class Block(nn.Module):
    """A pre-norm transformer block: attention and an MLP, each with a residual connection."""

    def __init__(self, dim: int, attention: Attention):
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(dim), attention
        fc1, fc2 = nn.Linear(dim, 4 * dim), nn.Linear(4 * dim, dim)
        mlp = OrderedDict(fc1=fc1, gelu=nn.GELU(), fc2=fc2)  # with the names of the package
        self.norm2, self.mlp = nn.LayerNorm(dim), nn.Sequential(mlp)

    def forward(self, x: Tensor, ring_width: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x), ring_width)
        return x + self.mlp(self.norm2(x))


class Merging(nn.Module):
    """Joins 4 neighbouring sectors into one token: (B, R, A, D) → (B, R, A / 4, 2 · D)."""

    def __init__(self, dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(MERGE * dim)
        self.reduction = nn.Linear(MERGE * dim, 2 * dim, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.reduction(self.norm(x.unflatten(2, (-1, MERGE)).flatten(3)))


class Stage(nn.Module):
    """Merging, except in the first stage, and then blocks on a map of rings × sectors."""

    def __init__(self, rings: int, sectors: int, dim: int, depth: int, heads: int, first: bool):
        super().__init__()
        self.downsample = nn.Identity() if first else Merging(dim // 2)
        # A window is 16 tokens along the azimuth. If a ring has fewer, it is several whole rings.
        around = min(WINDOW, sectors)
        window = (WINDOW // around, around)
        # Every second block shifts its windows, so that tokens of neighbouring windows meet.
        if sectors > around:
            shift = (0, around // 4)
        else:
            shift = (window[0] // 2 if rings > window[0] else 0, 0)
        self.blocks = nn.ModuleList(
            Block(dim, Attention(dim, heads, sectors, window, shift if block % 2 else (0, 0)))
            for block in range(depth)
        )

    def forward(self, x: Tensor, ring_width: Tensor) -> Tensor:
        x = self.downsample(x)
        for block in self.blocks:
            x = block(x, ring_width)
        return x


class DarSwinA(nn.Module):
    """DarSwin-A. The defaults are those of `darswin_a_small`, the network of the paper."""

    def __init__(
        self,
        num_classes: int = 1000,
        channels: int = 3,
        dim: int = 96,
        depths: tuple[int, ...] = (2, 2, 18, 2),
        heads: tuple[int, ...] = (3, 6, 12, 24),
        rings: int = 16,
        sectors: int = 64,
        samples: int = 10,
    ):
        super().__init__()
        self.patch_embed = PatchEmbed(rings, sectors, samples, channels, dim)
        # The first stage has 16 × 64 tokens; each later one has 4 times fewer, of twice the width.
        self.stages = nn.ModuleList(
            Stage(rings, sectors // MERGE**k, dim * 2**k, depths[k], heads[k], first=k == 0)
            for k in range(len(depths))
        )
        last = dim * 2 ** (len(depths) - 1)
        self.norm, self.head = nn.LayerNorm(last), nn.Linear(last, num_classes)

    def forward(self, images: Tensor, xi: Tensor, focal: Tensor, theta_max: Tensor) -> Tensor:
        """Images (B, C, H, W) and their lenses → logits (B, num_classes).

        A lens is given by ξ, its focal length in pixels, and its largest incident angle θ_max in
        rad: three tensors of shape (B,).
        """
        x = self.patch_embed(images, xi, focal, theta_max)
        ring_width = theta_max / x.shape[1]
        for stage in self.stages:
            x = stage(x, ring_width)
        return self.head(self.norm(x).mean((1, 2)))


if __name__ == "__main__":
    model = DarSwinA(num_classes=10).eval()
    images = torch.rand(2, 3, 64, 64)
    # Two lenses with a field of view of 160°, whose image circle fills the image: r(θ_max) = 32 px.
    xi, theta_max = torch.tensor([0.2, 0.9]), torch.full((2,), math.radians(80))
    focal = 32 * (xi + torch.cos(theta_max)) / torch.sin(theta_max)
    with torch.inference_mode():
        print(model(images, xi, focal, theta_max))
