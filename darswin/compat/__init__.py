"""Weights of other implementations: reads their state dicts into our models."""

from darswin.compat.checkpoint import convert_checkpoint, read_state
from darswin.compat.dat import load_dat
from darswin.compat.official import load_official
from darswin.compat.timm_swin import load_timm_swin
from darswin.models.official import OfficialPolynomial

__all__ = [
    "OfficialPolynomial",
    "convert_checkpoint",
    "load_dat",
    "load_official",
    "load_timm_swin",
    "read_state",
]
