"""The models, by name, and their files."""

from darswin.models.adapter import LensAdapter
from darswin.models.darswin import DarSwin
from darswin.models.darswin_unet import DarSwinUnet
from darswin.models.dat import DAT
from darswin.models.pretrained import list_pretrained, pretrained_file
from darswin.models.registry import create_model, list_models
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.models.swin import Swin, SwinUndis
from darswin.models.swin_unet import SwinUnet, SwinUnetAdapted, SwinUnetUndis

__all__ = [
    "DAT",
    "DarSwin",
    "DarSwinUnet",
    "LensAdapter",
    "ModelCard",
    "Swin",
    "SwinUndis",
    "SwinUnet",
    "SwinUnetAdapted",
    "SwinUnetUndis",
    "create_model",
    "list_models",
    "list_pretrained",
    "load_model",
    "pretrained_file",
    "save_model",
]
