"""Runs the paper's experiments, small: trains and tests every cell, and resumes where it stopped.

Each cell is `darswin fit` and `darswin test` on one core. Its folder under `--out` keeps what it
found, so that a study that was stopped goes on; `tables.py` makes the tables and pictures. Run it
with `make study`.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import torch
from cells import LEVELS, POLYNOMIAL, SWEEP, Cell, ablations, headline
from tqdm import tqdm

HERE = Path(__file__).parent
CONFIG = HERE / "fashion_mnist.yaml"


def run_cell(cell: Cell, out: Path, size: str, test_images: int, options: list[str]) -> dict:
    """Trains and tests one cell, or reads what an earlier run found."""
    folder = out / size / cell.key
    found = folder / "cell.json"
    given = dict(options=cell.options, test_images=test_images, arguments=options)
    if found.exists():
        result = json.loads(found.read_text())
        if result["given"] != given:
            raise ValueError(f"{found} was made with {result['given']}, not {given}: remove it")
        return result
    from darswin.cli.main import main
    from darswin.utils.files import replace_file

    run = ["--run", str(folder)]
    name = f"{cell.family}_{size}"
    model = ["--model.name", name, "--model.options", json.dumps(cell.options)]
    lenses = ["--data.train_lenses", cell.level, "--seed_everything", str(cell.seed)]
    tests = ["--xi", ",".join([*SWEEP, POLYNOMIAL, *LEVELS])]
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with (
        (folder / "log.txt").open("a") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        main(["fit", *run, "--config", str(CONFIG), *model, *lenses, *options, "--resume"])
        trained = time.perf_counter()
        main(["test", *run, *tests, "--data.limit", str(test_images)])
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
    replace_file(found, json.dumps(result, indent=1))
    return result


def use_one_core() -> None:
    """Two cells side by side are faster than one on two cores."""
    torch.set_num_threads(1)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=["headline", "ablations"], help="this part")
    parser.add_argument("--cell", help="only the cells whose key has this in it")
    parser.add_argument("--seeds", type=int, default=3, help="of the headline")
    parser.add_argument("--size", default="nano", help="of the models")
    parser.add_argument("--test-images", type=int, default=1000, help="through every lens")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("out/study"))
    parser.add_argument("--results", type=Path, default=HERE / "results")
    args, options = parser.parse_known_args(arguments)  # the others are options of `darswin fit`
    cells = [] if args.only == "ablations" else headline(args.seeds)
    cells += [] if args.only == "headline" else ablations()
    cells = [cell for cell in cells if (args.cell or "") in cell.key]
    cells.sort(key=lambda cell: cell.seed)  # a study that is stopped has whole tables first
    start, results = time.perf_counter(), []
    os.environ["OMP_NUM_THREADS"] = "1"
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.processes, context, use_one_core) as pool:
        jobs = [
            pool.submit(run_cell, cell, args.out, args.size, args.test_images, options)
            for cell in cells
        ]
        for job in tqdm(as_completed(jobs), total=len(jobs), unit="cell"):
            results.append(job.result())
    print(f"{len(results)} cells after {time.perf_counter() - start:.0f} s")
    if args.cell:
        print(json.dumps(results, indent=1))
        return
    from tables import collect

    collect(results, args.results, args.size)


if __name__ == "__main__":
    main()
