"""Records of what was measured, as JSON files."""

import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from darswin.bench.memory import Memory
from darswin.bench.timing import Timing
from darswin.utils.files import replace_file


@dataclass
class Record:
    """All that one run of a benchmark found.

    Args:
        machine: as `darswin.bench.machine.machine` has it. operations: floating-point operations
            of a model's matrix products for one image. autotune: rows of
            `darswin.layers.linear.autotune_results`.
    """

    machine: dict
    timings: list[Timing]
    memory: list[Memory] = field(default_factory=list)
    operations: int = 0
    autotune: list[dict] = field(default_factory=list)

    def save(self, path: Path) -> None:
        """Writes what is in it."""
        content = asdict(self, dict_factory=_known)
        write(path, **{key: value for key, value in content.items() if value})

    @classmethod
    def load(cls, path: Path) -> "Record":
        """What `save` wrote."""
        content = json.loads(path.read_text())
        content["timings"] = [Timing(**row) for row in content["timings"]]
        content["memory"] = [Memory(**row) for row in content.get("memory", ())]
        return cls(**content)

    def publish(self, folder: Path, suite: str, draw: Callable[["Record", Path], None]) -> None:
        """Writes `SUITE--CPU-TIER.json` and, with matplotlib, its plot; prints their names."""
        cpu = f"{self.machine['cpu']} {self.machine['tier']}".lower()
        cpu = re.sub(r"\b(family|model|processor|cpu)\b", " ", cpu)
        path = folder / f"{suite}--{'-'.join(re.findall('[a-z0-9]+', cpu))}.json"
        self.save(path)
        print(path)
        try:
            draw(self, path.with_suffix(".png"))
            print(path.with_suffix(".png"))
        except ImportError as error:
            print(f"no plot: {error}", file=sys.stderr)


def _known(items: Iterable[tuple[str, object]]) -> dict[str, object]:
    return {key: value for key, value in items if value is not None}


def write(path: Path, **content: object) -> None:
    """Writes a record of any content as JSON, a line for each row of its lists and objects."""
    parts = [f" {json.dumps(key)}: {_lines(value)}" for key, value in content.items()]
    replace_file(path, "{\n" + ",\n".join(parts) + "\n}\n")


def _lines(value: object) -> str:
    if isinstance(value, dict):
        rows = [
            f"  {json.dumps(key)}: {json.dumps(row, allow_nan=False)}" for key, row in value.items()
        ]
        return "{\n" + ",\n".join(rows) + "\n }"
    if isinstance(value, list):
        return "[\n" + ",\n".join(f"  {json.dumps(row, allow_nan=False)}" for row in value) + "\n ]"
    return json.dumps(value, allow_nan=False)
