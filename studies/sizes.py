"""Runs the sizes study: distances that only the angular size of a ball reveals.

Each cell trains and tests one method with one seed on one core. Its file under `--out` keeps its
results, so a study that was stopped can go on. The pictures are rendered once before: see
`sizes_scene.py`. `sizes_tables.py` makes the tables and figures. Run it with `make study-sizes`.

The study has 33 cells, 11 methods with 3 seeds. A cell takes 60 to 110 s on a core of its own, and
rendering takes 40 s, so the study takes about half an hour on two cores.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jobs import add_options, check_given, key_of, run_all
from sizes_methods import METHODS, Measurer
from sizes_scene import LENSES, OWN, SIZE, TRAIN, lenses_of, pictures, with_angles_scaled
from sizes_tables import SHUFFLED, WRONG, collect, publish
from torch import Tensor

from darswin.lens import Lens
from darswin.train.distance import DistanceSums, distance_loss
from darswin.utils.files import replace_file

CHUNK = 600  # pictures in a file

Pictures = tuple[Tensor, Tensor]  # images (N, H, W, 3) uint8 and distances (N, H, W)


@dataclass(frozen=True)
class Settings:
    """The settings that all cells share."""

    size: int = SIZE  # px
    train: int = 4800  # pictures
    test: int = 100  # pictures in each test set
    passes: int = 1  # over the training pictures
    batch: int = 4
    rate: float = 5e-3  # the highest learning rate
    weight_decay: float = 0.05
    warmup: float = 0.1  # of the steps
    gradient_clip: float = 5.0


@dataclass(frozen=True)
class Cell:
    """A method and its seed."""

    label: str
    seed: int = 0

    @property
    def key(self) -> str:
        """The name of its file."""
        return key_of(f"{self.label} {self.seed}".replace("+", "and"))


def all_cells(seeds: int) -> list[Cell]:
    """The cells, seed by seed, so that a stopped study has complete tables."""
    return [Cell(label, seed) for seed in range(seeds) for label in METHODS]


# -- pictures ---------------------------------------------------------------------------------


def files_of(folder: Path, name: str, count: int) -> list[tuple[Path, str, int, int, int]]:
    """The jobs of `render` for the `count` pictures of a set."""
    return [
        (folder / f"{name}-{count}-{first}.npz", name, count, first, min(first + CHUNK, count))
        for first in range(0, count, CHUNK)
    ]


def render(file: Path, name: str, count: int, first: int, last: int) -> dict:
    """Writes the pictures `first` to `last` of a set."""
    images, distances = pictures(name, count, first, last)
    partial = file.with_suffix(".part.npz")
    np.savez(partial, images=images, distances=distances)
    partial.replace(file)
    return {}


def make(folder: Path, settings: Settings, processes: int) -> None:
    """Renders the pictures that are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = files_of(folder, TRAIN, settings.train)
    for name in (OWN, *LENSES):
        jobs += files_of(folder, name, settings.test)
    run_all(render, [job for job in jobs if not job[0].exists()], processes, "file")


def load(folder: Path, name: str, count: int) -> Pictures:
    """The pictures of a set."""
    parts = [np.load(file) for file, *_ in files_of(folder, name, count)]
    images, distances = (np.concatenate([p[key] for p in parts]) for key in ("images", "distances"))
    return torch.from_numpy(images), torch.from_numpy(distances)


# -- training and testing ---------------------------------------------------------------------


def train(label: str, seed: int, data: Pictures, lenses: Lens, settings: Settings) -> Measurer:
    """A trained network of a method."""
    torch.manual_seed(seed)
    model = Measurer(METHODS[label]).train()
    parameters = list(model.parameters())
    optimizer = torch.optim.AdamW(
        [
            dict(params=[p for p in parameters if p.dim() > 1]),
            dict(params=[p for p in parameters if p.dim() <= 1], weight_decay=0.0),
        ],
        weight_decay=settings.weight_decay,
    )
    images, distances = data
    order = torch.cat([torch.randperm(len(images)) for _ in range(settings.passes)])
    batches = order.split(settings.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.rate, total_steps=len(batches), pct_start=settings.warmup
    )
    for batch in batches:
        found = model(images[batch], lenses[batch])
        loss = distance_loss(found, distances[batch].float(), "log_l1")
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, settings.gradient_clip)
        optimizer.step()
        schedule.step()
    return model.eval()


