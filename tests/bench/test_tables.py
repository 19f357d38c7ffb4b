import peers
from kit import tables
from kit.start import Start
from kit.tables import BOTH


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


def test_frames_of_a_camera(camera):
    case, frame = "`darswin_a_nano`, 64×64, float32, fixed lens", "float32, from an uint8 frame"
    assert tables.paced_table(camera).splitlines() == [
        "| p50 / p99 / CPU time, ms | darswin | peer |",
        "|---|---|---|",
        f"| {case}, 1 thread | 1 / 1.4 / 2 | 2 / 2500 / 4 |",
        f"| {case}, 2 threads | 0.9 / 2 / 1.8 | 2 / 2500 / 4 |",
        f"| {case}, default threads | 1.5 / 1.3 / 3 | 2 / 2500 / 4 |",
        f"| `darswin_a_nano`, 64×64, {frame}, 1 thread | 3 / 4 / 6 |  |",
    ]
    assert peers.frames_table(camera, ["peer"]).splitlines()[2:] == [
        "| `darswin_a_small`, 64×64, batch 1 | 0.40 | 1.00× |"
    ]
    assert peers.latency_table(camera, ["peer"]).splitlines()[2:] == [
        f"| `darswin_a_nano`, 64×64, float32 | 1.00{BOTH}0.90 | 2.00{BOTH}2.00 |"
    ]
    assert peers.camera_table(camera, ["peer"]).splitlines() == [
        "| a frame every 33 ms: p50 (p99) | `darswin_a_nano` |",
        "|---|---|",
        "| darswin | 1.50 (1.30) |",
        "| peer | 2.00 (2500.00) |",
    ]


def test_records_of_loops_alone_have_tables_too(camera):
    loops = [t for t in camera if not t.paced]
    assert tables.paced_table(loops).count("\n") == 1
    assert peers.latency_table(loops, ["peer"]).splitlines()[2:] == [
        "| `darswin_a_small`, 64×64, float32 | 0.40 | 0.50 |"
    ]
    assert peers.camera_table(loops, ["peer"]).splitlines() == [
        "| a frame in a loop: p50 (p99) | `darswin_a_small` |",
        "|---|---|",
        "| darswin | 0.40 (0.80) |",
        "| peer | 0.50 (1.00) |",
    ]


def test_first_answers():
    starts = [Start("nano", "ours", 0.256, 3 * 2**20), Start("micro", "peer", 1.0, 2**30)]
    assert tables.starts_table(starts).splitlines() == [
        "| first answer | ours | peer |",
        "|---|---|---|",
        "| `nano` | 0.26 s, 3 MB |  |",
        "| `micro` |  | 1.00 s, 1024 MB |",
    ]
