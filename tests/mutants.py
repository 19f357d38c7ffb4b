"""Measures the tests: changes one thing in the code at a time, and counts what the tests notice.

A mutant is a copy of the checkout in which one operator, constant, sign, bound or index differs.
The tests of its folder run on it until the first failure: first those of `make test`, then the
slow ones that `make test-all` adds. On the unchanged code they must pass.
`make mutants` draws the mutants with a fixed seed, so the same code gives the same mutants, and
writes tests/mutants.json. A mutant that survives shows a gap in the tests, or a change that no
result depends on. The C++ mutants are built for the generic tier alone. A stopped run continues
where it was.
"""

import argparse
import ast
import copy
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "mutants"
RECORD = ROOT / "tests" / "mutants.json"
SECONDS = 900  # for the tests of a mutant; one that takes longer is killed
NO_TESTS = 5  # pytest's exit code if it finds none
SLOW = "slow: "  # starts the result of a mutant that only slow tests notice
# The folders of tests for each folder of code, the nearest first.
TESTS = {
    "csrc": ["ops", "test_frames.py", "test_frame_networks.py", "test_frame_pictures.py"],
    "darswin/ops": ["ops", "layers"],
    "darswin/lens": ["lens", "layers", "models"],
    "darswin/layers": ["layers", "models"],
    "darswin/models": ["models", "compat", "deploy"],
    "darswin/data": ["data", "train"],
    "darswin/train": ["train"],
}


class Mutant(NamedTuple):
    """A line of a file, its text before and after the change, and the file's changed text."""

    path: str
    line: int
    before: str
    after: str
    text: str

    @property
    def name(self) -> str:
        """The key in the record."""
        return f"{self.path}:{self.line}: {self.before} → {self.after}"


SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv, ast.And: ast.Or, ast.Or: ast.And,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "sin": "cos", "cos": "sin", "floor": "ceil", "ceil": "floor"}


def changed(node: ast.AST) -> ast.AST | None:
    """The node with one change, or None where there is none to make."""
    new = copy.deepcopy(node)
    match new:
        case ast.BinOp() | ast.BoolOp() if type(new.op) in SWAPS:
            new.op = SWAPS[type(new.op)]()
        case ast.Compare(ops=[op]) if type(op) in SWAPS:
            new.ops = [SWAPS[type(op)]()]
        case ast.UnaryOp(op=ast.USub()):
            return new.operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value) | float(value)):
            new.value = value + 1 if isinstance(value, int) else value * 1.1 + 0.01
        case ast.Attribute(attr=name) if name in NAMES:
            new.attr = NAMES[name]
        case _:
            return None
    return new


