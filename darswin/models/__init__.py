"""The models, by name, and their files."""

from darswin.models.darswin import DarSwin
from darswin.models.dat import DAT
from darswin.models.pretrained import list_pretrained, pretrained_file
from darswin.models.registry import create_model, list_models
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.models.swin import Swin, SwinUndis

__all__ = [
    "DAT",
    "DarSwin",
    "ModelCard",
    "Swin",
    "SwinUndis",
    "create_model",
    "list_models",
    "list_pretrained",
    "load_model",
    "pretrained_file",
    "save_model",
]
