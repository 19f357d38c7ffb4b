"""DarSwin-A in one file: lens → grid → sampling → tokens → blocks → head.

This file shows how the network works. It uses the two operators of `darswin.ops` and `torch.nn`,
and nothing else of the package. Its layers have the names of the package's layers, so it takes
the same weights, and the logits are the same:

    reference = darswin.create_model("darswin_a_small")
    model = DarSwinA()
    model.load_state_dict(reference.state_dict())

The package adds other lenses, sizes and models, checks, speed, and drop path in training.
A polar map has the shape (B, R, A, D): image, ring, sector, channel.
"""

import math
from collections import OrderedDict

import torch
from torch import Tensor, nn

from darswin.ops import polar_sample, window_attention

WINDOW = 16  # tokens in a window
MERGE = 4  # sectors that are joined between two stages


def project(theta: Tensor, xi: Tensor, focal: Tensor) -> Tensor:
    """Incident angles (B, N) in rad → radii (B, N) in px, of the spherical lens model (eq. 5)."""
    return focal[:, None] * torch.sin(theta) / (xi[:, None] + torch.cos(theta))


class PatchEmbed(nn.Module):
    """Samples S × S points in each polar patch, and maps them to a token of D channels."""

    def __init__(self, rings: int, sectors: int, samples: int, channels: int, dim: int):
        super().__init__()
        self.rings, self.sectors, self.samples = rings, sectors, samples
        self.proj = nn.Linear(samples * samples * channels, dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, images: Tensor, xi: Tensor, focal: Tensor, theta_max: Tensor) -> Tensor:
        # The patches split θ and φ into equal steps; the samples stand at the centres of cells.
        rows, columns = self.rings * self.samples, self.sectors * self.samples
        theta = theta_max[:, None] * (torch.arange(rows) + 0.5) / rows
        azimuths = 2 * math.pi * (torch.arange(columns) + 0.5) / columns
        height, width = images.shape[2:]
        tokens = polar_sample(
            images,
            project(theta, xi, focal),
            azimuths,
            center=torch.tensor([[(width - 1) / 2, (height - 1) / 2]]),
            samples=(self.samples, self.samples),
            # In training every point moves at random inside its cell.
            jitter=1.0 if self.training else 0.0,
            seed=torch.randint(2**62, ()),
        )
        return self.norm(self.proj(tokens))


class PositionBias(nn.Module):
    """The angular relative position bias: a sin Δ + b cos Δ along θ and along φ (eq. 9 to 11)."""

    def __init__(self, window: tuple[int, int], sectors: int, heads: int):
        super().__init__()
        self.window, self.sectors = window, sectors
        along_theta, along_phi = 2 * window[0] - 1, 2 * window[1] - 1  # offsets in a window
        self.a_theta, self.b_theta, self.a_phi, self.b_phi = (
            nn.Parameter(nn.init.trunc_normal_(torch.empty(count, heads), std=0.02))
            for count in (along_theta, along_theta, along_phi, along_phi)
        )

    def forward(self, ring_width: Tensor) -> Tensor:
        """Widths of a ring (B,) in rad → bias (B, heads, 2·M_r-1, 2·M_φ-1) of each offset."""
        rings, sectors = (torch.arange(1 - size, size) for size in self.window)
        # A negative offset counts from the end: the rows hold Δ = 0, 1, …, -2, -1.
        a_theta, b_theta = self.a_theta[rings], self.b_theta[rings]
        a_phi, b_phi = self.a_phi[sectors], self.b_phi[sectors]
        theta = ring_width[:, None, None] * rings[:, None]
        phi = 2 * math.pi / self.sectors * sectors[:, None]
        radial = a_theta * torch.sin(theta) + b_theta * torch.cos(theta)  # (B, 2·M_r-1, heads)
        around = a_phi * torch.sin(phi) + b_phi * torch.cos(phi)  # (2·M_φ-1, heads)
        return radial.transpose(1, 2)[..., None] + around.T[:, None]


class Attention(nn.Module):
    """Multi-head attention in windows of a polar map, which wraps around in azimuth."""

    def __init__(
        self, dim: int, heads: int, sectors: int, window: tuple[int, int], shift: tuple[int, int]
    ):
        super().__init__()
        self.heads, self.window, self.shift = heads, window, shift
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        self.position_bias = PositionBias(window, sectors, heads)

    def forward(self, x: Tensor, ring_width: Tensor) -> Tensor:
        qkv = self.qkv(x).unflatten(-1, (3, self.heads, -1))  # (B, R, A, 3, heads, d)
        bias = self.position_bias(ring_width)
        return self.proj(window_attention(qkv, bias, window=self.window, shift=self.shift))


class Block(nn.Module):
    """A pre-norm transformer block: attention and MLP, each with a residual connection."""

    def __init__(self, dim: int, attention: Attention):
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(dim), attention
        mlp = dict(fc1=nn.Linear(dim, 4 * dim), gelu=nn.GELU(), fc2=nn.Linear(4 * dim, dim))
        self.norm2, self.mlp = nn.LayerNorm(dim), nn.Sequential(OrderedDict(mlp))

    def forward(self, x: Tensor, ring_width: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x), ring_width)
        return x + self.mlp(self.norm2(x))


class Merging(nn.Module):
    """Joins 4 neighbouring sectors into one token of twice the width."""

    def __init__(self, dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(MERGE * dim)
        self.reduction = nn.Linear(MERGE * dim, 2 * dim, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.reduction(self.norm(x.unflatten(2, (-1, MERGE)).flatten(3)))


class Stage(nn.Module):
    """Merging, except in the first stage, and then the blocks, every second one shifted."""

    def __init__(self, rings: int, sectors: int, dim: int, depth: int, heads: int, first: bool):
        super().__init__()
        self.downsample = nn.Identity() if first else Merging(dim // 2)
        # A window runs along the azimuth. Where the ring is too short, it takes in more rings.
        around = min(WINDOW, sectors)
        window = (WINDOW // around, around)
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
        self.stages = nn.ModuleList(
            Stage(rings, sectors // MERGE**k, dim * 2**k, depths[k], heads[k], first=k == 0)
            for k in range(len(depths))
        )
        last = dim * 2 ** (len(depths) - 1)
        self.norm, self.head = nn.LayerNorm(last), nn.Linear(last, num_classes)

    def forward(self, images: Tensor, xi: Tensor, focal: Tensor, theta_max: Tensor) -> Tensor:
        """Images (B, C, H, W) and the lens of each: ξ, focal length in px, θ_max in rad, (B,)."""
        x = self.patch_embed(images, xi, focal, theta_max)
        ring_width = theta_max / x.shape[1]
        for stage in self.stages:
            x = stage(x, ring_width)
        return self.head(self.norm(x).mean((1, 2)))


if __name__ == "__main__":
    model = DarSwinA(num_classes=10).eval()
    images = torch.rand(2, 3, 64, 64)
    xi, theta_max = torch.tensor([0.2, 0.9]), torch.full((2,), math.radians(80))
    # The circle of each lens fills the image: r(θ_max) = 32 px.
    focal = 32 * (xi + torch.cos(theta_max)) / torch.sin(theta_max)
    with torch.inference_mode():
        print(model(images, xi, focal, theta_max))
