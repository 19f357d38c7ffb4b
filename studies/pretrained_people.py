"""Real people for the pretrained study: a video of OpenCV, taken again by wide lenses.

The video's frame stands in a panorama as a wide window through which one sees people walk. The
truth is what the detector finds in the frame itself.
"""

import math

import cv2
import numpy as np
import torch
from pretrained_files import VIDEO, Files
from pretrained_methods import LEVEL_METHODS, SURE, Detector
from pretrained_scenes import SIZE, WIDE, Billboard, Shot, Thing

from darswin import boxes

WINDOW = math.radians(100)  # the horizontal field of view of the video's camera, as assumed
STEP = 40  # frames of the video between pictures
METHODS = {name: LEVEL_METHODS[name] for name in (
    "raw", "raw, 1024²", "concentric square", "equirectangular", "stereographic", "mercator",
    "mercator, 1024²", "tiles: 4", "tiles: 5", "tiles: 9",
)}  # fmt: skip


class People(Shot):
    """A frame of the video before a panorama, through a wide lens."""

    def __init__(self, files: Files, index: int) -> None:
        super().__init__(files, WIDE[index % len(WIDE)], "city", 0.0)
        self.split, self.index = "people", index
        rng = np.random.default_rng([index, *b"people"])
        yaw = rng.uniform(-0.5, 0.5)
        direction = np.array([math.sin(yaw), 0.0, math.cos(yaw)])
        capture = cv2.VideoCapture(str(files(VIDEO)))
        capture.set(cv2.CAP_PROP_POS_FRAMES, STEP * index)
        self.frame = cv2.cvtColor(capture.read()[1], cv2.COLOR_BGR2RGB)
        opaque = np.full(self.frame.shape[:2], 255, np.uint8)
        self.window = Billboard(np.dstack((self.frame, opaque)), direction, self.up, WINDOW)
        detector = Detector(files, "CenterNet")
        found, scores, labels = detector(detector.normalised(self.frame))
        sure = found[(scores >= SURE) & (labels == 0)]  # people
        carried, _ = boxes.carry(sure.astype(float), self.to_picture)
        self.things = [self._thing(box) for box in carried]

    def _thing(self, box: np.ndarray) -> Thing:
        middle = torch.from_numpy((box[:2] + box[2:]) / 2 - 0.5)[None]
        ray = self.lens.unproject_points(middle, (SIZE, SIZE))[0].numpy()
        return Thing("person", VIDEO, ray / np.linalg.norm(ray), 0.0, box)

    def to_picture(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of the frame → pixels of the camera's picture."""
        sides = np.array(self.frame.shape[1::-1])
        plane = ((points + 0.5) / sides * 2 - 1) * self.window.half
        rays = self.window.direction + plane @ np.stack((self.window.right, self.window.down))
        return self.lens.project_points(torch.from_numpy(rays)[None], (SIZE, SIZE))[0].numpy()

    def picture_of(self, rays: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Without masks: the things are in the window, and have their boxes."""
        picture = self.background(rays)
        self.window.paint(picture, rays)
        return picture, []
