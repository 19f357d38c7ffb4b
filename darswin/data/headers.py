"""Finds the files that a training could not use, before it begins."""

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from darswin.data.samples import Samples
from darswin.utils.image import BrokenImageError, Header
from darswin.utils.progress import Progress

SHOWN = 10  # faults in an error
_READ = 8  # pictures that are read whole
_AT_ONCE = 1024  # files that wait for a thread


def check_files(samples: Samples, what: str) -> None:
    """Raises one error for all pictures, targets and lenses that `samples[i]` would refuse, as far
    as the headers of the files tell.

    A file whose header or end may be damaged is read whole, and so are a few others, because
    headers do not tell the ids of labels. Broken files are no fault if `skip_broken`. `what` names
    the samples in signs of life.

    Raises:
        BrokenImageError: only broken files. ValueError: also files that do not fit each other.
    """
    count = len(samples)
    faults: list[Exception] = []
    with (
        warnings.catch_warnings(),
        ThreadPoolExecutor() as pool,  # files on a network take long to open
        Progress(f"reading the headers of {what}", count) as progress,
    ):
        warnings.filterwarnings("ignore", module=r"PIL\.")
        for start in range(0, count, _AT_ONCE):
            part = range(start, min(start + _AT_ONCE, count))
            found = pool.map(lambda k: _headers(samples, k), part)
            for index, headers in zip(part, found, strict=True):
                if index % -(-count // _READ) == 0:
                    headers = None
                try:
                    samples.check(index, headers)
                except BrokenImageError as error:
                    if not samples.skip_broken:
                        faults.append(error)
                except ValueError as error:
                    faults.append(error)
                progress.done += 1
    if len(faults) == 1:
        raise faults[0]
    if faults:
        lines = [f"{len(faults)} of {count} pictures cannot be used:", *map(str, faults[:SHOWN])]
        if len(faults) > SHOWN:
            lines.append(f"and {len(faults) - SHOWN} more")
        broken = all(isinstance(fault, BrokenImageError) for fault in faults)
        raise (BrokenImageError if broken else ValueError)("\n  ".join(lines))


def _headers(samples: Samples, index: int) -> Sequence[Header] | None:
    """The headers of a sample's files; None if one of them may be damaged."""
    try:
        found = samples.headers(index)
    except BrokenImageError:
        return None
    return found if all(header.is_sound for header in found) else None
