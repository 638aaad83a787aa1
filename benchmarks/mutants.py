"""What the tests notice: small random faults are put into the program one at a time, and the tests that reach them run.

    pip install pytest-cov
    python -m pytest --cov=ladarreg_core --cov=app --cov-context=test --junitxml=durations.xml --long=all
    python -m benchmarks.mutants .coverage durations.xml --count 200

A fault is killed if a test of `make test` fails. Where none does, the long tests that reach it run as well: what only
they kill is the price of leaving them out. Faults are put into functions: what runs at an import, every test reaches.
No context tells which test reaches a line through another process; such lines are counted.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from xml.etree import ElementTree

CHECKOUT = Path(__file__).parents[1]
PACKAGES = ("ladarreg_core", "app")
MAX_TESTS = 60
"""Of those that reach a fault, the quickest; others repeat what these do."""
LONGEST_S = 240.0
SWAPPED: dict[type[ast.AST], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.Add: "-", ast.Sub: "+",
    ast.Mult: "/", ast.Div: "*", ast.And: "or", ast.Or: "and", ast.Is: "is not", ast.IsNot: "is",
}  # fmt: skip
SYMBOLS: dict[type[ast.AST], str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Add: "+", ast.Sub: "-",
    ast.Mult: "*", ast.Div: "/", ast.And: "and", ast.Or: "or", ast.Is: "is", ast.IsNot: "is not",
}  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """A replacement of text on one line of a file."""

    file: str
    line: int
    start: int
    end: int
    text: str

    def apply(self, folder: Path) -> str:
        """Write the faulty file; return the text of the sound one."""
        path = folder / self.file
        sound = path.read_text()
        lines = sound.splitlines(keepends=True)
        raw = lines[self.line - 1].encode()  # columns of syntax trees count bytes
        lines[self.line - 1] = (raw[: self.start] + self.text.encode() + raw[self.end :]).decode()
        path.write_text("".join(lines))
        return sound


def faults_of(file: str, source: str) -> Iterator[Fault]:
    """Yield the possible faults of a file: operators swapped, numbers changed, conditions and truth values inverted."""
    lines = source.splitlines()

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[Fault]:
        symbol = SYMBOLS.get(type(operator))
        if symbol is None or left.end_lineno != right.lineno:
            return
        begin, end = left.end_col_offset or 0, right.col_offset
        at = lines[right.lineno - 1].encode()[begin:end].decode().find(symbol)
        if at >= 0:
            yield Fault(file, right.lineno, begin + at, begin + at + len(symbol), SWAPPED[type(operator)])

    tree = ast.parse(source)
    bodies = [s for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) for s in node.body]
    for node in {id(node): node for statement in bodies for node in ast.walk(statement)}.values():
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], node.ops[0])
        elif isinstance(node, ast.BinOp):
            yield from between(node.left, node.right, node.op)
        elif isinstance(node, ast.BoolOp):
            yield from between(node.values[0], node.values[1], node.op)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield Fault(file, node.lineno, node.col_offset, node.col_offset + len("not "), "")
        elif isinstance(node, ast.Constant) and node.end_lineno == node.lineno and node.end_col_offset is not None:
            place = (file, node.lineno, node.col_offset, node.end_col_offset)
            if isinstance(node.value, bool):
                yield Fault(*place, str(not node.value))
            elif isinstance(node.value, int):
                yield Fault(*place, str(node.value + 1))
            elif isinstance(node.value, float):
                yield Fault(*place, repr(node.value * 1.5 if node.value else 1.0))


class Reached:
    """Which tests reach a line, quickest first, from the data of a measured run."""

    def __init__(self, data: Path, durations: Path) -> None:
        self._rows = sqlite3.connect(data, check_same_thread=False)
        self._contexts = dict(self._rows.execute("select id, context from context"))
        self._files = {path: number for number, path in self._rows.execute("select id, path from file")}
        self.seconds: dict[str, float] = {}
        for case in ElementTree.parse(durations).getroot().iter("testcase"):
            name = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
            self.seconds[name] = float(case.get("time", "0"))

    def lines(self, file: str) -> dict[int, set[str]]:
        """Return the tests that reach each line of a file; another process is the test without a name."""
        number = next((n for path, n in self._files.items() if path.endswith(f"/{file}")), None)
        found: dict[int, set[str]] = {}
        for context, bits in self._rows.execute(
            "select context_id, numbits from line_bits where file_id = ?", [number]
        ):
            test = self._contexts[context].split("|")[0]
            for k, byte in enumerate(bits):
                for bit in range(8):
                    if byte >> bit & 1:
                        found.setdefault(8 * k + bit, set()).add(test)
        return found


class Copy:
    """A copy of the project in which faults are tried."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=CHECKOUT, capture_output=True, check=True, text=True)
        for name in tracked.stdout.split("\0"):
            if (CHECKOUT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(CHECKOUT / name, folder / name)
        (folder / "imports").mkdir()
        (folder / "imports" / "ladarreg").symlink_to(folder / "app")

    def fails(self, tests: Sequence[str]) -> bool:
        """Return whether one of the tests fails, or they never end."""
        paths = os.pathsep.join(map(str, (self.folder / "imports", self.folder)))
        try:
            done = subprocess.run(
                [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--timeout=100", "--long=all",
                 *tests],
                cwd=self.folder, capture_output=True, timeout=LONGEST_S,
                env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return True
        return done.returncode != 0


def collected(*words: str) -> set[str]:
    """Return the tests that pytest selects, long ones among them."""
    listed = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "--long=all", *words],
        cwd=CHECKOUT, capture_output=True, text=True,
    )  # fmt: skip
    return {line for line in listed.stdout.splitlines() if "::" in line}


