"""The pictures of the pretrained study, kept in files, and what a detector finds in flat ones."""

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from pretrained_files import Files
from pretrained_methods import SURE, Detector
from pretrained_people import People
from pretrained_scenes import COCO, Scene, Thing

from darswin import boxes
from darswin.utils.files import replace_file


@cache
def detector_of(out: Path, name: str) -> Detector:
    """The detector with a name."""
    return Detector(Files(out), name)


class Pictures:
    """The scenes with their pictures, which are rendered once."""

    def __init__(self, out: Path) -> None:
        self.out, self.files = out, Files(out)

    def folder(self, split: str, index: int) -> Path:
        return self.out / "scenes" / f"{split}-{index}"

    def scene(self, split: str, index: int) -> Scene | People:
        """A scene whose things have boxes."""
        scene = People(self.files, index) if split == "people" else Scene(self.files, split, index)
        folder = self.folder(split, index)
        if not (folder / "things.json").exists():
            folder.mkdir(parents=True, exist_ok=True)
            picture = scene.render()
            cv2.imwrite(str(folder / "picture.png"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            stored = [(thing.label, thing.box.tolist()) for thing in scene.things]
            replace_file(folder / "things.json", json.dumps(stored))
        stored = json.loads((folder / "things.json").read_text())
        for thing, (label, box) in zip(scene.things, stored, strict=True):
            if thing.label != label:
                raise ValueError(f"{folder} was made with other scenes: remove it")
            thing.box = np.array(box)
        return scene

    def picture(self, split: str, index: int) -> np.ndarray:
        stored = cv2.imread(str(self.folder(split, index) / "picture.png"))
        return cv2.cvtColor(stored, cv2.COLOR_BGR2RGB)

    def flat(self, scene: Scene, detector: Detector) -> list[bool]:
        """Which things of a scene a detector finds in flat pictures around each."""
        file = self.folder(scene.split, scene.index) / f"flat-{detector.name}.json"
        if not file.exists():
            found = [found_flat(scene, thing, detector) for thing in scene.things]
            replace_file(file, json.dumps(found))
        return json.loads(file.read_text())


def found_flat(scene: Scene, thing: Thing, detector: Detector) -> bool:
    """Whether a detector finds a thing in the flat picture around it."""
    picture, box = scene.flat(thing)
    scale = detector.side / picture.shape[0]
    picture = cv2.resize(picture, (detector.side, detector.side), interpolation=cv2.INTER_AREA)
    found, sure, labels = detector(detector.normalised(picture))
    kept = (sure >= SURE) & (labels == COCO.index(thing.label))
    return bool((boxes.iou(found[kept].astype(float), scale * box[None]) >= 0.5).any())
