"""Other implementations of the models: their weights and their differences from ours."""

from darswin.compat.baselines import load_dat, load_timm_swin
from darswin.compat.official import OfficialDarSwin, OfficialPolynomial, load_official

__all__ = [
    "OfficialDarSwin",
    "OfficialPolynomial",
    "load_dat",
    "load_official",
    "load_timm_swin",
]
