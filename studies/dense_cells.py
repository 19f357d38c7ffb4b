"""The cells of the dense study: a model, its task and the lenses on which it is trained."""

import json
from dataclasses import dataclass

from cells import UNDISTORTED
from dense_data import SHUFFLED
from jobs import key_of

# Training shows every picture as a lens of any ξ would have seen it.
THROUGH_ANY = ("--data.lens_augmentation", "0..1")

# The same view for all lenses: 4.2 rad (241°) wide, so that it shows all of the pictures of lenses
# of 165°. It has as many pixels as the picture, to 2 %. Windows divide the maps of all stages.
MERCATOR = dict(view=dict(name="mercator", fov=4.2, size=[144, 112]))
EQUIRECTANGULAR = dict(view=dict(name="equirectangular", fov=4.2, size=[112, 144]))


def with_options(**options: object) -> tuple[str, ...]:
    """The options of `darswin fit` for a model with these options."""
    return "--model.options", json.dumps(options)


MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "DarSwin-Unet A": ("darswin_unet_a", ()),
    "DarSwin-Unet RA": ("darswin_unet_ra", ()),
    "Swin-Unet": ("swin_unet", ()),
    "Swin-Unet (undis)": ("swin_unet", with_options(view=UNDISTORTED)),
    "LensAdapter(Swin-Unet)": ("swin_unet", with_options(view="square")),
    "U-Net with rays": ("conv_unet", ()),
    "U-Net, Mercator": ("conv_unet", with_options(**MERCATOR)),
    "U-Net, equirectangular": ("conv_unet", with_options(**EQUIRECTANGULAR)),
    "Swin-Unet, Mercator": ("swin_unet", with_options(**MERCATOR, window=[3, 7])),
    "Swin-Unet, equirectangular": ("swin_unet", with_options(**EQUIRECTANGULAR, window=[7, 3])),
    "LensAdapter, lens augmentation": ("swin_unet", (*with_options(view="square"), *THROUGH_ANY)),
    "Swin-Unet, lens augmentation": ("swin_unet", THROUGH_ANY),
}
# The models of a new study; the others are in an older record.
STUDIED_MODELS = (
    "DarSwin-Unet RA", "U-Net with rays", "LensAdapter(Swin-Unet)", "Swin-Unet",
    "U-Net, Mercator", "U-Net, equirectangular", "Swin-Unet, Mercator",
    "Swin-Unet, equirectangular",
)  # fmt: skip
# Each task and the band of its training.
STUDIED = (
    ("segmentation", "wide"),
    ("distance", "low"),
    ("segmentation", "low"),
    ("distance", "wide"),
)
# The losses. Steps, doors and objects are rare; silog leaves the scale of distances loose.
LOSSES = {
    "segmentation": (
        *("--model.loss", "ce+dice"),
        *("--model.class_weights", "[1,1,1,8,8,2,2,4]"),
    ),
    "distance": ("--model.loss", "log_l1"),
}
TASKS = tuple(LOSSES)
CONTROLLED = ("DarSwin-Unet RA", "LensAdapter(Swin-Unet)")


@dataclass(frozen=True)
class Cell:
    """A model, the lenses of its training, its task and its seed.

    Attributes: shuffled: a control in which each training picture has the lens of another picture.
    """

    label: str
    band: str
    task: str
    seed: int = 0
    shuffled: bool = False

    @property
    def family(self) -> str:
        """The name of the model without its size."""
        return MODELS[self.label][0]

    @property
    def options(self) -> tuple[str, ...]:
        """The options of `darswin fit`."""
        return *LOSSES[self.task], *MODELS[self.label][1]

    @property
    def trained_on(self) -> str:
        """The folder of the training pictures."""
        return f"{SHUFFLED}-{self.band}" if self.shuffled else self.band

    @property
    def key(self) -> str:
        """The name of its folder."""
        return key_of(f"{self.label} {self.trained_on} {self.task} {self.seed}")


def all_cells(seeds: int) -> list[Cell]:
    """The cells, seed by seed, so that a stopped study has complete tables."""
    cells = []
    for seed in range(seeds):
        cells += [
            Cell(label, band, task, seed) for task, band in STUDIED for label in STUDIED_MODELS
        ]
        if seed == 0:
            cells += [
                Cell(label, band, task, seed, shuffled=True)
                for task, band in STUDIED
                for label in CONTROLLED
            ]
    return cells
