"""What a reader of scenes is asked for."""

from dataclasses import dataclass
from pathlib import Path

from darswin.data.scenes.parts import ScenesSplit
from darswin.data.scenes.scene import Target


@dataclass(frozen=True)
class Options:
    """The arguments of `darswin.data.open_scenes`."""

    split: ScenesSplit
    target: Target
    channels: int = 3
    lens: str | Path | None = None
    camera: str | None = None
    classes: str | Path | None = None
    splits: str | Path | None = None
    holdout: float = 0.1
