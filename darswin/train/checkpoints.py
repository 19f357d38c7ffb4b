"""Checkpoints that survive kills and full disks, with their weights as safetensors beside them."""

import io
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from darswin.models.saving import ModelCard, save_model
from darswin.utils.files import replace_file
from darswin.utils.unpickle import read_pickle


class RunCheckpoint(ModelCheckpoint):
    """A checkpoint in a run's folder, wherever that folder has been moved.

    At an epoch's last step nothing is written before the validation: a run that resumed from there
    would take the epoch for finished and skip its validation. Between the batches of an accumulated
    step nothing is written either, because a checkpoint does not hold gradients.
    """

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Saves every so many steps."""
        if ends_step(trainer, batch_idx) and not trainer.is_last_batch:
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes over the best score, with the files where the folder is now."""
        folder = Path(self.dirpath or "")

        def here(path: str) -> str:
            return str(folder / Path(path).name) if path else path

        state = dict(state_dict, dirpath=self.dirpath)
        for key in ("best_model_path", "kth_best_model_path", "last_model_path"):
            state[key] = here(state[key])
        state["best_k_models"] = {here(path): k for path, k in state["best_k_models"].items()}
        super().load_state_dict(state)


def ends_step(trainer: Trainer, batch_idx: int) -> bool:
    """Whether the optimizer has stepped on this batch of an epoch."""
    return (batch_idx + 1) % trainer.accumulate_grad_batches == 0 or trainer.is_last_batch


class SafeCheckpointIO(TorchCheckpointIO):
    """Replaces a checkpoint in one go, and reads checkpoints without executing what they hold."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Writes a checkpoint beside the old one, then in its place."""
        content = io.BytesIO()
        torch.save(checkpoint, content)
        replace_file(path, content.getbuffer())
        weights = {
            name.removeprefix("net."): tensor
            for name, tensor in checkpoint["state_dict"].items()
            if name.startswith("net.")
        }
        save_model(_weights(path), weights, ModelCard(**checkpoint["darswin"]))

    def remove_checkpoint(self, path: str | Path) -> None:
        """Removes a checkpoint and the weights beside it."""
        super().remove_checkpoint(path)
        _weights(path).unlink(missing_ok=True)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Reads a checkpoint without executing anything in it."""
        if not Path(path).is_file():
            raise FileNotFoundError(f"no checkpoint {path}")
        try:
            checkpoint = read_pickle(path, map_location)
        except ValueError as error:
            others = sorted(set(Path(path).parent.glob("*.ckpt")) - {Path(path)})
            hint = f"; --ckpt_path {others[0]} goes on from that one" if others else ""
            raise ValueError(f"{error}{hint}") from error
        if not isinstance(checkpoint, dict) or "darswin" not in checkpoint:
            raise ValueError(f"{path} is no checkpoint of `darswin fit`: it names no model")
        return checkpoint


def _weights(path: str | Path) -> Path:
    return Path(path).with_suffix(".safetensors")
