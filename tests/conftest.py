import os
import random
import sys
from pathlib import Path

import hypothesis
import pytest
import torch

from darswin.ops import _module, cpu_capability

ORDER = os.environ.get("DARSWIN_TEST_SEED")

# For the tests of these programs.
sys.path += [str(Path(__file__).parents[1] / name) for name in ("studies", "benchmarks")]

# Properties: the same few cases in each `make test`; `make fuzz` draws new ones.
_common = dict(deadline=None, database=None, suppress_health_check=list(hypothesis.HealthCheck))
hypothesis.settings.register_profile("test", max_examples=30, derandomize=True, **_common)
hypothesis.settings.register_profile("fuzz", max_examples=2000, print_blob=True, **_common)
hypothesis.settings.load_profile("test")


def pytest_report_header(config):
    return (
        f"darswin: tier {cpu_capability()} of {_module.tiers()}, ATEN_CPU_CAPABILITY="
        f"{os.environ.get('ATEN_CPU_CAPABILITY', '')!r}, torch {torch.__version__}, "
        f"{torch.get_num_threads()} threads, DARSWIN_TEST_SEED={ORDER or ''}"
    )


def pytest_collection_modifyitems(items):
    """With DARSWIN_TEST_SEED, a random order: of the files, and of the tests in each."""
    if ORDER:
        chance = random.Random(ORDER)
        of_file = {item.path: chance.random() for item in items}
        items.sort(key=lambda item: (of_file[item.path], chance.random()))


@pytest.fixture(scope="session", autouse=True)
def inductor_cache(tmp_path_factory):
    """An empty cache of compiled graphs: inductor's own is kept from run to run, and a graph made
    for one ATEN_CPU_CAPABILITY does not compile under another."""
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(tmp_path_factory.mktemp("inductor"))


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def threads():
    """Sets torch's number of threads; the test's end restores it."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def other_rounding():
    """With DARSWIN_TEST_ROUNDING, torch rounds as no CPU does: see rounding.py."""
    if "DARSWIN_TEST_ROUNDING" not in os.environ:
        yield
        return
    from rounding import Rounded

    with Rounded():
        yield
