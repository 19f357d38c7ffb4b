"""What a reader of scenes is asked for."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from darswin.data.scenes.parts import Named, ScenesSplit, choose
from darswin.data.scenes.scene import Target


@dataclass(frozen=True)
class Options:
    """The arguments of `darswin.data.open_scenes`."""

    split: ScenesSplit
    target: Target
    channels: int = 3
    lens: str | Path | None = None
    camera: str | None = None
    coefficients: str | None = None
    classes: str | Path | None = None
    splits: str | Path | None = None
    holdout: float = 0.1

    def choice(
        self,
        root: Path,
        *,
        group: Callable[[str], str] | None = None,
        named: Named | None = None,
    ) -> Callable[[list[str]], list[str]]:
        """What takes the split's of all stems of a folder that says no splits itself; see
        `darswin.data.scenes.parts.choose`."""
        return partial(
            choose,
            split=self.split,
            root=root,
            splits=self.splits,
            holdout=self.holdout,
            group=group,
            named=named,
        )
