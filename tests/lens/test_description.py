"""A lens as a JSON object."""

import json

import pytest
import torch
from lens_examples import f64

from darswin.lens import Spherical, from_dict, to_dict


def test_as_json_and_back():
    lens = Spherical(torch.tensor(0.1, dtype=f64), 300.0, 1.3, [3.0, 4.0], image_size=(480, 640))
    described = to_dict(lens)
    assert described == {
        "model": "Spherical", "xi": 0.1, "focal": 300.0, "theta_max": 1.3, "center": [3.0, 4.0],
        "image_size": [480, 640],
    }  # fmt: skip
    assert to_dict(from_dict(json.loads(json.dumps(to_dict(lens))))) == to_dict(
        lens.to(torch.float32)
    )
    with pytest.raises(ValueError, match="one lens, got 2"):
        to_dict(lens.expand(2))
