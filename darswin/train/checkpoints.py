"""Checkpoints that no kill and no full disk spoils, their weights as safetensors beside them."""

import io
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from darswin.compat.checkpoint import read_pickle
from darswin.files import replace_file
from darswin.models.saving import ModelCard, save_model


class SafeCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint in the place of the old one in one go; reads no pickled code."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str, storage_options: Any = None
    ) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        replace_file(path, content.getvalue())
        weights = {
            name.removeprefix("net."): tensor
            for name, tensor in checkpoint["state_dict"].items()
            if name.startswith("net.")
        }
        save_model(_weights(path), weights, ModelCard(**checkpoint["darswin"]))

    def remove_checkpoint(self, path: str) -> None:
        super().remove_checkpoint(path)
        _weights(path).unlink(missing_ok=True)

    def load_checkpoint(
        self, path: str, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> dict[str, Any]:
        if not Path(path).is_file():
            raise FileNotFoundError(f"no checkpoint {path}")
        checkpoint = read_pickle(path, map_location)
        if not isinstance(checkpoint, dict) or "darswin" not in checkpoint:
            raise ValueError(f"{path} is no checkpoint of `darswin fit`: it names no model")
        return checkpoint


def _weights(path: str) -> Path:
    return Path(path).with_suffix(".safetensors")
