"""The tables and the figure of the calibration study, made from its record."""

import math
import statistics
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from records import machine, markdown, write

from darswin.viz.plot import add_legend, page_figure, save_figure

NOT_RUN = "Not run yet: `make study-calibrate`."
SUCCESS = 0.5  # degrees: a success has a smaller median error
NOISE = 0.2  # px
MOST_PICTURES = 20  # of the tables by field of view and by model
AUTO, ONE, TOLD = OURS = "ours, auto", "ours, KannalaBrandt", "ours, true model"
REAL = (  # the methods of real boards
    AUTO, ONE, "cv2.calibrateCamera", "cv2.calibrateCamera, rational",
    "cv2.fisheye, flags and guess", "cv2.omnidir", "mrcal, splined",
)  # fmt: skip
SHOWN = (
    AUTO, ONE, "cv2.calibrateCamera, rational", "cv2.fisheye, flags",
    "cv2.fisheye, flags and guess", "cv2.omnidir", "mrcal, splined",
)  # fmt: skip
CEILING = 3.0  # degrees: the figure shows all larger errors, and failures, here

Keep = Callable[[dict], bool]


def publish(record: dict, folder: Path) -> None:
    """Writes a record, with the machine and versions, and draws its figure."""
    write(folder / "calibrate.json", machine=machine(), **record)
    draw(record, folder / "calibrate.png")


def _methods(record: dict) -> list[str]:
    """In the order of the first set that has them all."""
    return list(max((of["results"] for of in record["sets"]), key=len))


def _noisy(of: dict) -> bool:
    return of["noise"] == NOISE


def _usual(of: dict) -> bool:
    return _noisy(of) and of["pictures"] == MOST_PICTURES


def succeeded(result: dict) -> bool:
    return "failed" not in result and result["median"] < SUCCESS


def _results(record: dict, name: str, keep: Keep) -> list[dict]:
    """The results of a method for the sets that count."""
    return [of["results"][name] for of in record["sets"] if keep(of) and name in of["results"]]


def _share(results: list[dict]) -> str:
    return f"{sum(map(succeeded, results))}/{len(results)}" if results else "–"


def _number(degrees: float) -> str:
    """In thousandths of a degree."""
    value = 1000 * degrees
    return "< 0.05" if value < 0.05 else f"{value:.3g}" if value < 999.5 else f"{value:,.0f}"


def _angle(values: Iterable[float]) -> str:
    """The median of angles."""
    values = list(values)
    return _number(statistics.median(values)) if values else "–"


def _medians(results: list[dict]) -> str:
    """Of the successes: the median of their median errors, and of the errors of 95 % of rays."""
    good = [of for of in results if succeeded(of)]
    if not good:
        return "–"
    return f"{_angle(of['median'] for of in good)} ({_angle(of['most'] for of in good)})"


def draw(record: dict, path: Path) -> None:
    """Draws the median error of each set by field of view."""
    figure = page_figure(4.5)
    axes = figure.subplots()
    fovs = sorted({of["fov"] for of in record["sets"]})
    for number, name in enumerate(SHOWN):
        places, values = [], []
        for of in record["sets"]:
            if _noisy(of) and of["pictures"] >= 8 and name in of["results"]:
                result = of["results"][name]
                error = math.inf if "failed" in result else result["median"]
                aside = 0.8 * ((number + 0.5) / len(SHOWN) - 0.5)
                places.append(fovs.index(of["fov"]) + aside)
                values.append(min(error, CEILING))
        shape = "D" if name in OURS else "o"
        axes.plot(places, values, shape, ms=3.5, alpha=0.7, label=name)
    axes.axhline(SUCCESS, color="gray", lw=0.8, ls="--")
    axes.set_xticks(range(len(fovs)), [f"{fov}°" for fov in fovs])
    axes.set(xlabel="field of view", ylabel="median error of rays (°)", yscale="log")
    ticks = (0.003, 0.01, 0.03, 0.1, 0.3, 1)
    axes.set_yticks([*ticks, CEILING], [*map(str, ticks), "3 or more,\nor failed"])
    axes.set_yticks([], minor=True)
    for border in np.arange(len(fovs) - 1) + 0.5:
        axes.axvline(border, color="lightgray", lw=0.8)
    add_legend(figure, axes.get_legend_handles_labels()[0])
    save_figure(figure, path, colors=256)


# -- tables -----------------------------------------------------------------------------------


def success(record: dict) -> str:
    """Sets with a median error below the limit, by field of view and for few pictures."""
    fovs = sorted({of["fov"] for of in record["sets"]})
    rows = []
    for name in _methods(record):
        took = [of["seconds"] for of in _results(record, name, _usual)]
        seconds = f"{statistics.median(took):.2g}" if took else "–"
        many = [
            _results(record, name, lambda of, fov=fov: _noisy(of) and of["pictures"] >= 8
                     and of["fov"] == fov)
            for fov in fovs
        ]  # fmt: skip
        few = _results(record, name, lambda of: _noisy(of) and of["pictures"] < 8)
        rows.append([name, *map(_share, many), _share(few), seconds])
    return markdown(["", *(f"{fov}°" for fov in fovs), "5 pictures", "seconds"], rows)


def by_fov(record: dict) -> str:
    fovs = sorted({of["fov"] for of in record["sets"]})
    rows = [
        [name, *(
            _medians(_results(record, name, lambda of, fov=fov: _usual(of) and of["fov"] == fov))
            for fov in fovs
        )]
        for name in _methods(record)
    ]  # fmt: skip
    return markdown(["0.001°", *(f"{fov}°" for fov in fovs)], rows)


