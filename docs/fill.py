"""Fills the tables of README and pages from what benchmarks and studies found: `make tables`.

In a benchmark's table "a / b" is at one and at two threads, and a ratio is the time of what one
would write without the operator, over ours. The numbers in sentences are not filled: marks
`<!-- numbers: … -->` say what they are, and tests/docs/test_claims.py compares them.
"""

import json
import re
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "studies"), str(ROOT / "benchmarks")]

import peers  # noqa: E402
from kit import tables as bench  # noqa: E402
from kit.record import Record  # noqa: E402
from kit.timing import OURS, Timing  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
PAGES = [
    ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), RESULTS / "missed_targets.md",
]  # fmt: skip

# The CPUs that there are records of, by the end of their names; the pages show the first one.
CPUS = {"intel-r-xeon-r-6-207-avx512": "Intel Xeon with AMX"}
SUITES = ("sampling", "to_image", "one_frame", "frames")

SAMPLING_PEERS = ("F.grid_sample", "F.grid_sample + permute", "cv2.remap")
FRAME_PEERS = ("eager model", "ONNX Runtime", "OpenVINO", "AOTInductor package")
IMAGE_PEERS = ("F.pad + F.grid_sample",)
# The rows of the README's table of speed: subject, mode, setting, batch.
SPEED = (
    ("polar_sample", "forward", "256×256", 8),
    ("polar_sample", "forward+backward", "256×256", 8),
    ("polar_to_image", "forward", "64×256 → 256×256", 2),
)


def records(suite: str) -> dict[str, Record]:
    """Of a suite, by CPU."""
    paths = {name: RESULTS / f"{suite}--{cpu}.json" for cpu, name in CPUS.items()}
    return {name: Record.load(path) for name, path in paths.items() if path.exists()}


def machine_line(suites: Mapping[str, Record]) -> str:
    """Sentences on the machine of the first CPU; its records must be of one commit."""
    heads = {suite: record.machine for suite, record in suites.items()}
    head = heads["sampling"]
    for suite, other in heads.items():
        for key in ("cpu", "tier", "cores", "torch", "commit"):
            assert other[key] == head[key], (suite, key, other[key], head[key])
    assert not head["commit"].endswith("dirty")
    return (
        f"The measurements are from {head['cores']} cores of an {head['cpu']}, on the tier "
        f"`{head['tier']}`.\nThey use torch {head['torch'].split('+')[0]} and the code of commit "
        f"{head['commit']}."
    )


def missed_line(timings: Sequence[Timing]) -> str:
    """Sentences on how many targets of each operator are missed, and how many rows a peer wins."""
    with_target = [t for t in timings if t.target is not None]
    counts = []
    for operator in dict.fromkeys(t.subject.partition(",")[0] for t in with_target):
        chosen = [t for t in with_target if t.subject.partition(",")[0] == operator]
        counts.append(f"{sum(t.missed for t in chosen)} of {len(chosen)} for `{operator}`")
    lost = [t for t in with_target if t.ratio < 1 and not t.name.startswith(OURS)]
    return f"On this CPU the operators miss {', '.join(counts[:-1])} and {counts[-1]}.\n" + (
        f"A peer is faster than the operator in {len(lost)} of these rows."
        if lost
        else "They are faster than the peer in every row."
    )


def drop_in_line(timings: Sequence[Timing]) -> str:
    """How much faster the call of howto/sampling.md is than what it replaces."""
    found = [
        t
        for t in timings
        if (t.subject, t.mode, t.name) == ("polar_sample", "forward, layout image", "F.grid_sample")
    ]
    cases = "; ".join(dict.fromkeys(f"{t.setting}, batch {t.batch}" for t in found))
    low, high = (end(t.ratio for t in found) for end in (min, max))
    return f"This call is {low:.1f} to {high:.1f} times as fast as `F.grid_sample` ({cases})."


def frame_line(timings: Sequence[Timing]) -> str:
    """Sentences on the times of peers, and of float32 for int8, for one frame on one thread."""
    frames = [t for t in peers.single_frames(timings) if t.threads == 1]
    chosen, parts = [t for t in frames if "float32" in t.mode], []
    for peer in FRAME_PEERS[1:]:
        found = [t.ratio for t in chosen if t.name == peer]
        parts.append(f"{min(found):.1f} to {max(found):.1f} times as fast as the {peer}")
    parts[:2] = [part.replace("the ", "") for part in parts[:2]]
    first, *others = parts
    in_int8 = [t for t in timings if (t.name, t.batch, t.threads) == ("float32", 1, 1)]
    wide, narrow = (
        [f"`{t.subject}` is {t.ratio:.1f} times" for t in in_int8 if t.mode.endswith(end)]
        for end in ("fixed lens", "avx2")
    )
    how = "at a camera's pace" if frames[0].paced else "in a loop"
    return (
        f"For one frame on one core, {how}, these models are {first}.\n"
        f"They are {' and '.join(others)}.\n"
        f"In a loop, {' and '.join(wide)} as fast in int8 as in float32."
        + (f"\nOn the tier of AVX2, {' and '.join(narrow)} as fast." if narrow else "")
    )


def frames_table(timings: Sequence[Timing]) -> str:
    """A row for each size of frames and samples: our time, and the peers' times over it."""
    peers = [name for name in dict.fromkeys(t.name for t in timings) if name != OURS]
    rows = []
    for (setting, *_), found in bench.by_case(t for t in timings if not t.paced).items():
        ours = " / ".join(f"{1e6 * t.median:.3g}" for t in found[OURS])
        rows.append([setting, ours, *(bench.ratios(found[peer]) for peer in peers)])
    return bench.markdown(["frame → samples", "ours (µs)", *peers], rows)


