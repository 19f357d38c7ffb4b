"""The models that come with darswin, trained: each with its weights, a model card, a sample picture
and the lens of that picture, beside each other in `weights/`."""

from pathlib import Path
from typing import Literal

WEIGHTS = Path(__file__).with_name("weights")


def list_pretrained() -> list[str]:
    """The names that `load_model` and `darswin predict --model` know."""
    return sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))


def pretrained_file(
    name: str, kind: Literal["safetensors", "md", "png", "json"] = "safetensors"
) -> Path:
    """A file of a model that comes with darswin: its weights, its model card, its sample picture,
    or that picture's lens.

    Raises:
        ValueError: an unknown name.
    """
    if name not in list_pretrained():
        raise ValueError(
            f"no model {name!r} comes with darswin; there are {', '.join(list_pretrained())}"
        )
    return WEIGHTS / f"{name}.{kind}"
