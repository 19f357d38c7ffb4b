"""Finds the files that a training could not use, before it begins."""

import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

from darswin.data.samples import Samples
from darswin.utils.image import BrokenImageError, Header
from darswin.utils.progress import Progress
from darswin.utils.words import counted

SHOWN = 10  # faults in an error
_READ = 8  # pictures that are read whole
_AT_ONCE = 1024  # files that wait for a thread


def check_files(parts: Mapping[str, Samples]) -> dict[str, int]:
    """Raises one error for all pictures, targets and lenses that `samples[i]` would refuse, as far
    as the headers of the files tell.

    A file whose header or end may be damaged is read whole. Headers do not tell the ids of labels,
    so a few other files are read whole too, and all of them if these have a fault. Broken files are
    no fault if `skip_broken`.

    Args:
        parts: the samples by names for the signs of life.

    Returns:
        The number of broken files of each part, as far as they are known: with `skip_broken` they
        are left out.

    Raises:
        BrokenImageError: only broken files. ValueError: also files that do not fit each other.
    """
    found = {what: _faults(samples, what) for what, samples in parts.items()}
    faults = [fault for what in parts for fault in found[what] if _counts(parts[what], fault)]
    if len(faults) == 1:
        raise faults[0]
    if faults:
        count = sum(map(len, parts.values()))
        lines = [
            f"{len(faults)} of {counted(count, 'picture')} cannot be used:",
            *map(str, faults[:SHOWN]),
        ]
        if len(faults) > SHOWN:
            lines.append(f"and {len(faults) - SHOWN} more")
        broken = all(isinstance(fault, BrokenImageError) for fault in faults)
        raise (BrokenImageError if broken else ValueError)("\n  ".join(lines))
    return {what: len(left_out) for what, left_out in found.items()}


def _faults(samples: Samples, what: str) -> list[Exception]:
    """The errors of samples that cannot be used or are left out."""
    count = len(samples)
    faults: list[Exception] = []
    with (
        warnings.catch_warnings(),
        ThreadPoolExecutor() as pool,  # files on a network take long to open
        Progress(f"reading the headers of {what}", count) as progress,
    ):
        warnings.filterwarnings("ignore", module=r"PIL\.")
        some = range(0, count, -(-count // _READ) or 1)
        read = {k: _fault(samples, k, None) for k in some}
        hidden = any(
            _counts(samples, read[k]) and not _fault(samples, k, _headers(samples, k)) for k in some
        )
        for start in range(0, count, _AT_ONCE):
            part = range(start, min(start + _AT_ONCE, count))
            found = pool.map(lambda k: None if hidden else _headers(samples, k), part)
            for index, headers in zip(part, found, strict=True):
                fault = read[index] if index in read else _fault(samples, index, headers)
                faults += [] if fault is None else [fault]
                progress.done += 1
    return faults


def _fault(
    samples: Samples, index: int, headers: Sequence[Header] | None
) -> BrokenImageError | ValueError | None:
    """The error of a sample that cannot be used; None for `headers` reads its files whole."""
    try:
        samples.check(index, headers)
    except (BrokenImageError, ValueError) as error:
        return error
    return None


def _counts(samples: Samples, fault: Exception | None) -> bool:
    """True for an error, unless it is about a broken file that is left out."""
    return fault is not None and not (samples.skip_broken and isinstance(fault, BrokenImageError))


def _headers(samples: Samples, index: int) -> Sequence[Header] | None:
    """The headers of a sample's files; None if one of them may be damaged."""
    try:
        found = samples.headers(index)
    except BrokenImageError:
        return None
    return found if all(header.is_sound for header in found) else None
