import peers

from darswin.bench import tables
from darswin.bench.tables import BOTH


def test_models(record):
    lines = tables.models_table(record.timings).splitlines()
    assert len(lines) == 2 + 3
    assert (
        f"| inference, float32, batch 8 | 40{BOTH}80 |  | 2.50×{BOTH}3.00× | 2.10× | 90% |  |  |"
    ) in lines
    (latency,) = (line for line in lines if "batch 1 " in line)
    assert latency.endswith("| 20.0 | 40.0 |")
    assert tables.memory_table(record.memory).splitlines()[2:] == [
        "| training, float32, batch 8, in all | 400 | 500 | 0.80 |",
        "| training, float32, batch 8, of the batch itself | 200 | 300 | 0.67 |",
    ]
    assert tables.roofline_lines(record) == [
        "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads: matrix products alone "
        "400 GFLOP/s, the model 360 (90%)"
    ]


def test_autotune():
    row = dict(product="forward", rows=512, in_features=384, out_features=96, threads=2)
    assert tables.autotune_lines([row | dict(seconds=dict(onednn=0.002, torch=0.005))]) == [
        "forward, 512 rows, 384 → 96, 2 threads: onednn 2.00 ms; torch 2.50×"
    ]


def test_peers(operators):
    assert peers.peers_table(operators, "polar_sample").splitlines() == [
        "| `polar_sample` | ours (ms) | slow | fast | darswin (avx2) |",
        "|---|---|---|---|---|",
        f"| 64×64, batch 8, forward | 2.00{BOTH}1.00 | 5.0×{BOTH}6.0× | 1.5× | 2.5× |",
    ]
    assert peers.peers_table(operators, "polar_sample", ["fast"]).count("\n") == 2
    assert peers.peers_table(operators, "polar_sample", ["peer"]).count("\n") == 1
    assert peers.missed_table(operators).splitlines()[2:] == [
        "| polar_sample, 64×64, batch 8, forward, 1 thread: fast | 1.50 | 2.00 |"
    ]


def test_a_column_for_each_cpu(operators, record):
    rows = [("polar_sample", "forward", "64×64", 8), ("another", "forward", "64×64", 8)]
    assert peers.best_table({"new": operators, "old": record.timings}, rows).splitlines() == [
        "|  | new: ours (ms) | best peer | old: ours (ms) | best peer |",
        "|---|---|---|---|---|",
        "| `polar_sample`, forward, 64×64, batch 8 | 1.00 | 6.0× |  |  |",
        "| `another`, forward, 64×64, batch 8 | 1.00 | 1.0× |  |  |",
    ]
