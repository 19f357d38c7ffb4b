"""Signs of life from long steps."""

import sys
import threading
import time
from typing import Self

EVERY = 10.0  # s


class Progress:
    """A context that tells on stderr, every ten seconds, that a step is still at work.

    Shorter steps print nothing. If the step has `count` equal parts, it adds to `done` as they end.
    """

    def __init__(self, step: str, count: int | None = None):
        self.step, self.count, self.done = step, count, 0
        self._start, self._ended = time.monotonic(), threading.Event()
        self._thread = threading.Thread(target=self._print, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    def _print(self) -> None:
        while not self._ended.wait(EVERY):
            parts = "" if self.count is None else f"{self.done} of {self.count}, "
            seconds = time.monotonic() - self._start
            print(f"darswin: {self.step}: {parts}{seconds:.0f} s", file=sys.stderr, flush=True)