def text_of(suite: str, table: Callable[[Record], str]) -> str:
    """A sentence on the machine of each record of a suite on any CPU, and its table."""
    texts = []
    for path in sorted(RESULTS.glob(f"{suite}--*.json")):
        record = Record.load(path)
        head = record.machine
        assert not head["commit"].endswith("dirty")
        texts.append(
            f"On {head['cores']} cores of an {head['cpu']}, on the tier `{head['tier']}`, with "
            f"the code of commit {head['commit']}:\n\n{table(record)}"
        )
    return "\n\n".join(texts)


def demo_table(record: dict) -> str:
    """A row a model, a column a lens: the mean of the seeds."""
    rows = [
        [name, *(f"{statistics.mean(at):.1f}" for at in zip(*seeds, strict=True))]
        for name, seeds in record["accuracy"].items()
    ]
    return bench.markdown(["ξ", *(f"{xi:.1f}" for xi in record["xi"])], rows)


def demo_line(record: dict) -> str:
    """How many points each network loses from the first lens to the last, in the mean of seeds."""
    ours, blind, swin = (
        statistics.mean(seed[0] - seed[-1] for seed in record["accuracy"][name])
        for name in ("DarSwin-A", "without lens knowledge", "Swin")
    )
    return (
        f"From ξ = 0 to ξ = 1, DarSwin loses {ours:.1f} points. The same network without lens "
        f"knowledge loses {blind:.0f} points, and Swin {swin:.0f}."
    )


def tables() -> dict[str, str]:
    """All tables, by the name of their place in a page."""
    import calibrate_tables
    import dense_tables
    import estimate_tables
    import learned_tables
    import pretrained_tables
    import rigs_tables
    import sizes_tables
    import tables as study

    studies = ROOT / "studies" / "results"
    suites = {suite: records(suite) for suite in SUITES}
    first = {suite: next(iter(found.values())) for suite, found in suites.items()}
    sampling, to_image, one_frame, frames = first.values()
    cpus = {
        cpu: [t for suite in SUITES if cpu in suites[suite] for t in suites[suite][cpu].timings]
        for cpu in CPUS.values()
    }
    single = peers.single_frames(one_frame.timings)
    demo = json.loads((ROOT / "docs" / "accuracy.json").read_text())
    cells = json.loads((studies / "study--nano.json").read_text())["cells"]
    gpus = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("gpu--*.json"))]
    quantized = json.loads((studies / "int8.json").read_text())["cells"]
    cameras = json.loads((studies / "learned_lens.json").read_text())["cameras"]
    dense = json.loads((studies / "dense.json").read_text())
    tried = json.loads((studies / "trials.json").read_text())["rows"]
    sizes = json.loads((studies / "sizes.json").read_text())
    pretrained = json.loads((studies / "pretrained.json").read_text())
    calibrated = json.loads((studies / "calibrate.json").read_text())
    estimated = json.loads((studies / "estimate.json").read_text())
    rigs = json.loads((studies / "rigs.json").read_text())
    return {
        "demo": demo_table(demo),
        "demo line": demo_line(demo),
        "drop-in": drop_in_line(sampling.timings),
        "machine line": machine_line(first),
        "speed": peers.best_table(cpus, SPEED),
        "missed line": missed_line([*sampling.timings, *to_image.timings]),
        "missed": peers.missed_table([*sampling.timings, *to_image.timings]),
        "frame line": frame_line(one_frame.timings),
        "latency": peers.latency_table(one_frame.timings, FRAME_PEERS[1:]),
        "camera": peers.camera_table(
            [t for t in one_frame.timings if t.subject.startswith("darswin")], FRAME_PEERS[1:2]
        ),
        "paced": bench.paced_table(single),
        "from frame": bench.paced_table(t for t in one_frame.timings if t not in single),
        "starts": bench.starts_table(one_frame.starts),
        "gpu": bench.gpu_text(gpus),
        "steps": text_of("steps", bench.steps_table),
        "rig": text_of("rig", lambda record: peers.peers_table(record.timings, "rig")),
        "frames paced": bench.paced_table(frames.timings),
        "one frame": peers.frames_table(one_frame.timings, FRAME_PEERS),
        "frames": frames_table(frames.timings),
        "sampling": peers.peers_table(sampling.timings, "polar_sample", SAMPLING_PEERS),
        "to image": peers.peers_table(
            to_image.timings, "polar_to_image", ("F.pad + F.grid_sample",)
        ),
        **study.tables(cells),
        "int8": study.int8_table(quantized),
        **learned_tables.tables(cameras),
        **dense_tables.tables(dense, studies),
        **{f"trials {of}": dense_tables.trials(tried, of) for of in dense_tables.TRIED},
        **sizes_tables.tables(sizes),
        **pretrained_tables.tables(pretrained),
        **calibrate_tables.tables(calibrated),
        **estimate_tables.tables(estimated),
        **rigs_tables.tables(rigs),
    }


def placed(name: str, table: str) -> str:
    """A table between the marks of its place."""
    return f"<!-- table: {name} -->\n{table}\n<!-- end: {name} -->"


def main() -> None:
    found = tables()
    for page in PAGES:
        text = page.read_text()
        for name in re.findall(r"<!-- table: (.*) -->", text):
            before, rest = text.split(f"<!-- table: {name} -->")
            text = before + placed(name, found[name]) + rest.split(f"<!-- end: {name} -->")[1]
        page.write_text(text)


if __name__ == "__main__":
    main()
