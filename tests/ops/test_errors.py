"""Wrong arguments: the public functions explain them, and the compiled operators refuse them."""

import math

import numpy as np
import pytest
import torch
from cases import SMALL, raw_calls
from helpers import refused
from torch._subclasses import FakeTensorMode

from darswin.ops import polar_sample, polar_to_image, use_reference, window_attention

zeros, ones = torch.zeros, torch.ones
GRID = dict(
    image=ones(2, 3, 17, 23), radii=ones(2, 6), azimuths=ones(8), center=ones(2, 2),
    affine=ones(2, 2, 2), offsets=ones(2, 2, 6, 8), samples=(3, 4),
)  # fmt: skip
VALID = {
    "polar_sample": (polar_sample, GRID),
    "window_attention": (
        window_attention, dict(qkv=ones(2, 4, 8, 3, 2, 5), bias=ones(1, 2, 3, 7), window=(2, 4)),
    ),
    "polar_to_image": (
        polar_to_image,
        dict(x=ones(1, 2, 4, 3), radii=torch.tensor([[0.5, 1.5]]), center=ones(1, 2), size=(4, 5)),
    ),
}  # fmt: skip
DIVIDE = r"must divide .* \(7, 8\), got \(3, 4\)"
OFFSETS = r"\(B or 1, 2, R·S_r, A·S_φ\) = \(2 or 1, 2, 6, 8\), got \(2, 6, 8\)"
SAMPLING = [
    (dict(image="no"), TypeError, "image must be a tensor, got str"),
    (dict(image=zeros(2, 3, 17)), ValueError, r"\(B, C, H, W\), got \(2, 3, 17\)"),
    (dict(image=zeros(2, 3, 17, 23).int()), TypeError, "image must be float32"),
    (dict(radii=zeros(2, 6).double()), TypeError, "radii must be float32, got torch.float64"),
    (dict(radii=zeros(2, 6, device="meta")), ValueError, "radii must be on the same"),
    (dict(radii=zeros(3, 6)), ValueError, r"radii must have shape .*\(2 or 1, any\)"),
    (dict(radii=zeros(2, 7), offsets=None), ValueError, DIVIDE),
    (dict(radii=None), TypeError, "radii must be a tensor, got NoneType"),
    (dict(radii=1.5), TypeError, "radii must be a tensor, got float"),
    (dict(azimuths=zeros(1, 8)), ValueError, r"azimuths must have shape \(A·S_φ,\)"),
    (dict(azimuths=zeros(9), offsets=None), ValueError, "must divide"),
    (dict(center=zeros(2, 3)), ValueError, "center must have shape"),
    (dict(affine=torch.eye(2)), ValueError, r"1, 2, 2\) = \(2 or 1, 2, 2\), got \(2, 2\)"),
    (dict(affine=zeros(2, 2, 2).double()), TypeError, "affine must be float32"),
    (dict(offsets=zeros(2, 6, 8)), ValueError, OFFSETS),
    (dict(offsets=zeros(2, 2, 8, 6)), ValueError, "offsets must have shape"),
    (dict(offsets=zeros(2, 2, 6, 8).long()), TypeError, "offsets must be float32"),
    (dict(samples=(0, 4)), ValueError, "samples must be at least 1"),
    (dict(samples=(3, 0)), ValueError, "samples must be at least 1"),
    (dict(samples=3), TypeError, "samples must be a pair of ints, got 3"),
    (dict(samples=(3, 4, 1)), TypeError, "samples must be a pair of ints"),
    *((dict(samples=(bad, 4)), TypeError, "samples must be a pair of ints")
      for bad in (3.0, np.float64(3), True, torch.tensor(3), "3", None)),
    (dict(jitter=1.5), ValueError, r"jitter must be in \[0, 1\], got 1.5"),
    (dict(jitter=-0.1), ValueError, r"jitter must be in \[0, 1\]"),
    (dict(jitter=math.nan), ValueError, r"jitter must be in \[0, 1\]"),
    (dict(jitter="much"), TypeError, "jitter must be a float"),
    (dict(jitter=torch.tensor(0.0)), TypeError, "jitter must be a float, got .*Tensor"),
    *((dict(jitter=0.5, seed=bad), TypeError, "seed must be an int")
      for bad in (1.5, np.float64(2), True, "2", None)),
    (dict(jitter=0.5, seed=2**63), ValueError, "seed must fit 64 bits"),
    (dict(jitter=0.5, seed=-(2**63) - 1), ValueError, "seed must fit 64 bits"),
    (dict(jitter=0.5, seed=zeros(1).long()), ValueError, "0-dim int64 tensor"),
    (dict(jitter=0.5, seed=torch.tensor(1.0)), ValueError, "0-dim int64 tensor"),
    (dict(image=zeros(2, 1, 17, 3).byte()), ValueError, r"1, 3 or 4 channels .* both"),
    (dict(image=zeros(2, 3, 17, 3).byte()), ValueError, r"both .* \(2, 3, 17, 3\): pass"),
    (dict(image=zeros(2, 4, 4, 4).byte()), ValueError, "pass channels_last=True for"),
    (dict(image=zeros(2, 12, 17, 23).byte()), ValueError, r"neither .* \(2, 12, 17, 23"),
    (dict(channels_last=1), TypeError, "channels_last must be True, False or None, got 1"),
    (dict(image=zeros(2, 3, 17, 23).byte(), mean=(0.1, 0.2)), ValueError,
     r"mean must be one number or one per channel \(3\), got \(0.1, 0.2\)"),
    (dict(image=zeros(2, 3, 17, 23).byte(), std=0.0), ValueError, "std must be positive, got 0.0"),
]  # fmt: skip
WRONG = {
    "polar_sample": [*SAMPLING, (dict(layout="planes"), ValueError, "layout must be one of")],
    "window_attention": [
        (dict(qkv=None), TypeError, "qkv must be a tensor, got NoneType"),
        (dict(qkv=zeros(2, 4, 8, 30)), ValueError, r"3, heads, d\), got \(2, 4, 8, 30\)"),
        (dict(qkv=zeros(2, 4, 8, 3, 2, 0)), ValueError, "head dim"),
        (dict(qkv=zeros(2, 4, 8, 3, 2, 0), scale=1.0), ValueError, "head dim"),
        (dict(qkv=zeros(2, 0, 8, 3, 2, 5)), ValueError, "rings"),
        (dict(qkv=zeros(2, 4, 0, 3, 2, 5)), ValueError, "sectors"),
        (dict(qkv=zeros(2, 4, 8, 3, 2, 5).long()), TypeError, "float32, float64 or bfloat16"),
        (dict(bias=zeros(1, 2, 3, 7).double()), TypeError, "bias must be float32, got"),
        (dict(bias=zeros(1, 2, 3, 7).bfloat16()), TypeError, "bias must be float32, got"),
        (dict(bias=zeros(1, 2, 3, 7, device="meta")), ValueError, "bias must be on the same"),
        (dict(bias=zeros(3, 2, 3, 7)), ValueError, "bias must have shape"),
        (dict(window=(True, 4)), TypeError, "window must be a pair of ints"),
        (dict(bias=zeros(1, 2, 2, 7)), ValueError, "bias must have shape"),
        (dict(window=(3, 4)), ValueError, r"divide \(R, A\) = \(4, 8\), got \(3, 4\)"),
        (dict(window=(2, 3)), ValueError, "window must divide"),
        (dict(window=(0, 4)), ValueError, "window must be at least 1"),
        (dict(shift=(4, 0)), ValueError, r"shift must lie inside \(R, A\) = \(4, 8\)"),
        (dict(shift=(0, 8)), ValueError, "shift must lie inside"),
        (dict(shift=(0, -1)), ValueError, "shift must be at least 0"),
        (dict(periodic=True), TypeError, "periodic must be a pair of bools"),
        (dict(periodic=(True,)), TypeError, "periodic must be a pair of bools"),
    ],
    "polar_to_image": [
        (dict(x=None), TypeError, "x must be a tensor"),
        (dict(x=ones(2, 4, 3)), ValueError, r"x must have shape \(B, R, A, D\)"),
        (dict(x=ones(1, 0, 4, 3), radii=ones(1, 0)), ValueError, "x must have rings"),
        (dict(x=ones(1, 2, 0, 3)), ValueError, "x must have rings and sectors"),
        (dict(radii=ones(1, 1)), ValueError, r"\(B or 1, R\) = \(1 or 1, 2\), got \(1, 1\)"),
        (dict(radii=ones(1, 2).double()), TypeError, "radii must be float32"),
        (dict(radii=None, r_max=2.0), TypeError, "radii must be a tensor"),
        (dict(radii=torch.tensor([[1.5, 0.5]])), ValueError, "finite, at least 0, and rise"),
        (dict(radii=torch.tensor([[1.5, 1.5]])), ValueError, "and rise"),
        (dict(radii=torch.tensor([[-0.5, 0.5]])), ValueError, "at least 0"),
        (dict(radii=torch.tensor([[0.5, math.nan]])), ValueError, "finite"),
        (dict(radii=torch.tensor([[0.5, math.inf]])), ValueError, "finite"),
        (dict(center=None), ValueError, "needs either center"),
        (dict(points=ones(1, 4, 5, 2)), ValueError, "either center"),
        (dict(center=None, affine=ones(1, 2, 2), points=ones(1, 4, 5, 2)), ValueError, "or points"),
        (dict(center=None, points=ones(1, 4, 4, 2)), ValueError, r"\(1 or 1, 4, 5, 2\)"),
        (dict(affine=ones(1, 2, 3)), ValueError, "affine must have shape"),
        (dict(size=(4, -1)), ValueError, "size must be at least 0"),
        (dict(size=(True, 4)), TypeError, "size must be a pair of ints"),
        (dict(center=ones(1, 2, device="meta")), ValueError, "center must be on the same device"),
        (dict(r_max=ones(3)), ValueError, r"r_max must have shape \(B or 1,\)"),
        (dict(plan=ones(1, 4, 5, 3)), ValueError, r"plan must have shape .* 4, 3, 5\)"),
        (dict(plan=ones(1, 4, 3, 5).double()), TypeError, "plan must be float32"),
        (dict(layout="map"), ValueError, "layout must be one of"),
    ],
}


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("name", WRONG)
def test_errors_name_what_was_expected(name, reference):
    operator, valid = VALID[name]
    with use_reference(reference):
        operator(**valid)
        for change, error, message in WRONG[name]:
            with pytest.raises(error, match=message) as raised:
                operator(**(valid | change))
            # The operator's own error is not shown.
            assert raised.value.__suppress_context__ or not raised.value.__context__


