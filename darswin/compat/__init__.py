"""Other implementations of the models: their weights, and what they do otherwise."""

from darswin.compat.checkpoint import convert_checkpoint, read_state
from darswin.compat.dat import load_dat
from darswin.compat.official import OfficialDarSwin, OfficialPolynomial, load_official
from darswin.compat.timm_swin import load_timm_swin

__all__ = [
    "OfficialDarSwin",
    "OfficialPolynomial",
    "convert_checkpoint",
    "load_dat",
    "load_official",
    "load_timm_swin",
    "read_state",
]

FORMS = {"official": OfficialDarSwin}  # of `create_model(name, compat=…)`
