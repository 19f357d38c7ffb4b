"""The models, by name."""

from darswin.models.darswin import DarSwin
from darswin.models.dat import DAT
from darswin.models.registry import create_model, list_models
from darswin.models.swin import Swin, SwinUndis

__all__ = ["DAT", "DarSwin", "Swin", "SwinUndis", "create_model", "list_models"]
