"""The models, by name, and their files."""

from darswin.models.darswin import DarSwin
from darswin.models.dat import DAT
from darswin.models.registry import create_model, list_models, list_pretrained, pretrained_file
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.models.swin import Swin
from darswin.models.unet import Unet
from darswin.models.views import LensAdapter

__all__ = [
    "DAT",
    "DarSwin",
    "LensAdapter",
    "ModelCard",
    "Swin",
    "Unet",
    "create_model",
    "list_models",
    "list_pretrained",
    "load_model",
    "pretrained_file",
    "save_model",
]
