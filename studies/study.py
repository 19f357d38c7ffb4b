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

from cells import LEVELS, POLYNOMIAL, SWEEP, Cell, ablations, augmented, headline
from jobs import check_given, printing_to, run_all
from records import machine
from tables import collect

from darswin.cli.main import main as darswin
from darswin.utils.files import replace_file

HERE = Path(__file__).parent
CONFIG = HERE / "fashion_mnist.yaml"


def run_cell(cell: Cell, out: Path, size: str, test_images: int, options: list[str]) -> dict:
    """Trains and tests one cell, or reads the results of an earlier run."""
    folder = out / size / cell.key
    found = folder / "cell.json"
    given = given_to(cell, test_images, options)
    if found.exists():
        result = json.loads(found.read_text())
        check_given(result["given"], given, found)
        return result
    run = ["--run", str(folder)]
    name = f"{cell.family}_{size}"
    model = ["--model.name", name, "--model.options", json.dumps(cell.options)]
    lenses = ["--data.train_lenses", cell.level, "--seed_everything", str(cell.seed)]
    tests = ["--xi", ",".join([*SWEEP, POLYNOMIAL, *LEVELS])]
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with printing_to(folder / "log.txt"):
        arguments = given["arguments"]
        darswin(["fit", *run, "--config", str(CONFIG), *model, *lenses, *arguments, "--resume"])
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
        cpu=machine()["cpu"],
    )
    replace_file(found, json.dumps(result, indent=1, allow_nan=False))
    return result


def given_to(cell: Cell, test_images: int, options: list[str]) -> dict:
    """The settings of a cell that its results depend on, besides its level and seed."""
    arguments = [*cell.arguments, *options]
    return dict(options=cell.options, test_images=test_images, arguments=arguments)


def known_cells(file: Path, size: str) -> dict[tuple[str, str, int], dict]:
    """The results in a record, by label, level and seed; ValueError for models of another size."""
    record = json.loads(file.read_text())
    if record["size"] != size:
        raise ValueError(f"{file} has models of the size {record['size']}, not {size}")
    return {(cell["label"], cell["level"], cell["seed"]): cell for cell in record["cells"]}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", choices=["headline", "ablations", "augmented"], help="runs only this part"
    )
    parser.add_argument("--cell", help="runs only cells whose key contains this text")
    parser.add_argument("--seeds", type=int, default=3, help="the number of seeds of every cell")
    parser.add_argument("--size", default="nano", help="the size of the models")
    parser.add_argument(
        "--test-images", type=int, default=1000, help="the number of test images for every lens"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument(
        "--known", type=Path, help="a record (study--nano.json); its cells are not run again"
    )
    parser.add_argument("--out", type=Path, default=Path("out/study"))
    parser.add_argument("--results", type=Path, default=HERE / "results")
    args, options = parser.parse_known_args(arguments)  # other options are for `darswin fit`
    seeds = args.seeds
    parts = dict(headline=headline(seeds), ablations=ablations(seeds), augmented=augmented(seeds))
    chosen = [parts[args.only]] if args.only else parts.values()
    cells = [cell for part in chosen for cell in part if (args.cell or "") in cell.key]
    cells.sort(key=lambda cell: cell.seed)  # a stopped study has complete tables
    known = known_cells(args.known, args.size) if args.known else {}
    for cell in cells:
        if cell.identity in known:
            given = given_to(cell, args.test_images, options)
            check_given(known[cell.identity]["given"], given, f"{cell.key} in {args.known}")
    missing = [cell for cell in cells if cell.identity not in known]
    jobs = [(cell, args.out, args.size, args.test_images, options) for cell in missing]
    start = time.perf_counter()
    results = [*known.values(), *run_all(run_cell, jobs, args.processes, "cell")]
    print(f"{len(results)} cells after {time.perf_counter() - start:.0f} s")
    if args.cell:
        print(json.dumps(results, indent=1, allow_nan=False))
    else:
        collect(results, args.results, args.size)


if __name__ == "__main__":
    main()