def fate(fault: Fault, tests: set[str], long: set[str], seconds: dict[str, float], copy: Copy) -> str:
    """Return what becomes of a fault: who kills it, if anybody."""
    if not tests - {""}:
        return "reached by another process" if tests else "not reached"

    def quickest(names: set[str]) -> list[str]:
        return sorted(names, key=lambda name: seconds.get(name, 1.0))[:MAX_TESTS]

    sound = fault.apply(copy.folder)
    try:
        named = tests - {""}
        if (short := quickest(named - long)) and copy.fails(short):
            return "killed"
        return "killed by long tests alone" if named & long and copy.fails(quickest(named & long)) else "survives"
    finally:
        (copy.folder / fault.file).write_text(sound)


def main() -> None:
    """Print how many faults are killed by whom."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("coverage", type=Path, help="data of a run with --cov-context=test")
    parser.add_argument("durations", type=Path, help="JUnit file of the same run")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()

    reached = Reached(given.coverage, given.durations)
    there, long = collected() | {""}, collected("-m", "long")
    files = [path for package in PACKAGES for path in sorted((CHECKOUT / package).rglob("*.py"))]
    faults = [fault for path in files for fault in faults_of(str(path.relative_to(CHECKOUT)), path.read_text())]
    faults = random.Random(given.seed).sample(faults, given.count)
    fates: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(given.workers) as pool:
        copies: Queue[Copy] = Queue()
        for number in range(given.workers):
            copies.put(Copy(Path(temporary) / str(number)))

        def tried(fault: Fault) -> str:
            copy = copies.get()
            try:
                tests = reached.lines(fault.file).get(fault.line, set()) & there  # others have been renamed since
                return fate(fault, tests, long, reached.seconds, copy)
            finally:
                copies.put(copy)

        for fault, found in zip(faults, pool.map(tried, faults), strict=True):
            fates[found] += 1
            print(f"{found:26} {fault.file}:{fault.line} {fault.text!r}", flush=True)
    print("  ".join(f"{name}: {count}" for name, count in fates.most_common()))


if __name__ == "__main__":
    main()
