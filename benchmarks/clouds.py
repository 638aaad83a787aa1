"""Time and memory of reading clouds without a grid: LAS and LAZ beside laspy alone, and accumulated sweeps.

`python -m benchmarks.clouds [MILLIONS]` writes a simulated accumulation as LAS and LAZ and reads it in new processes.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.las import read_las_columns
from testing.scenes.simulated_clouds import brightness, in_room, rosette

ORIGIN = (691_234.4, 5_334_321.4, 520.5)


def main(millions: float) -> None:
    """Print a row for each file and way of reading it."""
    with tempfile.TemporaryDirectory(prefix="clouds-") as name:
        for suffix in ("las", "laz"):
            file = Path(name) / f"cloud.{suffix}"
            # Written in a process of its own, too: a child's peak memory counts from that of its parent.
            for how in (f"write {int(millions * 1e6)}", "laspy", "columns", "scan"):
                subprocess.run([sys.executable, "-m", "benchmarks.clouds", how, str(file)], check=True)


def _write(file: Path, count: int) -> None:
    points = in_room(rosette(count))
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = [1e-4] * 3, np.array([691_234.0, 5_334_321.0, 519.0])
    data = laspy.LasData(header)
    data.x, data.y, data.z = (points + header.offsets).T
    data.intensity = data.red = data.green = data.blue = (200 * brightness(points)).clip(0, 65_535).astype(np.uint16)
    data.write(file)


def _measure(how: str, file: Path) -> None:
    if how.startswith("write "):
        return _write(file, int(how[6:]))
    start, busy, idle = time.perf_counter(), time.process_time(), _peak_gb()
    if how == "laspy":
        data = laspy.read(file)
        kept = [np.stack([data.x, data.y, data.z], -1), np.asarray(data.intensity),
                np.stack([data.red, data.green, data.blue], -1)]  # fmt: skip
        what = f"{len(kept[0]):,} points"
    elif how == "columns":
        points, _, _ = read_las_columns(file)
        what = f"{len(points):,} points"
    else:
        scan = read_scan(file, origin=ORIGIN)
        what = f"{scan.shape[0]} x {scan.shape[1]} cells"
    print(
        f"{file.suffix[1:]:4} {how:8} {time.perf_counter() - start:6.2f} s, {time.process_time() - busy:6.2f} s of "
        f"processor, peak {_peak_gb() - idle:.2f} GB above idle: {what}",
        flush=True,
    )
    return None


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


if __name__ == "__main__":
    if len(sys.argv) > 2:
        _measure(sys.argv[1], Path(sys.argv[2]))
    else:
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 10)