def inner_nodes(node: ast.AST) -> Iterator[tuple[ast.AST, str, int | None, ast.AST]]:
    """All code below a node, with its parent and place; no annotations and no errors' texts."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        children = enumerate(value) if isinstance(value, list) else [(None, value)]
        for index, child in children:
            if isinstance(child, ast.AST) and not isinstance(child, (ast.Raise, ast.JoinedStr)):
                yield node, field, index, child
                yield from inner_nodes(child)


def python_mutants(path: str) -> Iterator[Mutant]:
    """All mutants of a Python file."""
    tree = ast.parse((ROOT / path).read_text())
    for parent, field, index, node in list(inner_nodes(tree)):
        new = changed(node)
        if new is None or (
            isinstance(node, ast.Constant)
            and isinstance(parent, ast.Assign)
            and any(getattr(t, "id", "").isupper() for t in parent.targets)
        ):
            continue  # a named constant is mostly a tuning choice
        holder = getattr(parent, field)

        def put(value: ast.AST, parent=parent, field=field, index=index, holder=holder) -> None:
            if index is None:
                setattr(parent, field, value)
            else:
                holder[index] = value

        put(new)
        text = ast.unparse(ast.fix_missing_locations(tree))
        put(node)
        yield Mutant(path, node.lineno, ast.unparse(node), ast.unparse(new), text)


# clang-format puts spaces around binary operators alone.
CPP = {
    " + ": " - ", " - ": " + ", " * ": " + ", " / ": " * ", " < ": " <= ", " <= ": " < ",
    " > ": " >= ", " >= ": " > ", " == ": " != ", " != ": " == ", " && ": " || ", " || ": " && ",
    " += ": " -= ", " -= ": " += ", "[0]": "[1]", "[1]": "[0]", " 0;": " 1;", " 1;": " 2;",
}  # fmt: skip
CPP_TOKEN = re.compile("|".join(re.escape(token) for token in CPP))
# Declarations, and what changes the speed alone.
CPP_WITHOUT = re.compile(r"#|template|static_assert|constexpr|using |fetch|omp |const [\w:<>]+ \*")


def cpp_mutants(path: str) -> Iterator[Mutant]:
    """All mutants of a C++ file."""
    lines = (ROOT / path).read_text().split("\n")
    for number, line in enumerate(lines):
        code = line.split("//")[0]
        if CPP_WITHOUT.search(code):
            continue
        for match in CPP_TOKEN.finditer(code):
            new = line[: match.start()] + CPP[match[0]] + line[match.end() :]
            text = "\n".join([*lines[:number], new, *lines[number + 1 :]])
            yield Mutant(path, number + 1, line.strip(), new.strip(), text)


def draw(folders: list[str], count: int, seed: int) -> list[Mutant]:
    """So many mutants of the code in some folders, files weighted by their number of mutants."""
    tracked = subprocess.check_output(["git", "ls-files", *folders], cwd=ROOT, text=True).split()
    mutants: list[Mutant] = []
    for path in sorted(tracked):
        if path.endswith(".py"):
            mutants.extend(python_mutants(path))
        elif path.endswith((".h", ".cpp")):
            mutants.extend(cpp_mutants(path))
    return random.Random(seed).sample(mutants, count)


def folder_of(path: str) -> str:
    """The folder of code, a key of `TESTS`, that a file is in."""
    return next(name for name in TESTS if path.startswith(name))


class Worker:
    """A copy of the checkout in which one mutant after the other is tested."""

    def __init__(self, name: str):
        self.root = FOLDER / name
        tracked = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
        shutil.rmtree(self.root, ignore_errors=True)
        for path in filter(None, tracked.split("\0")):
            target = self.root / path
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, target)
        self.copy_modules()

    def copy_modules(self) -> None:
        for module in (ROOT / "darswin").rglob("*.so"):
            shutil.copy2(module, self.root / module.relative_to(ROOT))

    def test(self, mutant: Mutant) -> str:
        """ "survived", or the reason why not: the first test that fails, "build" or "time"."""
        file = self.root / mutant.path
        before = file.read_text()
        file.write_text(mutant.text)
        try:
            if mutant.path.startswith("csrc") and not self.build():
                return "build"
            result = self.run_tests(mutant, "not slow")
            if result == "survived" and (result := self.run_tests(mutant, "slow")) != "survived":
                result = SLOW + result
            return result
        finally:
            file.write_text(before)
            if mutant.path.startswith("csrc"):
                self.copy_modules()

    def check(self, path: str) -> str:
        """The result for a file without a change: "survived" if its tests pass."""
        return self.test(Mutant(path, 0, "", "", (self.root / path).read_text()))

    def build(self) -> bool:
        """Compiles the generic tier of the copy's module."""
        environment = os.environ | {"DARSWIN_ONLY_TIER": "generic"}
        command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
        return self.call(command, environment).returncode == 0

    def run_tests(self, mutant: Mutant, marked: str) -> str:
        """The marked tests of the mutant's folder, until the first failure."""
        folder = folder_of(mutant.path)
        tests = [f"tests/{name}" for name in TESTS[folder]]
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "--tb=no", "-rfE"]
        environment = os.environ | {"PYTHONPATH": str(self.root), "OMP_NUM_THREADS": "1"}
        if folder == "csrc":  # torch, the reference, computes for the same tier
            environment["ATEN_CPU_CAPABILITY"] = "default"
        try:
            done = self.call([*command, "-m", marked, *tests], environment)
        except subprocess.TimeoutExpired:
            return "time"
        if done.returncode in (0, NO_TESTS):
            return "survived"
        failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.M)
        return failed[1] if failed else "crash"

    def call(self, command: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess:
        """A command in the copy."""
        return subprocess.run(
            command, cwd=self.root, env=environment, capture_output=True, text=True, timeout=SECONDS
        )


def main() -> None:
    """Tests the mutants that the record does not hold yet, and prints the counts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cpp", type=int, default=20, help="number of mutants of csrc/")
    parser.add_argument("--python", type=int, default=40, help="number of mutants of darswin/")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RECORD, help="record of the results")
    options = parser.parse_args()
    results: dict[str, str] = json.loads(options.out.read_text()) if options.out.exists() else {}

    def run(mutants: list[Mutant], count: int) -> None:
        """Tests so many of the mutants, without those that do not compile."""
        worker = Worker(mutants[0].path.split("/")[0])
        sound: set[str] = set()  # folders whose tests pass on the unchanged code
        for mutant in mutants:
            if count == 0:
                return
            if mutant.name not in results:
                if (folder := folder_of(mutant.path)) not in sound:
                    if (failed := worker.check(mutant.path)) != "survived":
                        sys.exit(f"a test of {folder} fails on the unchanged code: {failed}")
                    sound.add(folder)
                results[mutant.name] = worker.test(mutant)
                options.out.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
                print(f"{results[mutant.name]:60} {mutant.name}", flush=True)
            count -= results[mutant.name] != "build"

    python = draw([folder for folder in TESTS if folder != "csrc"], options.python, options.seed)
    cpp = draw(["csrc"], 2 * options.cpp, options.seed)  # some do not compile
    drawn = {mutant.name for mutant in (*python, *cpp)}  # the code may have changed since
    results = {name: result for name, result in results.items() if name in drawn}
    with ThreadPoolExecutor(2) as pool:  # the two kinds side by side, on a core each
        parts = [pool.submit(run, cpp, options.cpp), pool.submit(run, python, options.python)]
    for part in parts:
        part.result()
    tested = [result for result in results.values() if result != "build"]
    killed = [result for result in tested if result != "survived"]
    slow = sum(result.startswith(SLOW) for result in killed)
    print(f"{len(killed)} of {len(tested)} mutants killed, {slow} of them by slow tests alone")


if __name__ == "__main__":
    main()
