"""The tables of the estimate study, made from its record."""

import statistics
from collections.abc import Iterable
from pathlib import Path

from records import machine, markdown, write

MODELS = ("Spherical", "KannalaBrandt", "Division")
SHOWN = "KannalaBrandt"  # whose interval the tables show
NOT_RUN = "Not run yet: `make study-estimate`."
RIM, RIM_OF_ONE, CURVES, POINTS = 3.0, 5.0, 10, 2.0  # the targets: %, %, curves, points


def publish(record: dict, folder: Path) -> None:
    """Writes a record, with the machine and versions."""
    write(folder / "estimate.json", machine=machine(), **record)


def _error(result: dict) -> str:
    return "refused" if "refused" in result else f"{round(result['error'], 1) + 0:+.1f}"


def _range(result: dict) -> str:
    """The interval, and whether it holds the true angle."""
    if "refused" in result:
        return "refused"
    return f"{result['low']:.1f}–{result['high']:.1f}{'' if result['holds'] else ' (no)'}"


def _found(results: Iterable[dict]) -> list[dict]:
    return [result for result in results if "refused" not in result]


def _near(results: Iterable[dict], percent: float) -> int:
    return sum(abs(result["error"]) <= percent for result in results)


def _middle(results: Iterable[dict]) -> str:
    sizes = [abs(result["error"]) for result in results]
    return f"{statistics.median(sizes):.1f}" if sizes else "–"


def _score(score: float | None) -> str:
    return "–" if score is None else f"{score:.1f}"


def rims(record: dict) -> str:
    """A row a lens: what all of its pictures tell."""
    rows = []
    for of in record["lenses"]:
        results = [of["all"][model] for model in MODELS]
        true = f"{_true(of['all']):.1f}" if _found(results) else "–"
        rows.append([of["name"], true, *map(_error, results), _range(of["all"][SHOWN])])
    return markdown(["lens", "true θ (°)", *(f"{m} (%)" for m in MODELS), "interval (°)"], rows)


def _true(results: dict) -> float:
    return _found(results.values())[0]["true"]


def singles(record: dict) -> str:
    """A row a lens: what each of its pictures tells alone."""
    rows, every = [], []
    for of in [*record["lenses"], None]:
        single = of["single"] if of else {m: [r for s in every for r in s[m]] for m in MODELS}
        every.append(single)
        results = single[SHOWN]
        found = _found(results)
        sure = [result for result in found if not result["doubts"]]
        rows.append([
            of["name"] if of else "all",
            *(_middle(_found(single[model])) for model in MODELS),
            f"{_near(found, RIM_OF_ONE)}/{len(results)}",
            f"{_near(sure, RIM_OF_ONE)}/{len(sure)}",
            f"{sum(result['holds'] for result in found)}/{len(found)}",
            str(len(results) - len(found)),
        ])  # fmt: skip
    within = f"within {RIM_OF_ONE:.0f} %"
    header = [within, f"{within}, no doubts", "interval holds θ", "refused"]
    return markdown(["lens", *(f"{m} (%)" for m in MODELS), *header], rows)


def digits(record: dict) -> str:
    """A row a lens: the accuracy with the true lens, with estimates, and with wrong lenses."""
    rows = []
    for of in record["lenses"]:
        scores = of["digits"]
        alone = [score for score in scores["single"] if score is not None]
        rows.append([
            of["name"], _score(scores["true"]),
            *(_score(scores["estimated"].get(model)) for model in MODELS),
            f"{statistics.median(alone):.1f} ({min(alone):.1f})" if alone else "–",
            *(_score(score) for score in scores["wrong"].values()),
        ])  # fmt: skip
    wrong = record["lenses"][0]["digits"]["wrong"]
    return markdown(["lens", "true lens", *MODELS, "one picture", *wrong], rows)


def real(record: dict) -> str:
    """A row a camera."""
    rows = [
        [
            of["camera"], str(of["pictures"]), f"{_true(of['all']):.1f}",
            *(_error(of["all"][model]) for model in MODELS), _range(of["all"][SHOWN]),
            "; ".join(of["all"][SHOWN].get("doubts", ())) or "none",
        ]
        for of in record["real"]
    ]  # fmt: skip
    header = ["camera", "pictures", "published θ (°)", *(f"{m} (%)" for m in MODELS)]
    return markdown([*header, "interval (°)", "doubts"], rows)


def targets(record: dict) -> str:
    """The targets that were set in advance, for the default model and for the one that is shown."""
    lenses, rows = record["lenses"], []
    for model in MODELS[:2]:
        found = _found(of["all"][model] for of in lenses)
        alone = [
            result
            for of in lenses
            for result, long in zip(of["single"][model], of["long"], strict=True)
            if long >= CURVES
        ]
        lost = [
            of["digits"]["true"] - of["digits"]["estimated"][model]
            for of in lenses
            if model in of["digits"]["estimated"]
        ]
        rows += [
            [model, f"θ within {RIM:.0f} %, all pictures", f"{_near(found, RIM)}/{len(lenses)}"],
            [
                model,
                f"θ within {RIM_OF_ONE:.0f} %, one picture with {CURVES} long curves",
                f"{_near(_found(alone), RIM_OF_ONE)}/{len(alone)}",
            ],
            [
                model,
                f"accuracy within {POINTS:.0f} points of the true lens, all pictures",
                f"{sum(points <= POINTS for points in lost)}/{len(lenses)}",
            ],
        ]
    return markdown(["model", "target", "reached"], rows)


TABLES = {"rims": rims, "single": singles, "digits": digits, "real": real, "targets": targets}


def tables(record: dict | None) -> dict[str, str]:
    """All tables, by the name of their place in the page."""
    return {
        f"estimate {name}": make(record) if record else NOT_RUN for name, make in TABLES.items()
    }
