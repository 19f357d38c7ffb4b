import math

import numpy as np
import pytest
import torch

from darswin.data.lens_distributions import (
    LEVELS,
    PolynomialLenses,
    SphericalLenses,
    parse_lenses,
    parse_sweep,
)


def test_levels_of_the_paper():
    assert LEVELS["low"] == (0.2, 0.35) and list(LEVELS) == ["very low", "low", "medium", "high"]


@pytest.mark.parametrize("text", [*LEVELS, "0.4", "0.1..0.9", "polynomial"])
def test_every_lens_fills_the_circle(text):
    rng = np.random.default_rng(0)
    lenses = [parse_lenses(text).draw(rng, math.radians(170), 32.0) for _ in range(50)]
    for lens in lenses:
        assert lens.theta_max.item() == pytest.approx(math.radians(85))
        assert lens.r_max.item() == pytest.approx(32, rel=1e-5)


def test_the_range_is_used_whole():
    rng = np.random.default_rng(0)
    xi = [parse_lenses("medium").draw(rng, 3.0, 32).xi.item() for _ in range(500)]
    assert 0.5 <= min(xi) < 0.51 and 0.69 < max(xi) <= 0.7
    assert parse_lenses("0.4").draw(rng, 3.0, 32).xi.item() == pytest.approx(0.4)


def test_polynomials_differ_and_rise():
    rng = np.random.default_rng(0)
    middles = torch.cat([PolynomialLenses().draw(rng, 3.0, 32).project(0.75) for _ in range(100)])
    # Half way to θ_max: 1/2 of the radius for k₁ alone, 1/16 for k₄ alone.
    assert 2 < middles.min() < 6 and 10 < middles.max() < 16


@pytest.mark.parametrize("text", ["lowest", "0.1..", "0.5..0.1", "-0.1", "1..2..3", "nan", ""])
def test_what_is_no_distribution(text):
    with pytest.raises(ValueError, match=r"lenses must be one of|ξ must be"):
        parse_lenses(text)


def test_sweeps():
    assert parse_sweep("0:1:0.1") == [f"{k / 10:g}" for k in range(11)]
    assert parse_sweep("0:1:0.05")[-1] == "1" and len(parse_sweep("0:1:0.05")) == 21
    assert parse_sweep(["very low", "0.4", "0:1:0.5"]) == ["very low", "0.4", "0", "0.5", "1"]
    assert parse_sweep("low, high,polynomial") == ["low", "high", "polynomial"]
    for text in ("0:1", "1:0:0.1", "0:1:0", "lowest"):
        with pytest.raises(ValueError, match=r"sweep|lenses must be"):
            parse_sweep(text)


def test_distributions_are_checked():
    with pytest.raises(ValueError, match="ξ must be 0 ≤ low ≤ high"):
        SphericalLenses(0.5, 0.1)
