"""Scenes: pictures with a label or a distance for each pixel, and readers of data sets of them."""

from darswin.data.scenes.opening import open_scenes
from darswin.data.scenes.scene import Scene, Scenes
from darswin.data.scenes.targets import IGNORE

__all__ = ["IGNORE", "Scene", "Scenes", "open_scenes"]