@pytest.mark.parametrize("name", WRONG)
def test_fake_tensors_are_checked_too(name):
    """Their operators compute nothing, so they would not notice wrong arguments."""
    operator, valid = VALID[name]
    # Fake tensors have no values, and torch makes a tensor of a number.
    others = ("finite, at least 0, and rise", "and rise", "at least 0", "finite",
              "radii must be a tensor, got float")  # fmt: skip
    for change, error, message in WRONG[name]:
        if message in others:
            continue
        with FakeTensorMode(allow_non_fake_inputs=True) as mode:
            fake = {
                k: mode.from_tensor(v) if isinstance(v, torch.Tensor) else v
                for k, v in (valid | change).items()
            }
            refused(message, operator, error=error, **fake)


def test_a_radius_of_zero_is_allowed():
    operator, valid = VALID["polar_to_image"]
    operator(**(valid | dict(radii=torch.tensor([[0.0, 1.0]]))))


# -- past the public functions ---------------------------------------------------------------------

RAW = {
    "polar_sample": {
        "image": [zeros(3), zeros(1, 3, 7, 8), zeros(2, 3, 7, 8).double()],
        "radii": [zeros(3, 4), zeros(2, 4).double()],
        "center": [zeros(1, 1), zeros(3, 2)],
        "affine": [zeros(2, 2), zeros(3, 2, 2), zeros(2, 2, 2).double(), torch.tensor(1.0)],
        "offsets": [zeros(2, 1, 4, 6), zeros(2, 2, 3, 6), zeros(2, 2, 4, 5), zeros(3, 2, 4, 6),
                    zeros(2, 2, 4, 6).double()],
        "samples": [(0, 3), (2, 4), (3, 3), (2,)],
        "jitter": [torch.tensor(0.5), *(torch.tensor(bad, dtype=torch.float64)
                                        for bad in (1e300, -0.1, 1.5, math.nan, math.inf))],
        "seed": [None, torch.tensor(1.0)],
    },
    "window_attention": {
        "qkv": [zeros(3)], "bias": [zeros(1, 2, 3, 3), zeros(3, 2, 3, 7)],
        "window": [(3, 4), (2,)], "shift": [(0, 4), (-1, 0)], "periodic": [(True,)],
    },
    "polar_to_image": {
        "x": [zeros(3)],
        "radii": [zeros(2, 2), zeros(3, 3), -torch.arange(3.0)[None], torch.full((1, 3), math.nan)],
        "center": [None, zeros(2, 3)],
        "affine": [zeros(2, 2)], "r_max": [zeros(3)], "size": [(5,), (-1, 4)],
        "plan": [zeros(2, 5, 4, 3), zeros(3, 5, 3, 4), zeros(2, 5, 3, 4).double()],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", RAW)
def test_the_compiled_operator_refuses_sizes_that_do_not_fit(name):
    operator, arguments = raw_calls(SMALL[name]())[0]
    names = [argument.name for argument in operator._schema.arguments]
    for changed, values in RAW[name].items():
        for value in values:
            call = dict(zip(names, arguments, strict=True)) | {changed: value}
            with torch.no_grad(), pytest.raises(RuntimeError):
                operator(*call.values())


def test_float64_samples_are_not_rounded_by_the_operator_itself():
    operator, arguments = raw_calls(SMALL["polar_sample"](dtype=torch.float64))[0]
    arguments[11] = True
    refused("float64 image are not rounded", operator, *arguments, error=RuntimeError)
