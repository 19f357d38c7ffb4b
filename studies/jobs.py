"""Runs the jobs of a study side by side, one on each core."""

import argparse
import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import cv2
import torch
from tqdm import tqdm


def run_all(
    work: Callable[..., dict], jobs: Sequence[tuple], processes: int, unit: str
) -> list[dict]:
    """The results of `work` for the arguments of each job, in the order in which they end.

    If this process is killed, its jobs end too: they must not write beside those of a later run.
    """
    os.environ["OMP_NUM_THREADS"] = "1"  # the new processes read it when they start
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _start) as pool:
        started = [pool.submit(work, *job) for job in jobs]
        ended = tqdm(as_completed(started), total=len(started), unit=unit)
        return [job.result() for job in ended]


def add_options(parser: argparse.ArgumentParser, study: str) -> None:
    """Adds the options that say which cells of a study run, and where their files are."""
    parser.add_argument("--cell", help="runs only cells whose key contains this text")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument(
        "--known", type=Path, help=f"a record ({study}.json); its cells are not run again"
    )
    parser.add_argument(
        "--collect", action="store_true", help="runs nothing and collects existing results"
    )
    parser.add_argument("--out", type=Path, default=Path("out") / study)
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")


def key_of(text: str) -> str:
    """The name of a file for a cell with this description."""
    return "-".join("".join(c if c.isalnum() else " " for c in text.lower()).split())


def check_given(earlier: dict, given: dict, name: object) -> None:
    """Checks that the results in `name` come from the same settings."""
    others = [key for key in earlier | given if earlier.get(key) != given.get(key)]
    if others:
        raise ValueError(
            f"{name} was made with other settings ({', '.join(others)}): remove it, or use its own"
        )


def use_one_core() -> None:
    """Makes the process use one core; two jobs side by side are faster than one on two cores."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _start() -> None:
    use_one_core()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_it() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()


@contextlib.contextmanager
def printing_to(path: Path) -> Iterator[None]:
    """A context that appends all printed text to a file."""
    with path.open("a") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        yield
