"""The models, by name."""

from darswin.models.darswin import DarSwin
from darswin.models.registry import create_model, list_models

__all__ = ["DarSwin", "create_model", "list_models"]