def by_pictures(record: dict) -> str:
    counts = sorted({of["pictures"] for of in record["sets"]})
    rows = []
    for name in _methods(record):
        cells = [
            _medians(_results(record, name, lambda of, n=n: _noisy(of) and of["pictures"] == n))
            for n in counts
        ]
        exact = [of for of in _results(record, name, lambda of: not _noisy(of)) if succeeded(of)]
        rows.append([name, *cells, _angle(of["median"] for of in exact)])
    heads = [*(f"{n} pictures" for n in counts), "20, no noise"]
    return markdown(["0.001°", *heads], rows)


def ratios(record: dict, ours: str, other: str) -> list[float]:
    """Our error over that of another method, for the sets with noise where both succeed."""
    pairs = [
        (of["results"][ours], of["results"][other])
        for of in record["sets"]
        if _noisy(of) and {ours, other} <= of["results"].keys()
    ]
    return [a["median"] / b["median"] for a, b in pairs if succeeded(a) and succeeded(b)]


def _mean(ratios: list[float]) -> str:
    """The geometric mean, and of how many."""
    return f"{statistics.geometric_mean(ratios):.2f} ({len(ratios)})" if ratios else "–"


def against(record: dict) -> str:
    """The mean ratio of errors to each of the others."""
    peers = [name for name in _methods(record) if name not in OURS]
    rows = [[peer, *(_mean(ratios(record, o, peer)) for o in OURS)] for peer in peers]
    return markdown(["our error over that of", *OURS], rows)


def best_other(results: dict) -> tuple[str, float] | None:
    """The smallest median error of the other methods that succeed."""
    good = {n: of["median"] for n, of in results.items() if n not in OURS and succeeded(of)}
    return min(good.items(), key=lambda item: item[1]) if good else None


def by_model(record: dict) -> str:
    """The sets with 20 pictures and noise of each true model."""
    rows = []
    for model in dict.fromkeys(of["model"] for of in record["sets"]):
        sets = [of for of in record["sets"] if _usual(of) and of["model"] == model]
        cells = [_angle(of["results"][n].get("median", 180.0) for of in sets) for n in OURS]
        best = [best[1] for of in sets if (best := best_other(of["results"]))]
        rows.append([model, ", ".join(f"{of['fov']}°" for of in sets), *cells, _angle(best)])
    return markdown(["true lens", "fields of view", *OURS, "best of the others"], rows)


def real(record: dict) -> str:
    """Real boards: the errors of pictures that were left out, px."""
    if not record["real"]:
        return "The pictures were not there."
    rows = []
    for of in record["real"]:
        cells = []
        for name in REAL:
            if (result := of["results"].get(name)) is None:
                cells.append("–")
            elif result["failed"]:
                cells.append(f"fails for {result['failed']}")
            else:
                cells.append(f"{result['error']:.3f} ({result['median']:.3f})")
        models = " / ".join(of["results"][AUTO]["models"])
        rows.append([of["set"], f"{of['pictures']} of {of['of']}", *cells, models])
    return markdown(["px", "pictures", *REAL, "auto's models"], rows)


def _best_real(of: dict) -> float:
    """The smallest error of the other methods that fail for no picture of a real set."""
    others = (of["results"][name] for name in REAL if name not in OURS and name in of["results"])
    return min(result["error"] for result in others if not result["failed"])


def targets(record: dict) -> str:
    """What was aimed at, and what was found."""
    found = [_targets(record, name) for name in OURS]
    aims = {
        "success with 8 or more pictures": "all",
        "error with 20 pictures": "at most 20",
        "error at 150°": "",
        "error at 190° to 250°": "as at 150°",
        "error, to the best of the others in each set": "at most 1.1 times",
    }
    rows = [[*aim, *cells] for aim, *cells in zip(aims.items(), *found, strict=True)]
    for of in record["real"]:
        cells = [f"{of['results'][name]['error']:.4f}" for name in (AUTO, ONE)]
        aim = f"the best other's {_best_real(of):.4f}"
        rows.append([f"left out (px), {of['set']}", aim, *cells, ""])
    return markdown(["", "target", *OURS], rows)


def _targets(record: dict, name: str) -> list[str]:
    """What was found with one of our models, over the sets that it got."""
    usual = _results(record, name, _usual)
    errors = [result.get("median", 180.0) for result in usual]
    to_best = [
        of["results"][name]["median"] / best[1]
        for of in record["sets"]
        if _noisy(of) and name in of["results"] and succeeded(of["results"][name])
        and (best := best_other(of["results"]))
    ]  # fmt: skip
    by_fov = (
        _results(record, name, lambda of, a=low, b=high: _usual(of) and a <= of["fov"] <= b)
        for low, high in ((150, 150), (190, 250))
    )
    return [
        _share(_results(record, name, lambda of: of["pictures"] >= 8)),
        f"{_angle(errors)}; {sum(error <= 0.02 for error in errors)}/{len(errors)} sets",
        *(_angle(result.get("median", 180.0) for result in results) for results in by_fov),
        f"{_mean(to_best)}; {sum(ratio <= 1.1 for ratio in to_best)}/{len(to_best)} sets",
    ]


def run_line(record: dict) -> str:
    tools = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    return (
        f"{len(record['sets'])} sets of corners; the run took {record['core_minutes']:.0f} minutes "
        f"of one core. Versions: {tools}."
    )


def tables(record: dict | None) -> dict[str, str]:
    """The tables and the figure by the name of their place in a page; without a record, a line."""
    made = dict(
        run=run_line, targets=targets, success=success, fov=by_fov, pictures=by_pictures,
        against=against, model=by_model, real=real,
        figure=lambda _: "![Errors of rays](../studies/results/calibrate.png)",
    )  # fmt: skip
    return {
        f"calibrate {name}": NOT_RUN if record is None else make(record)
        for name, make in made.items()
    }
