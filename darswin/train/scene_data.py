"""Scenes with a label or a distance for each pixel, for segmentation and distance."""

import os
from pathlib import Path
from typing import Any, ClassVar

from darswin.data.scenes import open_scenes
from darswin.data.scenes.dataset import SceneSamples
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import Target
from darswin.data.splits import Split
from darswin.train.data import RunData


class SceneData(RunData):
    """Scenes of calibrated cameras: images, their lenses, and a label or a distance for each pixel.

    Args:
        path: a folder of scenes: see `darswin.data.open_scenes`.
        test_paths: folders of scenes to test on, in order, each with its own lenses, in place of
            the test set of `path`.
        batch_size: images in a batch of one process.
        crop: trains on random parts of the pictures; each side of a part has at least this share
            of the picture's side, in (0, 1]. null uses whole pictures.
        common: as `RunData`; the default size of large pictures is 128.
    """

    target: ClassVar[Target]
    default_size = 128
    fov = 0.0

    def __init__(
        self,
        path: str,
        *,
        test_paths: list[str] | None = None,
        batch_size: int = 16,
        crop: float | None = None,
        **common: Any,
    ):
        super().__init__(path, batch_size=batch_size, **common)
        self.card_fit = self.fit
        self.test_paths = test_paths or []
        self._more_augmentation = dict(crop=crop)

    def _open(self, split: Split, channels: int | None) -> Scenes:
        scenes = open_scenes(
            self.path, split, self.target, channels=channels, lens=self._lens,
            camera=self._camera, coefficients=self._coefficients, **self._opening,
        )  # fmt: skip
        return scenes if split == "train" else self._of_same_classes(scenes, f"its {split!r} split")

    @property
    def colors(self) -> list[list[int]]:  # type: ignore[override]  # as `classes`
        """The colour (r, g, b) of each class, if the data set has colours."""
        return self.source("train").colors

    @property
    def test_names(self) -> list[str]:
        """The names of the tested folders, or their paths below a common folder if two have the
        same name."""
        paths = [os.path.abspath(path) for path in self.test_paths or [self.path]]
        names = [os.path.basename(path) for path in paths]
        if len(set(names)) == len(names):
            return names
        shared = os.path.commonpath([os.path.dirname(path) for path in paths])
        return [os.path.relpath(path, shared) for path in paths]

    def _test_scenes(self, path: str) -> Scenes:
        """The test set of another folder, or all of its scenes if it has no splits."""
        opening = self._opening | dict(splits=None, channels=self.channels)
        flat = (Path(path) / "images").is_dir()
        scenes = open_scenes(path, "all" if flat else "test", self.target, **opening)
        return self._of_same_classes(scenes, path)

    def _of_same_classes(self, scenes: Scenes, what: str) -> Scenes:
        if scenes.classes != self.classes:
            raise ValueError(
                f"{what} has the classes {scenes.classes}, but {self.path} has {self.classes}: "
                "test a model on the classes that it was trained on"
            )
        return scenes

    def dataset(self, split: Split, name: str | None = None, **options: Any) -> SceneSamples:
        """A split with the lenses of its cameras; `name` is one of `test_names`."""
        if split == "test" and self.test_paths and name is not None:
            scenes = self._test_scenes(self.test_paths[self.test_names.index(name)])
        else:
            scenes = self.source(split)
        return self._noted(SceneSamples(self._limited(scenes), **self._form, **options))
