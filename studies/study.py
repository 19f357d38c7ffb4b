"""Repeats the paper's experiments with small models: trains and tests every cell of the study.

Each cell runs `darswin fit` and `darswin test` on one core. Its folder under `--out` keeps its
results, so a study that was stopped can go on. `tables.py` makes the tables and figures. Run it
with `make study`.
"""

import argparse
import json
import os
import time
from pathlib import Path

from cells import LEVELS, POLYNOMIAL, SWEEP, Cell, ablations, headline
from jobs import printing_to, run_all
from tables import collect

from darswin.cli.main import main as darswin
from darswin.utils.files import replace_file

HERE = Path(__file__).parent
CONFIG = HERE / "fashion_mnist.yaml"


def run_cell(cell: Cell, out: Path, size: str, test_images: int, options: list[str]) -> dict:
    """Trains and tests one cell, or reads the results of an earlier run."""
    folder = out / size / cell.key
    found = folder / "cell.json"
    given = dict(options=cell.options, test_images=test_images, arguments=options)
    if found.exists():
        result = json.loads(found.read_text())
        if result["given"] != given:
            raise ValueError(f"{found} was made with {result['given']}, not {given}: remove it")
        return result
    run = ["--run", str(folder)]
    name = f"{cell.family}_{size}"
    model = ["--model.name", name, "--model.options", json.dumps(cell.options)]
    lenses = ["--data.train_lenses", cell.level, "--seed_everything", str(cell.seed)]
    tests = ["--xi", ",".join([*SWEEP, POLYNOMIAL, *LEVELS])]
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with printing_to(folder / "log.txt"):
        darswin(["fit", *run, "--config", str(CONFIG), *model, *lenses, *options, "--resume"])
        trained = time.perf_counter()
        darswin(["test", *run, *tests, "--data.limit", str(test_images)])
    rows = json.loads((folder / "test.json").read_text())["results"]
    result = dict(
        label=cell.label,
        model=name,
        given=given,
        level=cell.level,
        seed=cell.seed,
        accuracy={row["lenses"]: round(100 * row["top1"], 4) for row in rows},
        seconds=dict(train=trained - start, test=time.perf_counter() - trained),
    )
    replace_file(found, json.dumps(result, indent=1, allow_nan=False))
    return result


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=["headline", "ablations"], help="runs only this part")
    parser.add_argument("--cell", help="runs only cells whose key contains this text")
    parser.add_argument("--seeds", type=int, default=3, help="the number of seeds of the headline")
    parser.add_argument("--size", default="nano", help="the size of the models")
    parser.add_argument(
        "--test-images", type=int, default=1000, help="the number of test images for every lens"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("out/study"))
    parser.add_argument("--results", type=Path, default=HERE / "results")
    args, options = parser.parse_known_args(arguments)  # other options are for `darswin fit`
    cells = [] if args.only == "ablations" else headline(args.seeds)
    cells += [] if args.only == "headline" else ablations()
    cells = [cell for cell in cells if (args.cell or "") in cell.key]
    cells.sort(key=lambda cell: cell.seed)  # a stopped study has complete tables
    jobs = [(cell, args.out, args.size, args.test_images, options) for cell in cells]
    start = time.perf_counter()
    results = run_all(run_cell, jobs, args.processes, "cell")
    print(f"{len(results)} cells after {time.perf_counter() - start:.0f} s")
    if args.cell:
        print(json.dumps(results, indent=1, allow_nan=False))
    else:
        collect(results, args.results, args.size)


if __name__ == "__main__":
    main()