@torch.inference_mode()
def scores(model: Measurer, data: Pictures, lenses: Lens) -> dict[str, float]:
    """δ1 and AbsRel over the pixels of the balls."""
    sums = DistanceSums(1)
    batches = torch.arange(len(data[0])).split(20)
    for batch in batches:
        images, distances = (of[batch] for of in data)
        found = model(images, lenses[batch] if len(lenses) > 1 else lenses)[:, 0]
        known = distances > 0
        found, truth = found[known], distances[known].float()
        sums.update(found, truth, torch.zeros_like(truth, dtype=torch.long), torch.ones_like(truth))
    found_scores = sums.scores(sums.compute()[0][0])
    return {name: round(found_scores[name], 5) for name in ("delta1", "abs_rel")}


def run_cell(cell: Cell, out: Path, settings: Settings) -> dict:
    """Trains and tests one cell, or reads the results of an earlier run."""
    file, data = out / "cells" / f"{cell.key}.json", out / "data"
    if file.exists():
        result = json.loads(file.read_text())
        check_given(result["settings"], asdict(settings), file)
        return result
    start = time.perf_counter()
    lenses = lenses_of(TRAIN, settings.train)
    model = train(cell.label, cell.seed, load(data, TRAIN, settings.train), lenses, settings)
    trained = time.perf_counter()
    sets = {}
    for name in (OWN, *LENSES):
        pictures_of = load(data, name, settings.test)
        lenses = lenses_of(name, settings.test)
        sets[name] = scores(model, pictures_of, lenses)
        if name == OWN:
            for control, factor in WRONG.items():
                sets[control] = scores(model, pictures_of, with_angles_scaled(lenses, factor))
            others = torch.arange(settings.test).roll(1)
            sets[SHUFFLED] = scores(model, pictures_of, lenses[others])
    result = dict(
        label=cell.label,
        seed=cell.seed,
        settings=asdict(settings),
        sets=sets,
        parameters=sum(p.numel() for p in model.parameters()),
        seconds=dict(train=round(trained - start, 1), test=round(time.perf_counter() - trained, 1)),
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, json.dumps(result, indent=1, allow_nan=False))
    return result


def known_cells(file: Path, settings: Settings) -> dict[Cell, dict]:
    """The cells of a record; ValueError if it was made with other settings."""
    record = json.loads(file.read_text())
    check_given(record["settings"], asdict(settings), file)
    return {Cell(cell["label"], cell["seed"]): cell for cell in record["cells"]}


def main(arguments: list[str] | None = None) -> None:
    default = Settings()
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser, "sizes")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--pictures", type=int, nargs=2, default=(default.train, default.test),
        metavar=("TRAIN", "TEST"), help="the number of pictures for training and in each test set",
    )  # fmt: skip
    args = parser.parse_args(arguments)
    train_count, test_count = args.pictures
    settings = Settings(train=train_count, test=test_count)
    cells = [cell for cell in all_cells(args.seeds) if (args.cell or "") in cell.key]
    known = known_cells(args.known, settings) if args.known else {}
    if args.collect:
        cells = [cell for cell in cells if (args.out / "cells" / f"{cell.key}.json").exists()]
    else:
        make(args.out / "data", settings, args.processes)
    jobs = [(cell, args.out, settings) for cell in cells if cell not in known]
    results = run_all(run_cell, jobs, args.processes, "cell")
    results += [known[cell] for cell in known if cell not in {job[0] for job in jobs}]
    if args.cell:
        print(json.dumps(results, indent=1, allow_nan=False))
    else:
        publish(collect(results, asdict(settings)), args.results)


if __name__ == "__main__":
    main()
