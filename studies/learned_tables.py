"""The tables and the figure of the learned lenses, from the results of `learned_lens.py`."""

from pathlib import Path

import numpy as np
from learned_problems import GRID, IMAGES, LOSSES, PROBLEMS, STARTS
from matplotlib.axes import Axes
from records import machine, markdown, write

from darswin.viz.plot import add_legend, page_figure, save_figure

CLOSE = 0.5  # px, the largest distance of a lens that counts as found
CLOSE_XI = 0.05
UNKNOWN = {
    "xi": "ξ",
    "place": "focal length, principal point",
    "all": "ξ, focal length, principal point",
}


def collect(cameras: list[dict], folder: Path) -> None:
    """Writes the results, with the machine and versions, and draws their figure."""
    cameras = sorted(cameras, key=lambda c: (list(PROBLEMS).index(c["problem"]), c["camera"]))
    write(folder / "learned_lens.json", machine=machine(), cameras=cameras)
    draw(cameras, folder / "learned_lens.png")


def trials_of(cameras: list[dict], problem: str, loss: str, images: int) -> list[dict]:
    """All descents of a kind, with the `true` lens and the `search` of their cameras."""
    return [
        trial
        | dict(
            camera=camera["camera"],
            true=camera["true"],
            true_loss=camera["losses"][loss],
            search=camera["search"][loss],
        )
        for camera in cameras
        for trial in camera["trials"]
        if (camera["problem"], trial["loss"], trial["images"]) == (problem, loss, images)
    ]


def distances(trials: list[dict], of: str = "found") -> np.ndarray:
    return np.array([trial[of]["distance"] for trial in trials])


def xi_errors(trials: list[dict], of: str = "found") -> np.ndarray:
    return np.array([abs(t[of]["values"]["xi"] - t["true"]["values"]["xi"]) for t in trials])


def better_starts(trials: list[dict]) -> list[dict]:
    """The descent of each camera that ended with the lowest loss."""
    best = {}
    for trial in sorted(trials, key=lambda trial: -trial["least"]):
        best[trial["camera"]] = trial
    return list(best.values())


def share(close: np.ndarray) -> str:
    return f"{close.sum()} of {len(close)}"


def recovery_table(cameras: list[dict]) -> str:
    """A row for each problem and loss, on all images: the distance of the found lenses from the
    true lens, the share near it, the share with no higher loss, and the accuracy."""
    heads = [
        "unknown", "loss", "start (px)", "found (px): median, 90 %", f"below {CLOSE} px",
        f"lower of {STARTS} starts below {CLOSE} px", "loss ≤ the true lens's",
        "best guess (px)", "accuracy (%): start → found (true lens)",
    ]  # fmt: skip
    rows = []
    for problem in PROBLEMS:
        for loss in LOSSES:
            trials = trials_of(cameras, problem, loss, max(IMAGES[problem]))
            if not trials:
                continue
            found = distances(trials)
            start, found_accuracy, true = (
                np.mean([trial[of]["accuracy"] for trial in trials])
                for of in ("start", "found", "true")
            )
            row = [
                UNKNOWN[problem] if loss == LOSSES[0] else "",
                loss,
                f"{np.median(distances(trials, 'start')):.2f}",
                f"{np.median(found):.2f}, {np.quantile(found, 0.9):.2f}",
                share(found < CLOSE),
                share(distances(better_starts(trials)) < CLOSE),
                share(np.array([trial["least"] <= trial["true_loss"] for trial in trials])),
                f"{np.median(distances(trials, 'search')):.2f}",
                f"{start:.0f} → {found_accuracy:.0f} ({true:.0f})",
            ]
            rows.append(row)
    return markdown(heads, rows)


def images_table(cameras: list[dict]) -> str:
    """The errors of ξ, with a row for each loss and a column for each number of images."""
    rows = []
    for loss in LOSSES:
        cells = [loss]
        for count in IMAGES["xi"]:
            trials = trials_of(cameras, "xi", loss, count)
            errors = xi_errors(trials)
            cells.append(f"{np.median(errors):.3f}, {share(errors < CLOSE_XI)}")
        grid = xi_errors(
            [
                dict(true=camera["true"], search=camera["search"][loss])
                for camera in cameras
                if camera["problem"] == "xi"
            ],
            "search",
        )
        cells.append(f"{np.median(grid):.3f}, {share(grid < CLOSE_XI)}")
        rows.append(cells)
    heads = [f"{count} images" for count in IMAGES["xi"]]
    return markdown(["loss", *heads, "the loss's lowest on a grid"], rows)


