from darswin.bench import targets


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
