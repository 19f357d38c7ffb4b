"""Lenses in float32 against the same lenses in float64."""

import json

import pytest
import torch
from lens_examples import ASIDE, CALIBRATIONS, double, example, f64
from torch.utils import _pytree as pytree

from darswin.lens import (
    MODELS,
    BrownConrady,
    Fisheye624,
    KannalaBrandt,
    Mei,
    cat,
    from_dict,
    load,
    save,
    to_dict,
)

EPS = torch.finfo(torch.float32).eps
SIZE = (480, 640)
ROWS, COLUMNS = (torch.arange(0, side, 24, dtype=f64) for side in SIZE)
PIXELS = torch.stack(torch.meshgrid(COLUMNS, ROWS, indexing="xy"), -1).flatten(0, 1)

# A lens of the 90° of a pinhole: the powers of w overflow in float32 there.
PINHOLE = BrownConrady(
    double(500.0), double(-0.22, 0.13, 0.028), tangential=double(1e-3, 1e-3),
    center=double(320, 240), image_size=double(*SIZE),
)  # fmt: skip
RANDOM = ("BrownConrady", "rational", "Mei", "KannalaBrandt", "Fisheye624")


def random_lenses(name: str, count: int):
    """Lenses with tangential and thin-prism terms as calibrations have them, in images of `SIZE`;
    each is used as far as it goes."""
    generator = torch.Generator().manual_seed(RANDOM.index(name))

    def uniform(low: float, high: float, *shape: int):
        return low + (high - low) * torch.rand(count, *shape, generator=generator, dtype=f64)

    terms = dict(tangential=uniform(-2e-3, 2e-3, 2), prism=uniform(-1e-3, 1e-3, 4))
    focal, scale = uniform(250, 600), double(0.3, 0.15, 0.03)
    if name == "Mei":
        return Mei(uniform(0, 2), 2 * focal, uniform(-1, 1, 3) * scale, **terms)
    if name == "rational":
        terms["denominator"] = uniform(-0.1, 0.1, 3)
    if name in ("BrownConrady", "rational"):
        return BrownConrady(focal, uniform(-1, 1, 3) * scale, **terms)
    radial = uniform(-1, 1, 4) * double(0.05, 0.02, 0.01, 0.005)
    return {"KannalaBrandt": KannalaBrandt, "Fisheye624": Fisheye624}[name](focal, radial, **terms)


def in_image(lens):
    """The lenses with their principal point near the middle of images of `SIZE`."""
    center, size = (double(*pair).expand(len(lens), 2) for pair in ((322, 237), SIZE))
    return lens.replace(center=center, image_size=size)


def check(exact, lens):
    """One lens in float64, and the same in float32."""
    assert lens.theta_max.dtype == torch.float32 and lens.r_max.isfinite()
    limit, eps = min(exact.theta_max.item(), lens.theta_max.item()), 64 * EPS
    theta, _ = exact.unproject_pixels(PIXELS)
    found, azimuth = lens.unproject_pixels(PIXELS.float())
    # The rim may move by rounding, which near a fold becomes its root.
    inner = theta < (1 - 2 * EPS**0.5) * limit
    assert inner.any() and not found[inner].isnan().any()
    seen = ~theta.isnan() & ~found.isnan()
    assert (theta.isnan() & ~found.isnan()).sum() <= 0.01 * len(PIXELS)
    # A ray is known to its last bits, and so is the pixel.
    again = exact.project_rays(found.double(), azimuth.double())
    slope = exact._slope(theta.nan_to_num().clamp(max=limit)).abs()
    off = (again - PIXELS).abs().amax(-1)
    assert (off <= eps * (640 + exact.r_max.clamp(max=640) + slope))[seen].all()
    theta, azimuth = torch.linspace(0, 0.98 * limit, 50, dtype=f64), torch.linspace(-3, 3, 50)
    expected = exact.project_rays(theta, azimuth.double())
    pixels = lens.project_rays(theta.float(), azimuth)
    off = (pixels - expected).abs().amax(-1)
    assert (off <= eps * (640 + expected.abs().amax(-1) + exact._slope(theta).abs())).all()


@pytest.mark.parametrize("name", RANDOM)
def test_random_lenses_with_tangential_and_prism_terms(name):
    exact = in_image(random_lenses(name, 40))
    lens = exact.to(torch.float32)
    for k in range(len(exact)):
        check(exact[k], lens[k])


@pytest.mark.parametrize("name", MODELS)
def test_every_model(name):
    for seed in range(3):
        exact = in_image(example(name, torch.Generator().manual_seed(seed), focal=(100, 600)))
        for k in range(len(exact)):
            check(exact[k], exact[k].to(torch.float32))


@pytest.mark.parametrize("name", [*ASIDE, *CALIBRATIONS])
def test_calibrations(name):
    lens = ASIDE[name] if name in ASIDE else CALIBRATIONS[name][0]
    exact = in_image(lens)
    check(exact, exact.to(torch.float32))


def loaded(lens, path):
    save(lens, path)
    return load(path)


@pytest.mark.parametrize(
    "convert",
    [
        lambda lens, _: lens.to(torch.float32),
        lambda lens, _: lens.to("cpu", torch.float32),
        lambda lens, _: cat([lens, lens]).to(dtype=torch.float32)[1],
        lambda lens, _: from_dict(json.loads(json.dumps(to_dict(lens)))),
        lambda lens, path: loaded(lens, path / "lens.json"),
        lambda lens, path: loaded(lens, path / "lens.yaml").with_theta_max(None),
    ],
    ids=["to", "device", "cat", "from_dict", "load", "OpenCV"],
)
def test_conversions(convert, tmp_path):
    check(PINHOLE, convert(PINHOLE, tmp_path))


@pytest.mark.parametrize("how", ["pytree", "replace", "cat"])
def test_unchecked_conversions_find_the_same_rays(how):
    """Their θ_max may be beyond what float32 can represent."""
    if how == "pytree":
        lens = pytree.tree_map(lambda tensor: None if tensor is None else tensor.float(), PINHOLE)
    elif how == "replace":
        given = {name: getattr(PINHOLE, name) for name in PINHOLE._names()}
        lens = PINHOLE.replace(**{n: t.float() for n, t in given.items() if t is not None})
    else:
        lens = cat([PINHOLE.to(torch.float32), PINHOLE])[0]
    theta, _ = PINHOLE.unproject_pixels(PIXELS)
    found, _ = lens.unproject_pixels(PIXELS.to(lens.theta_max.dtype))
    assert not theta.isnan().any()
    torch.testing.assert_close(found.double(), theta, rtol=0, atol=64 * EPS)


def test_theta_max_beyond_the_model_is_refused_in_float32_too():
    described = to_dict(PINHOLE)
    with pytest.raises(ValueError, match=r"theta_max must be at most 1\.57079"):
        from_dict(described | {"theta_max": 1.58})
    assert from_dict(described | {"theta_max": 1.5}).theta_max.item() == pytest.approx(1.5)


def test_float64_stays_as_it_is():
    assert PINHOLE.to(torch.float64).same_as(PINHOLE)
    assert PINHOLE.to("cpu").same_as(PINHOLE)
