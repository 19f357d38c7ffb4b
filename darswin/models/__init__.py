"""The models: creating them by name, saving them, and loading them."""

from darswin.models.adapter import LensAdapter
from darswin.models.base import Model
from darswin.models.conv_unet import ConvUnet
from darswin.models.create import create_model
from darswin.models.darswin import DarSwin
from darswin.models.dat import DAT
from darswin.models.encoder import Encoder, FeatureMaps
from darswin.models.features import FeatureInfo
from darswin.models.registry import list_models
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.models.swin import Swin
from darswin.models.unet import Unet

__all__ = [
    "DAT",
    "ConvUnet",
    "DarSwin",
    "Encoder",
    "FeatureInfo",
    "FeatureMaps",
    "LensAdapter",
    "Model",
    "ModelCard",
    "Swin",
    "Unet",
    "create_model",
    "list_models",
    "load_model",
    "save_model",
]
