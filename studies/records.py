"""What the studies take from the kit of the benchmarks: records and tables of the same form."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))

from kit.machine import machine
from kit.record import write
from kit.tables import markdown

__all__ = ["machine", "markdown", "write"]
