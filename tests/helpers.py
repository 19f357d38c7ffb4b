"""What several test files share."""

from pathlib import Path

from safetensors.torch import load_file

from darswin.compat import OfficialPolynomial
from darswin.lens import Spherical

CALIBRATIONS = Path(__file__).parent / "lens" / "files"


def changed(name: str, old: str, new: str) -> str:
    """The text of an example calibration with something replaced, which must be there."""
    text = CALIBRATIONS.joinpath(name).read_text()
    assert old in text
    return text.replace(old, new)


FIXTURES = Path(__file__).parent / "fixtures"


def fixture(name):
    """A fixture of the released DarSwin: all its tensors, the state dict, and the lenses."""
    tensors = load_file(FIXTURES / f"official_{name}.safetensors")
    state = {k.removeprefix("state."): v for k, v in tensors.items() if k.startswith("state.")}
    dist = tensors["dist"]
    if name == "poly":
        return tensors, state, OfficialPolynomial(dist, 32.0)
    xi, focal, fov = dist.unbind(1)
    return tensors, state, Spherical(xi, focal, fov / 2)