def tables(cameras: list[dict]) -> dict[str, str]:
    """The tables by the name of their place in a page."""
    return {"learned-lens": recovery_table(cameras), "learned-xi": images_table(cameras)}


# -- the picture ------------------------------------------------------------------------------


def draw(cameras: list[dict], path: Path) -> None:
    """Draws the losses over ξ, descents on them, and their distances from the truth."""
    figure = page_figure(12.7)
    axes = figure.subplots(len(LOSSES) + 2, 2)
    known = [camera for camera in cameras if camera["problem"] == "xi"]
    for (left, right), loss in zip(axes[:-2], LOSSES, strict=True):
        draw_landscapes(left, known, loss)
        draw_paths(right, known, loss)
    *distances_of, last = axes[-2:].flat
    for panel, problem in zip(distances_of, PROBLEMS, strict=True):
        draw_distances(panel, cameras, problem)
    draw_images(last, known)
    add_legend(figure, distances_of[0].get_legend_handles_labels()[0])
    save_figure(figure, path, colors=256)


def draw_landscapes(axes: Axes, cameras: list[dict], loss: str) -> None:
    """Draws a curve for each camera, scaled to its range, with a dot at the true ξ."""
    for k, camera in enumerate(cameras):
        curve = np.array(camera["search"][loss]["curve"])
        low, high = curve.min(), curve.max()
        axes.plot(GRID, (curve - low) / (high - low), color=f"C{k}", lw=1)
        true = camera["true"]["values"]["xi"]
        height = (camera["losses"][loss] - low) / (high - low)
        axes.plot(true, height, "o", color=f"C{k}", ms=5, mec="k", mew=0.6)
    axes.set(title=f'"{loss}"', xlabel="ξ", ylabel="loss", xlim=(0, 1.2))
    axes.grid(alpha=0.3)


def draw_paths(axes: Axes, cameras: list[dict], loss: str) -> None:
    """Draws ξ at each step downwards, and the true ξ as a dashed line."""
    for k, camera in enumerate(cameras):
        axes.axvline(camera["true"]["values"]["xi"], color=f"C{k}", ls="--", lw=0.8)
        for trial in trials_of([camera], "xi", loss, max(IMAGES["xi"])):
            axes.plot(trial["path"], range(len(trial["path"])), color=f"C{k}", lw=1.2)
    axes.set(title=f'"{loss}"', xlabel="ξ", ylabel="step of descent", xlim=(0, 1.2))
    axes.invert_yaxis()
    axes.grid(alpha=0.3)


def draw_distances(axes: Axes, cameras: list[dict], problem: str) -> None:
    """Draws the share of descents that end within a distance of the true lens."""
    for loss in LOSSES:
        trials = trials_of(cameras, problem, loss, max(IMAGES[problem]))
        axes.ecdf(distances(trials), label=loss)
    axes.ecdf(distances(trials, "start"), color="grey", ls=":", label="start")
    axes.axvline(CLOSE, color="k", lw=0.6)
    axes.set_title("unknown: " + ",\n".join(UNKNOWN[problem].rsplit(", ", 1)), fontsize="medium")
    axes.set(xlabel="distance (px)", ylabel="share of descents", xscale="log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3)


def draw_images(axes: Axes, cameras: list[dict]) -> None:
    """Draws the median error of ξ against the number of images."""
    counts = IMAGES["xi"]
    for loss in LOSSES:
        errors = [np.median(xi_errors(trials_of(cameras, "xi", loss, count))) for count in counts]
        axes.plot(counts, errors, "o-", label=loss)
    axes.axhline(CLOSE_XI, color="k", lw=0.6)
    axes.set_title("unknown: ξ", fontsize="medium")
    axes.set(xlabel="images", ylabel="median error of ξ", xscale="log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
