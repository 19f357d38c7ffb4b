import pytest

from darswin.bench import memory
from darswin.bench.timing import OURS

MB = 2**20


@pytest.mark.slow
@pytest.mark.skipif(not memory.available(), reason="this system does not tell a process its peak")
def test_a_process_of_its_own_tells_its_peak():
    found = memory.measure("training", "darswin_a_nano", 32, "float32", 64, OURS, 1)
    assert (found.mode, found.batch, found.name) == ("training, float32", 64, OURS)
    assert 100 * MB < found.before < found.between < found.peak
    # Activations of 64 images, most of all those of the first map: 16 of 256 × 24 floats a block.
    assert 64 * 256 * 24 * 4 * 8 < found.own < found.whole < 1000 * MB


@pytest.mark.slow
def test_what_went_wrong_is_said():
    with pytest.raises(RuntimeError, match=r"of darswin cannot be measured(.|\n)*no_model"):
        memory.measure("training", "no_model", 32, "float32", 2, OURS, 1)
