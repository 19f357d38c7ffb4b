"""The authors' released DarSwin."""

import os
import warnings
from collections.abc import Mapping

from torch import Tensor

from darswin.compat.checkpoint import count_blocks, read_state, refused
from darswin.models.darswin import DarSwin


def load_official(source: str | os.PathLike | Mapping[str, Tensor], **options) -> DarSwin:
    """The authors' released DarSwin from its state dict, in eval mode with `compat="official"`.

    Angular and "polar" models give the released code's outputs; the latter's bias is the paper's
    angular PE (Fourier in θ and φ), so it is called "angular" here. The released radial model
    (DarSwin-RA) does not run; its weights load into our DarSwin-RA, with a warning.

    Call it as any model, `model(images, lens)`, with `lens.Spherical(xi, focal, theta_max)` in
    pixels of its input, or with `OfficialPolynomial(coefficients, radius)`.

    Args:
        source: a state dict or a file of one, as `darswin.compat.read_state`.
        options: constructor arguments that no shape tells: `rings`, `sectors`, `samples` and
            `in_chans` where they are not 16, 64, (10, 10) and 3.

    Raises:
        ValueError: keys or shapes that are not those of a released model.
    """
    state = read_state(source)
    with refused("a released DarSwin"):
        settings = _settings(state)
    model = DarSwin(**(settings | options))
    sample = model.patch_embed.sample
    converted = {}
    for key, value in state.items():
        if key.endswith("attn_mask"):
            continue  # the operator needs no masks
        if key == "patch_embed.mlp.weight":
            # Columns (C, S_r, S_φ) → (S_r, S_φ, C).
            value = value.unflatten(1, (model.in_chans, *sample.samples))
            value = value.permute(0, 2, 3, 1).flatten(1)
        converted[_renamed(key)] = value
    with refused("a released DarSwin"):
        model.load_state_dict(converted)
    return model.eval()


def _settings(state: Mapping[str, Tensor]) -> dict:
    """Constructor arguments, from keys and shapes."""
    depths = count_blocks(state, "layers.{}.blocks.{}.norm1.weight")
    heads = [state[f"layers.{stage}.blocks.0.attn.a_p"].shape[1] for stage in range(len(depths))]
    settings = dict(
        num_classes=state["head.weight"].shape[0],
        embed_dim=state["patch_embed.norm.weight"].shape[0],
        depths=depths,
        num_heads=heads,
    )
    cosines, sines = (state[f"layers.0.blocks.0.attn.{name}_r"].shape[0] for name in "ab")
    if cosines == sines:
        return settings | dict(position_bias="angular_relative", compat="official")
    settings["harmonics"] = sines
    last_stage_masked = f"layers.{len(depths) - 1}.blocks.1.attn_mask" in state
    if depths[-1] > 1 and not last_stage_masked:
        warnings.warn(
            "the released radial model does not run, so there are no outputs to match: its weights "
            "are loaded into DarSwin-RA with the polar position bias",
            stacklevel=3,
        )
        grid = dict(spacing="tan", placement="edges", jitter=0.0)
        return settings | grid | dict(variant="RA", position_bias="polar")
    return settings | dict(position_bias="angular", compat="official")


def _renamed(key: str) -> str:
    key = key.replace("patch_embed.mlp.", "patch_embed.proj.")
    if key.startswith("layers."):
        _, index, rest = key.split(".", 2)
        # Merging ends a stage there and begins one here.
        stage = int(index) + rest.startswith("downsample.")
        key = f"stages.{stage}.{rest}"
    # There a goes with the cosine and b with the sine; r is the radius and p the azimuth.
    for theirs, ours in (
        ("a_r", "b_theta"),
        ("b_r", "a_theta"),
        ("a_p", "b_phi"),
        ("b_p", "a_phi"),
    ):
        if key.endswith(f".attn.{theirs}"):
            return key.removesuffix(theirs) + f"position_bias.{ours}"
    return key
