"""The study of rigs: faces of a simulator, two lenses and a car, against exact pictures.

The scenes are analytic, so the truth has 16 × 16 exact rays a pixel. Pictures are rendered once and
kept in `out/rigs`. `pip install py360convert==1.0.4` adds that peer. `make study-rigs`.
"""

import argparse
import json
from pathlib import Path

import rigs_cameras
import rigs_faces
import rigs_sheet
from jobs import use_one_core
from rigs_tables import publish


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speed", action="store_true", help="only times, for an existing record")
    parser.add_argument("--out", type=Path, default=Path("out/rigs"))
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args(arguments)
    use_one_core()
    if args.speed:
        record = json.loads((args.results / "rigs.json").read_text())
        record.pop("machine")
    else:
        record = dict(
            faces=rigs_faces.study(args.out), two=rigs_cameras.two_lenses(args.out),
            car=rigs_cameras.four_cameras(args.out),
        )  # fmt: skip
        rigs_sheet.draw(args.out, args.results / "rigs.png")
    publish(record | dict(speed=rigs_faces.speed(args.out)), args.results)


if __name__ == "__main__":
    main()
