"""The names of the tasks. This module does not import torch: the command line starts fast."""

from typing import Literal

Task = Literal["classification", "segmentation", "distance"]
