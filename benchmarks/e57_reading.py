"""The raw records of E57 files, read by our reader and by pye57 in turn: `python -m benchmarks.e57_reading`.

Files of several kinds are written by pye57's raw nodes: the fields of a terrestrial scanner in single precision, scaled
whole numbers of 24 bits, and double precision. Both readers fill the same arrays, chunk by chunk, and compare the
checksum of every page. Each is the first in every second round; the ratio is the median over the rounds of our
processor time by pye57's.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.formats.e57.records import read_records
from ladarreg_core.formats.e57.tree import open_e57

_AT_ONCE = 131_072
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_SCALE_M = 1e-5

Buffers = dict[str, NDArray[Any]]


def write_file(path: Path, kind: str, points: int) -> None:
    """Write a scan.

    Args:
        path: the new file.
        kind: `single`, `scaled` or `double`.
        points: their number.
    """
    from pye57 import libe57

    file = libe57.ImageFile(str(path), "w")
    scans, scan, prototype = libe57.VectorNode(file, True), libe57.StructureNode(file), libe57.StructureNode(file)
    file.root().set("data3D", scans)
    random = np.random.default_rng(0)
    columns: Buffers = {}
    for name in ("cartesianX", "cartesianY", "cartesianZ"):
        if kind == "scaled":
            prototype.set(name, libe57.ScaledIntegerNode(file, 0, -(2**23), 2**23 - 1, _SCALE_M, 0.0))
            columns[name] = random.integers(-(2**23), 2**23, points).astype("q")
        else:
            precision = libe57.E57_SINGLE if kind == "single" else libe57.E57_DOUBLE
            prototype.set(name, libe57.FloatNode(file, 0.0, precision))
            columns[name] = random.normal(0, 9, points).astype("f" if kind == "single" else "d")
    bits = {"rowIndex": 12, "columnIndex": 13, "cartesianInvalidState": 2} | dict.fromkeys(_COLORS, 8)
    for name, width in bits.items():
        prototype.set(name, libe57.IntegerNode(file, 0, 0, 2**width - 1))
        columns[name] = random.integers(0, 2**width, points).astype("q")
    prototype.set("intensity", libe57.FloatNode(file, 0.0, libe57.E57_SINGLE))
    columns["intensity"] = random.random(points).astype("f")
    records = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set("points", records)
    scans.append(scan)
    buffers = libe57.VectorSourceDestBuffer()
    for index in range(prototype.childCount()):
        name = prototype[index].elementName()
        buffers.append(libe57.SourceDestBuffer(file, name, columns[name], points, True, False))
    writer = records.writer(buffers)
    writer.write(points)
    writer.close()
    file.close()


def buffers_for(kind: str) -> Buffers:
    """Return arrays for a chunk of raw values."""
    real = {"single": "f", "scaled": "q", "double": "d"}[kind]
    codes = dict.fromkeys(("cartesianX", "cartesianY", "cartesianZ"), real) | {"intensity": "f"}
    codes |= dict.fromkeys(("rowIndex", "columnIndex", "cartesianInvalidState", *_COLORS), "q")
    return {name: np.zeros(_AT_ONCE, code) for name, code in codes.items()}


def by_us(path: Path, buffers: Buffers) -> int:
    """Read all records; return their number."""
    with open_e57(path) as file:
        points = file.scan(0).child("points")
        assert points is not None
        return sum(read_records(file.pages, points, buffers, "the scan", scaled=False))


def by_pye57(path: Path, buffers: Buffers) -> int:
    """Read all records; return their number."""
    from pye57 import libe57

    file = libe57.ImageFile(str(path), "r")
    bound = libe57.VectorSourceDestBuffer()
    for name, values in buffers.items():
        bound.append(libe57.SourceDestBuffer(file, name, values, len(values), True, False))
    reader = file.root()["data3D"][0]["points"].reader(bound)
    total = 0
    while count := reader.read():
        total += count
    reader.close()
    file.close()
    return total


def measure(path: Path, kind: str, rounds: int) -> tuple[float, float, float]:
    """Return the median processor seconds of our reader and of pye57, and the median of their ratios."""
    buffers = buffers_for(kind)
    times: dict[Callable[[Path, Buffers], int], list[float]] = {by_us: [], by_pye57: []}
    for number in range(rounds):
        for reader in (by_us, by_pye57) if number % 2 else (by_pye57, by_us):
            began = time.process_time()
            reader(path, buffers)
            times[reader].append(time.process_time() - began)
    ratios = [ours / theirs for ours, theirs in zip(times[by_us], times[by_pye57], strict=True)]
    return statistics.median(times[by_us]), statistics.median(times[by_pye57]), statistics.median(ratios)


def main() -> None:
    """Write the files, read them in turn and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("single", "scaled", "double"):
            path = Path(folder) / f"{kind}.e57"
            write_file(path, kind, asked.points)
            ours, theirs, ratio = measure(path, kind, asked.rounds)
            size = path.stat().st_size / 1e6
            sys.stdout.write(
                f"{kind:7} {asked.points:,} points, {size:.0f} MB: ours {ours:.3f} s, pye57 {theirs:.3f} s, "
                f"ratio {ratio:.2f}\n"
            )


if __name__ == "__main__":
    main()
