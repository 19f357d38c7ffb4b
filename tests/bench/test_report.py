import pytest

from darswin.bench import report
from darswin.bench.memory import Memory
from darswin.bench.timing import COMPILED, OURS, PRODUCTS, REFERENCE, Timing


def timing(name, milliseconds, ratio=1.0, *, mode="inference", batch=8, threads=2):
    seconds = 1e-3 * milliseconds
    return Timing(mode, "float32", batch, threads, name, 10, seconds, 1e-3, 2 * seconds, ratio)


@pytest.fixture
def record():
    timings = [
        *(timing(OURS, t, threads=n) for n, t in ((1, 200.0), (2, 100.0))),
        *(timing(REFERENCE, t, r, threads=n) for n, t, r in ((1, 480.0, 2.5), (2, 310.0, 3.0))),
        timing(COMPILED, 200.0, 2.1),
        timing(PRODUCTS, 90.0, 0.9),
        timing(OURS, 20.0, batch=1),
        timing(OURS, 300.0, mode="training"),
    ]
    memory = [
        Memory("training", "float32", 8, OURS, 100 * 2**20, 300 * 2**20, 500 * 2**20),
        Memory("training", "float32", 8, REFERENCE, 100 * 2**20, 300 * 2**20, 600 * 2**20),
    ]
    return report.Record(
        machine=dict(tier="avx512"), model="darswin_a_small", size=64, operations=4_500_000_000,
        timings=timings, memory=memory, products=[],
    )  # fmt: skip


def test_ratios_and_bars(record):
    assert record.ratio(("inference", "float32", 8, 1), REFERENCE) == 2.5
    assert record.ratio(("training", "float32", 8, 2), REFERENCE) is None
    assert report.bar_lines(record) == [
        "inference, float32, batch 8, over reference: 3.00 (bar 2.60)",
        "inference, float32, batch 8, over compiled reference: 2.10 (bar 2.20) MISSED",
        "inference, float32, batch 8, over products alone: 0.90 (bar 0.80)",
        "peak memory of a training step, float32, in all: 0.80 (bar 0.80)",
        "peak memory of a training step, float32, of the step itself: 0.67 (bar 0.80)",
    ]
    record.size = 32
    assert report.bar_lines(record) == []  # the bars are for one model and size


def test_tables(record):
    lines = report.table(record).splitlines()
    assert len(lines) == 2 + 3
    assert lines[2] == (
        "| inference, float32, batch 8 | 40 / 80 |  | 2.50× / 3.00× | 2.10× | 90% |  |  |"
    )
    assert lines[3].endswith("| 20.0 | 40.0 |")
    assert report.memory_table(record).splitlines()[2:] == [
        "| training, float32, batch 8, in all | 400 | 500 | 0.80 |",
        "| training, float32, batch 8, of the batch itself | 200 | 300 | 0.67 |",
    ]
    assert report.roof(record) == (
        "inference, float32, batch 8, 2 threads: products alone 400 GFLOP/s, the model 360 (90%)"
    )


def test_products(record):
    row = dict(product="forward", rows=512, in_features=384, out_features=96, threads=2)
    record.products = [row | dict(seconds=dict(onednn=0.002, torch=0.005))]
    assert report.products(record) == (
        "forward, 512 rows, 384 → 96, 2 threads: onednn 2.00 ms; torch 2.50×"
    )


def test_files(record, tmp_path):
    path = tmp_path / "new" / "model.json"
    record.save(path)
    assert report.Record.load(path) == record
    report.plot(record, path.with_suffix(".png"))
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
