"""Runs the dense study: labels or distances for each pixel, through lenses unseen in training.

Each cell runs `darswin fit` and `darswin test` on one core. Its folder under `--out` keeps its
results, so a study that was stopped can go on. The pictures are rendered once before: see
`dense_data.py`. `dense_tables.py` makes the tables and figures. Run it with `make study-dense`,
which needs `apt-get install freedoom`.

The study has 72 cells: 8 models × 2 seeds × (2 tasks × 2 bands), and 8 controls. A cell trains on
8,000 pictures and tests on 24 sets of 75 pictures. It takes 6 to 9 minutes on a core, with another
cell on the other core. The pictures take 1,900 s, so two cores need 5 hours in total. With
`--known RECORD` a later run goes on from a record, and with `--collect` it needs no pictures.
"""

import argparse
import json
import time
from dataclasses import fields
from pathlib import Path

import dense_data
import torch
from dense_bounds import bounds
from dense_cells import Cell, all_cells
from dense_pictures import predict
from dense_tables import collect, publish
from dense_trivial import trivial
from jobs import add_options, check_given, printing_to, run_all

from darswin.cli.main import main as darswin
from darswin.utils.files import replace_file

HERE = Path(__file__).parent
CONFIG = HERE / "dense.yaml"
# The scores that are kept, overall and for each zone.
SCORES = {
    "segmentation": ("miou", "accuracy", "miou_sr"),
    "distance": ("delta1", "abs_rel", "rmse", "delta1_sr", "abs_rel_sr"),
}


def run_cell(cell: Cell, out: Path, size: str, options: list[str]) -> dict:
    """Trains and tests one cell, or reads the results of an earlier run."""
    folder, data = out / size / cell.key, out / "data"
    found = folder / "cell.json"
    given = dict(config=CONFIG.read_text(), options=list(cell.options), arguments=options)
    if found.exists():
        result = json.loads(found.read_text())
        check_given(result["given"], given, found)
        return result
    run = ["--task", cell.task, "--run", str(folder)]
    model = ["--model.name", f"{cell.family}_{size}", "--seed_everything", str(cell.seed)]
    pictures = ["--data.path", str(data / "train" / cell.trained_on), *cell.options, *options]
    tests = [str(data / "test" / name) for name in dense_data.test_sets()]
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with printing_to(folder / "log.txt"):
        darswin(["fit", *run, "--config", str(CONFIG), *model, *pictures, "--resume"])
        trained = time.perf_counter()
        darswin(["test", *run, "--data.test_paths", json.dumps(tests)])
        if cell.seed == 0 and cell.band == "low" and not cell.shuffled:
            predict(folder, data, cell.task)
    rows = json.loads((folder / "test.json").read_text())["results"]
    result = dict(
        label=cell.label,
        band=cell.band,
        task=cell.task,
        seed=cell.seed,
        shuffled=cell.shuffled,
        model=f"{cell.family}_{size}",
        device=torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu",
        given=given,
        sets={row["data"]: summary(row, cell.task) for row in rows},
        seconds=dict(train=trained - start, test=time.perf_counter() - trained),
    )
    replace_file(found, json.dumps(result, indent=1, allow_nan=False))
    return result


def summary(row: dict, task: str) -> dict:
    """The results of a test set that are kept."""

    def scores(of: dict) -> dict:
        return {name: None if of[name] is None else round(of[name], 5) for name in SCORES[task]}

    zones = [
        {"from_deg": zone["from_deg"], "to_deg": zone["to_deg"]} | scores(zone)
        for zone in row["per_zone"]
    ]
    classes = {
        name: None if of["iou"] is None else round(of["iou"], 5)
        for name, of in row["per_class"].items()
    }
    return scores(row) | dict(zones=zones) | (dict(iou=classes) if classes else {})


def known_record(file: Path) -> dict:
    """A record; ValueError for another configuration or other cameras."""
    record = json.loads(file.read_text())
    if record["config"] != CONFIG.read_text():
        raise ValueError(f"{file} was made with another configuration than {CONFIG}")
    if record["cameras"] != (cameras := list(dense_data.CAMERAS)):
        raise ValueError(f"{file} must have the cameras {cameras}, got {record['cameras']}")
    return record


def cell_of(result: dict) -> Cell:
    """The cell of a result."""
    return Cell(**{field.name: result[field.name] for field in fields(Cell)})


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser, "dense")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--size", default="nano", help="the size of the models")
    parser.add_argument(
        "--pixels", type=int, default=dense_data.SIZE, help="the size of the pictures, px"
    )
    parser.add_argument(
        "--pictures", type=int, nargs=3, default=dense_data.PICTURES,
        metavar=("TRAIN", "VAL", "TEST"), help="the number of pictures for each lens",
    )  # fmt: skip
    args, options = parser.parse_known_args(arguments)  # other options are for `darswin fit`
    cells = [cell for cell in all_cells(args.seeds) if (args.cell or "") in cell.key]
    start = time.perf_counter()
    record = known_record(args.known) if args.known else None
    known = {cell_of(result): result for result in record["cells"]} if record else {}
    if args.collect:
        cells = [c for c in cells if (args.out / args.size / c.key / "cell.json").exists()]
    else:
        bands = {cell.band for cell in cells}
        dense_data.make(args.out / "data", args.processes, args.pixels, tuple(args.pictures), bands)
        print(f"pictures after {time.perf_counter() - start:.0f} s")
    jobs = [(cell, args.out, args.size, options) for cell in cells if cell not in known]
    results = run_all(run_cell, jobs, args.processes, "cell")
    results += [known[cell] for cell in known if cell not in {job[0] for job in jobs}]
    print(f"{len(results)} cells after {time.perf_counter() - start:.0f} s")
    if args.cell:
        print(json.dumps(results, indent=1, allow_nan=False))
    else:
        if record:  # its pictures are the same
            blind, oracle = record["trivial"], record["bounds"]
        else:
            blind, oracle = trivial(args.out), bounds(args.out)
        made = collect(results, blind, oracle, CONFIG.read_text(), args.size)
        if record and args.collect:  # nothing was run here
            made["machine"] = record["machine"]
        publish(made, args.out, args.results)


if __name__ == "__main__":
    main()
