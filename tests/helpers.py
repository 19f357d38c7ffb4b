"""Helpers for several test files."""

import contextlib
import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from allpairspy import AllPairs
from PIL import ExifTags, Image
from safetensors.torch import load_file

from darswin import create_model
from darswin.compat import OfficialDarSwin, OfficialPolynomial
from darswin.lens import Mei, Polynomial, Spherical
from darswin.models.registry import has_image_size

slow, products = pytest.mark.slow, pytest.mark.products
CALIBRATIONS = Path(__file__).parent / "lens" / "files"


def changed(name: str, old: str, new: str) -> str:
    """The text of an example calibration, with `old`, which it must have, replaced by `new`."""
    text = CALIBRATIONS.joinpath(name).read_text()
    assert old in text
    return text.replace(old, new)


def product(*tables):
    """The rows of a product of tables, for `parametrize`: a few have each value of each table once,
    those that give each pair of values of two tables are slow, and the others are left to `make
    test-products`."""
    tables = [list(table) for table in tables]
    places = [range(len(table)) for table in tables]
    fast = {tuple(k % len(table) for table in tables) for k in range(max(map(len, tables)))}
    # The fast rows have their pairs already.
    pairs = {*map(tuple, AllPairs(places, previously_tested=sorted(map(list, fast))))}
    marks = dict.fromkeys(pairs, slow) | dict.fromkeys(fast, ())
    return [
        pytest.param(*map(list.__getitem__, tables, row), marks=marks.get(row, [slow, products]))
        for row in itertools.product(*places)
    ]


def in_turn(rows, last):
    """Rows, each with one value of a last table in turn, for `parametrize`; those with its other
    values are left to `make test-products`."""
    last = list(last)
    return [
        pytest.param(*row, value, marks=[] if k % len(last) == place else [slow, products])
        for k, row in enumerate(rows)
        for place, value in enumerate(last)
    ]


def slow_but(rows, *fast, marks=slow):
    """The rows, for `parametrize`: all are slow, or have other `marks`, but those in `fast`."""
    return [
        pytest.param(
            *(row if isinstance(row, tuple) else [row]), marks=[] if row in fast else marks
        )
        for row in rows
    ]


FIXTURES = Path(__file__).parent / "fixtures"


def stored(name):
    """All tensors of a fixture, and the state dict among them."""
    tensors = load_file(FIXTURES / f"{name}.safetensors")
    return tensors, {
        k.removeprefix("state."): v for k, v in tensors.items() if k.startswith("state.")
    }


def fixture(name):
    """A fixture of the released DarSwin: all tensors, the state dict, and the lenses."""
    tensors, state = stored(f"official_{name}")
    dist = tensors["dist"]
    if name == "poly":
        return tensors, state, OfficialPolynomial(dist, 32.0)
    xi, focal, fov = dist.unbind(1)
    return tensors, state, Spherical(xi, focal, fov / 2)


# Typical real cameras: beyond 90°, off centre, rectangular, not round.
CAMERAS = [
    Polynomial(
        [350.4, -17.5, 27.5, -2.4], 1.658, [641.3, 486.1], affine=[[1.0, 0.0], [0.0, 1.0004]],
        image_size=(966, 1280),
    ),
    Mei(
        2.35, 1390.0, [0.032, 2.4], 1.726, [708.5, 697.0], tangential=[6e-4, -3.5e-4],
        affine=[[1.0, 0.0], [0.0, 1389.2 / 1390.0]], image_size=(1400, 1400),
    ),
]  # fmt: skip


@contextlib.contextmanager
def few_calls(most):
    """Fails as soon as the block calls more functions than this, also those written in C: a limit
    of work that is the same on every machine."""
    calls = 0

    def count(_frame, event, _function):
        nonlocal calls
        calls += event in ("call", "c_call")
        assert calls <= most

    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(None)
    assert calls <= most


def side_of(name):
    """The side of the test images for a model, also its `image_size` if it has one."""
    return 64 if "unet" in name else 32


def create(name, **options):
    """`create_model`, also of "NAME VIEW"."""
    name, _, view = name.partition(" ")
    return create_model(name, **(dict(view=view) if view else {}) | options)


def network(name, **options):
    """A nano model in eval mode with random parameters; "official" is an OfficialDarSwin."""
    options = dict(num_classes=5) | options
    if name == "official":
        sizes = dict(embed_dim=24, depths=(1, 2, 1), num_heads=(1, 2, 4), samples=(4, 4))
        model = OfficialDarSwin(**(sizes | options)).eval()
    else:
        if has_image_size(name.split()[0]):
            options = dict(image_size=side_of(name)) | options
        model = create(name, **options).eval()
    for key, parameter in model.named_parameters():
        mean = 1.0 if parameter.dim() == 1 and key.endswith("weight") else 0.0
        torch.nn.init.normal_(parameter, mean=mean, std=0.1)
    return model


def relative_error(got, expected):
    """The norm of the difference, divided by the norm of the expected values."""
    return ((got.float() - expected).norm() / expected.norm()).item()


def in_this_process(work, jobs, *_):
    """In place of `run_all` of the studies, which runs jobs in processes of their own."""
    return [work(*job) for job in jobs]


def exif_of(orientation):
    """EXIF data by which a picture is turned upright."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    return exif


def save_picture(path, pixels, **options):
    """Writes a grey or RGB picture, and makes its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels.squeeze()).save(path, **options)


def output(*command, **options) -> str:
    """What a command prints; it must succeed."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {"PATH": path} | options.pop("env", {})
    done = subprocess.run(command, capture_output=True, text=True, env=environment, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ended(capsys, code, function, *arguments, **options):
    """What a command prints, as `out` and `err`, that ends with this exit code."""
    with pytest.raises(SystemExit) as end:
        function(*arguments, **options)
    assert end.value.code == code
    return capsys.readouterr()


def refused(said, function, *arguments, error=ValueError, **options):
    """The message of the error with which a call ends; it must have these words."""
    with pytest.raises(error, match=said) as caught:
        function(*arguments, **options)
    return str(caught.value)
