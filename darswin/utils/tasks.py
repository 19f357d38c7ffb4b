"""Words of models, data and commands. This module does not import torch: the command line starts
fast."""

from typing import Literal

Task = Literal["classification", "segmentation", "distance"]
# The tasks that predict each pixel.
PixelTask = Literal["segmentation", "distance"]
DETECTOR_TASKS = ("detect", "pose", "obb", "segment")  # of Ultralytics
# Ways to give a picture the size of a model: "crop" cuts the longer side, "stretch" squashes it,
# "whole" keeps the aspect ratio and resizes the shorter side.
Fit = Literal["crop", "stretch", "whole"]

IGNORE = 255  # the label of an unlabelled pixel
