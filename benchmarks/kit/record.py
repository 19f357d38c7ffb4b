"""Records of measurements, as JSON files."""

import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from darswin.utils.files import replace_file
from kit.memory import Memory
from kit.start import Start
from kit.timing import Timing


@dataclass
class Record:
    """The results of one run of a benchmark."""

    machine: dict  # of `kit.machine`
    timings: list[Timing]
    memory: list[Memory] = field(default_factory=list)
    starts: list[Start] = field(default_factory=list)  # of programs without torch
    operations: int = 0  # of floating point, in a model's matrix products for one image

    def save(self, path: Path) -> None:
        content = asdict(self, dict_factory=_known)
        write(path, **{key: value for key, value in content.items() if value})

    @classmethod
    def load(cls, path: Path) -> "Record":
        content = json.loads(path.read_text())
        content["timings"] = [Timing(**row) for row in content["timings"]]
        content["memory"] = [Memory(**row) for row in content.get("memory", ())]
        content["starts"] = [Start(**row) for row in content.get("starts", ())]
        return cls(**content)

    def publish(
        self, folder: Path, suite: str, draw: Callable[["Record", Path], None] | None
    ) -> None:
        """Writes `SUITE--CPU-TIER.json` and, with matplotlib, its plot if it has one; prints the
        names."""
        cpu = slug(f"{self.machine['cpu']} {self.machine['tier']}")
        path = folder / f"{suite}--{cpu}.json"
        self.save(path)
        print(path)
        if draw is None:
            return
        try:
            draw(self, path.with_suffix(".png"))
            print(path.with_suffix(".png"))
        except ImportError as error:
            print(f"no plot: {error}", file=sys.stderr)


def slug(device: str) -> str:
    """The name of a CPU or another device, for the names of files."""
    words = re.findall("[a-z0-9]+", device.lower())
    return "-".join(w for w in words if w not in ("family", "model", "processor", "cpu"))


def _known(items: Iterable[tuple[str, object]]) -> dict[str, object]:
    return {key: value for key, value in items if value is not None}


def write(path: Path, **content: object) -> None:
    """Writes any content as JSON, with one line for each row of its lists and objects."""
    parts = [f" {json.dumps(key)}: {_lines(value)}" for key, value in content.items()]
    replace_file(path, "{\n" + ",\n".join(parts) + "\n}\n")


def _lines(value: object) -> str:
    dumps = partial(json.dumps, allow_nan=False)
    if isinstance(value, dict):
        rows = [f"  {dumps(key)}: {dumps(row)}" for key, row in value.items()]
        return "{\n" + ",\n".join(rows) + "\n }"
    if isinstance(value, list):
        return "[\n" + ",\n".join(f"  {dumps(row)}" for row in value) + "\n ]"
    return dumps(value)
