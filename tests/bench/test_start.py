import sys

import pytest

from darswin.bench.start import measure


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the memory in /proc")
def test_a_program_tells_its_time_and_memory():
    small = measure("nothing", "python", "import time; time.sleep(0.05)", processes=3)
    large = measure("nothing", "python", "block = bytearray(range(250)) * 400_000", processes=1)
    assert (small.subject, small.name) == ("nothing", "python")
    assert small.seconds >= 0.05
    assert 90e6 < large.resident - small.resident < 110e6


def test_what_went_wrong_is_said():
    with pytest.raises(
        RuntimeError, match=r"start of a runtime cannot be measured(.|\n)*no_module"
    ):
        measure("model", "a runtime", "import no_module")
