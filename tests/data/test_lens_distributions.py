import math

import numpy as np
import pytest
import torch
from helpers import refused

from darswin.data.lens_distributions import (
    LEVELS,
    PolynomialLenses,
    SphericalLenses,
    parse_lenses,
    parse_sweep,
)


@pytest.mark.parametrize("text", [*LEVELS, "0.4", "0.1..0.9", "polynomial"])
def test_every_lens_fills_the_circle(text):
    rng = np.random.default_rng(0)
    for _ in range(50):
        lens = parse_lenses(text).draw(rng, math.radians(170), 32.0)
        assert lens.theta_max.item() == pytest.approx(math.radians(85))
        assert lens.r_max.item() == pytest.approx(32, rel=1e-5)


def test_ranges_are_used_whole():
    assert LEVELS["low"] == (0.2, 0.35) and list(LEVELS) == ["very low", "low", "medium", "high"]
    rng = np.random.default_rng(0)
    for text, low, high in (("medium", 0.5, 0.7), ("0.4", 0.4, 0.4), ("0.1..0.9", 0.1, 0.9)):
        xi = [parse_lenses(text).draw(rng, 3.0, 32).xi.item() for _ in range(500)]
        assert min(xi) == pytest.approx(low, abs=0.01) and max(xi) == pytest.approx(high, abs=0.01)
        assert low - 1e-6 <= min(xi) and max(xi) <= high + 1e-6
    middles = torch.cat([PolynomialLenses().draw(rng, 3.0, 32).project(0.75) for _ in range(100)])
    # Half way to θ_max: 1/2 of the radius for k₁ alone, 1/16 for k₄ alone.
    assert 2 < middles.min() < 6 and 10 < middles.max() < 16


def test_sweeps():
    assert parse_sweep("0:1:0.1") == [f"{k / 10:g}" for k in range(11)]
    assert parse_sweep("0:1:0.05")[-1] == "1" and len(parse_sweep("0:1:0.05")) == 21
    assert parse_sweep(["very low", "0.4", "0:1:0.5"]) == ["very low", "0.4", "0", "0.5", "1"]
    assert parse_sweep("low, high,polynomial") == ["low", "high", "polynomial"]


def test_wrong_names():
    for text in ("lowest", "0.1..", "0.5..0.1", "-0.1", "1..2..3", "nan", ""):
        refused(r"lenses must be one of|ξ must be", parse_lenses, text)
    for text in ("0:1", "1:0:0.1", "0:1:0", "lowest"):
        refused(r"sweep|lenses must be", parse_sweep, text)
    refused("ξ must be 0 ≤ low ≤ high", SphericalLenses, 0.5, 0.1)
