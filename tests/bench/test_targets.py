from kit import targets
from kit.start import Start


def test_targets(record, operators):
    assert targets.lines(record.timings) == [
        "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads: compiled reference "
        "2.10 (target 2.20) MISSED",
        "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads: matrix products alone "
        "0.90 (target 0.80)",
    ]
    assert targets.lines(operators, avx2_share=0.5) == [
        "polar_sample, 64×64, batch 8, forward, 1 thread: slow 5.00 (target 4.00); "
        "avx2 2.00 (target 2.00)",
        "polar_sample, 64×64, batch 8, forward, 1 thread: fast 1.50 (target 2.00) MISSED; "
        "avx2 0.60 (target 1.00) MISSED",
    ]
    assert targets.memory_lines(record.memory) == [
        "peak memory, training, float32, batch 8, in all: 0.80 (target 0.80)",
        "peak memory, training, float32, batch 8, of the batch itself: 0.67 (target 0.80)",
    ]


def test_our_frames_are_steady_and_cost_no_more_on_more_threads(camera):
    case = "darswin_a_nano, 64×64, batch 1, paced, float32, fixed lens"
    frame = case.replace("fixed lens", "from an uint8 frame")
    assert targets.paced_lines(camera) == [
        f"{case}, 1 thread: p50 over p99 0.71 (target 0.67)",
        f"{case}, 2 threads: p50 over p99 0.45 (target 0.67) MISSED",
        f"{case}, 2 threads: p50 on one thread 1.11 (target 0.95)",
        f"{case}, 2 threads: p99 on one thread 0.70 (target 0.95) MISSED",
        f"{case}, default threads: p50 over p99 1.15 (target 0.67)",
        f"{case}, default threads: p50 on one thread 0.67 (target 0.95) MISSED",
        f"{case}, default threads: p99 on one thread 1.08 (target 0.95)",
        f"{frame}, 1 thread: p50 over p99 0.75 (target 0.67)",
    ]


def test_first_answers():
    starts = [Start("nano", "darswin", 0.31, 50 * 2**20), Start("nano", "peer", 9.0, 2**30)]
    assert targets.start_lines(starts) == [
        "first answer, nano: darswin s 0.31 (target 0.30) MISSED",
        "first answer, nano: darswin MB 50.00 (target 60.00)",
    ]
