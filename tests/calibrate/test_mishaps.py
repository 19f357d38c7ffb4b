"""Nothing is silent: a lens that is wrong is refused or doubted, and a right one is not."""

import re

import pytest
from helpers import slow_but
from mishaps import outcome
from rigs import ray_errors, rig, true_lens

from darswin.calibrate import calibrate
from darswin.calibrate.doubts import Note

SAID = {
    "two cameras, alike": (60, 3, "the rays are unsure by .* pictures disagree"),
    "zoom changed by 1 %": (100, 1, r"the scale changes by \+1.4 % from the first picture"),
    "half resized by 2 %": (60, 3, "the rays are unsure by .* zoom, focus and camera the same"),
    "stabiliser, 5 px": (190, 2, "the rays are unsure by"),
    "three bursts, by hand": (190, 2, "18 pictures show the board at 3 places"),
    "tilt below 3°": (190, 2, "nearly parallel to the sensor: tilt them by 20 to 45°"),
    "paper in a hand, 2 mm": (60, 3, "is the board flat and as you say"),
    "columns and rows swapped": (100, 1, "the order of its corners right"),
    "one picture mirrored": (100, 1, "the board is mirrored, or seen from behind, in 1: picture 4"),
    "a wrong model": (100, 1, "the rays are unsure by"),
}
FAST = "zoom changed by 1 %", "half resized by 2 %"  # test_degenerate.py has a turned board


@pytest.mark.parametrize("name", slow_but([*SAID], *FAST))
def test_mishaps_are_told(name):
    fov, seed, words = SAID[name]
    _, kind, why = outcome(name, fov, seed)
    assert kind in ("error", "looks wrong")
    assert re.search(words, why), why


GOOD = [("Perspective", 60), ("KannalaBrandt", 100), ("Equidistant", 150), ("EnhancedUnified", 220)]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "fov"), GOOD)
def test_good_pictures_are_not_doubted(model, fov):
    true = rig(true_lens(model, fov, seed=1), 15, noise=0.1, seed=1)
    found = calibrate(true.corners, true.board, true.size, model)
    assert not [text for text in found.doubts if not isinstance(text, Note)]
    off = ray_errors(found.lens, true.lens, best=True)
    assert off.quantile(0.95) < 0.2
