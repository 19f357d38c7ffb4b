"""Runs a study's parts side by side, one on each core."""

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import cv2
import torch
from tqdm import tqdm


def run_all(
    work: Callable[..., dict], jobs: Sequence[tuple], processes: int, unit: str
) -> list[dict]:
    """What `work` returns for the arguments of each job, in the order in which they end."""
    os.environ["OMP_NUM_THREADS"] = "1"  # of the new processes, from their start
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, use_one_core) as pool:
        started = [pool.submit(work, *job) for job in jobs]
        ended = tqdm(as_completed(started), total=len(started), unit=unit)
        return [job.result() for job in ended]


def use_one_core() -> None:
    """Two jobs side by side are faster than one on two cores."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@contextlib.contextmanager
def printing_to(path: Path) -> Iterator[None]:
    """Appends what is printed within it to a file."""
    with path.open("a") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        yield
