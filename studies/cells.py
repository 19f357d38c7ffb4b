"""The cells of the study: a model and the lenses on which it is trained."""

import math
from dataclasses import dataclass, field

LEVELS = ("very low", "low", "medium", "high")
SWEEP = [f"{k / 20:g}" for k in range(21)]  # ξ = 0, 0.05, …, 1
POLYNOMIAL = "polynomial"

# The released code spaces rings and samples by tan θ, so the paper's numbers need it too; see
# docs/explanation/spacings.md.
DARSWIN = dict(spacing="tan", samples=[10, 10])
# A perspective view of all that a lens sees, up to 175°.
END = math.radians(87.5)
UNDISTORTED = dict(name="perspective", reach=END, theta_max=END, supersampling=1)


@dataclass(frozen=True)
class Cell:
    """A model, its options, the lenses and the seed of its training, and arguments of `fit`."""

    label: str
    family: str
    options: dict = field(default_factory=dict)
    level: str = "low"
    seed: int = 0
    arguments: tuple[str, ...] = ()

    @property
    def identity(self) -> tuple[str, str, int]:
        """The values that tell it from other cells."""
        return self.label, self.level, self.seed

    @property
    def key(self) -> str:
        """The name of its folder."""
        words = f"{self.label} {self.level} {self.seed}".lower()
        return "".join(c if c.isalnum() else "-" for c in words)


MODELS = {
    "DarSwin-A": ("darswin_a", DARSWIN),
    "DAT": ("dat", {}),
    "Swin (undis)": ("swin", dict(view=UNDISTORTED)),
    "Swin": ("swin", {}),
}

# Table 3 of the paper, and the spacings, because the paper and its released code differ there.
ABLATIONS = {
    "polar position bias": ("darswin_a", dict(position_bias="polar")),
    "angular position bias": ("darswin_a", dict(position_bias="angular")),
    "S_r = 5": ("darswin_a", dict(samples=[5, 10])),
    "S_r = 2": ("darswin_a", dict(samples=[2, 10])),
    "DarSwin-RA": ("darswin_ra", {}),
    "no jitter": ("darswin_a", dict(jitter=0.0)),
    "uniform sampling": ("darswin_a", dict(sample_spacing="radius")),
    "no distortion-aware partition": ("darswin_a", dict(spacing="radius")),
    "spacing θ": ("darswin_a", dict(spacing="theta")),
    "spacing g": ("darswin_a", dict(spacing="g")),
}

# Training shows every picture as a lens of any ξ would have seen it.
THROUGH_ANY = ("--data.lens_augmentation", "0..1")
AUGMENTED = ("DarSwin-A", "Swin (undis)", "Swin")


def headline(seeds: int) -> list[Cell]:
    """Each model on each level; all cells of the first seed come first."""
    return [
        Cell(label, family, options, level, seed)
        for seed in range(seeds)
        for level in LEVELS
        for label, (family, options) in MODELS.items()
    ]


def augmented_label(label: str) -> str:
    return f"{label}, lens augmentation"


def augmented(seeds: int) -> list[Cell]:
    """Three models trained on "very low" with lens augmentation."""
    return [
        Cell(augmented_label(label), *MODELS[label], "very low", seed, THROUGH_ANY)
        for seed in range(seeds)
        for label in AUGMENTED
    ]


def ablations(seeds: int) -> list[Cell]:
    """DarSwin-A trained on "low", with one change each."""
    return [
        Cell(label, family, DARSWIN | changes, seed=seed)
        for seed in range(seeds)
        for label, (family, changes) in ABLATIONS.items()
    ]
