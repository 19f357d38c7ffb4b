"""Compares the study's models in float32 and with 8-bit integer products: top-1 at each ξ.

Each cell trains a model of `study.py`, unless that study has done so, and runs `darswin quantize`.
The ranges come from training pictures through the lenses of training. Both models are tested on the
same pictures. The folder of a cell keeps its results, so a study that was stopped can go on. Run it
with `make study-int8`.
"""

import argparse
import json
import os
import time
from collections import defaultdict
from pathlib import Path

import torch
import yaml
from cells import LEVELS, MODELS, SWEEP, Cell, headline
from jobs import check_given, printing_to, run_all
from records import machine, write
from study import run_cell as run_float
from tables import int8_table
from torch.utils.data import DataLoader

from darswin.cli.quantize import quantize
from darswin.deploy.optimize import optimize
from darswin.layers.quantized import quantized_layers
from darswin.models.saving import load_model, model_of_run
from darswin.train.data import WideAngleData
from darswin.utils.files import replace_file

HERE = Path(__file__).parent


def run_cell(
    cell: Cell, out: Path, size: str, test_images: int, pictures: int, options: list[str]
) -> dict:
    """Trains, quantizes and tests one cell, or reads the results of an earlier run."""
    trained = run_float(cell, out, size, test_images, options)
    folder = out / size / cell.key
    found = folder / "int8.json"
    given = trained["given"] | dict(pictures=pictures)
    if found.exists():
        result = json.loads(found.read_text())
        check_given(result["given"], given, found)
        return result
    start = time.perf_counter()
    model, _ = load_model(model_of_run(folder))
    with printing_to(folder / "log.txt"):
        file = quantize(run=str(folder), pictures=pictures, out=str(folder / "int8.safetensors"))
    quantized, _ = load_model(file)
    linear = sum(isinstance(module, torch.nn.Linear) for module in model.modules())
    models = dict(float32=model, int8=optimize(quantized, torch.int8))
    config = yaml.safe_load((folder / "config.yaml").read_text())["data"]
    data = WideAngleData(**config | dict(limit=test_images, seed=cell.seed))
    tests = {xi: compared(models, data.dataset("test", xi), data.batch_size) for xi in SWEEP}
    result = dict(
        label=cell.label,
        level=cell.level,
        seed=cell.seed,
        model=f"{cell.family}_{size}",
        given=given,
        layers=[len(quantized_layers(quantized)), linear],
        accuracy={name: {xi: tests[xi][name] for xi in SWEEP} for name in models},
        changed={xi: tests[xi]["changed"] for xi in SWEEP},
        seconds=time.perf_counter() - start,
    )
    replace_file(found, json.dumps(result, indent=1, allow_nan=False))
    return result


@torch.inference_mode()
def compared(models: dict, pictures, batch: int) -> dict[str, float]:
    """The top-1 of each model, and how many answers differ between the first and the last; all in
    percent of the pictures."""
    counts: dict[str, int] = defaultdict(int)
    for images, lens, labels in DataLoader(pictures, batch):
        said = {name: model(images, lens).argmax(1) for name, model in models.items()}
        for name, classes in said.items():
            counts[name] += int((classes == labels).sum())
        first, *_, last = said.values()
        counts["changed"] += int((first != last).sum())
    return {name: round(100 * count / len(pictures), 4) for name, count in counts.items()}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--level", choices=LEVELS, default="low", help="the level of the training lenses"
    )
    parser.add_argument("--cell", help="runs only cells whose key contains this text")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", default="nano", help="the size of the models")
    parser.add_argument(
        "--test-images", type=int, default=1000, help="the number of test images for every lens"
    )
    parser.add_argument(
        "--pictures", type=int, default=256, help="the number of training pictures for the ranges"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("out/study"))
    parser.add_argument("--results", type=Path, default=HERE / "results")
    args, options = parser.parse_known_args(arguments)  # other options are for `darswin fit`
    cells = [
        cell
        for cell in headline(args.seeds)
        if cell.level == args.level and (args.cell or "") in cell.key
    ]
    jobs = [(cell, args.out, args.size, args.test_images, args.pictures, options) for cell in cells]
    results = run_all(run_cell, jobs, args.processes, "cell")
    results.sort(key=lambda cell: (list(MODELS).index(cell["label"]), cell["seed"]))
    write(args.results / "int8.json", machine=machine(), size=args.size, cells=results)
    print(int8_table(results))


if __name__ == "__main__":
    main()
