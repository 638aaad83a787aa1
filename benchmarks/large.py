"""Time and memory of a dome scan of 1 to 28 million cells: read, registered, coloured and written, stage by stage.

Run it as `python -m benchmarks.large [FOLDER] [--cells 1 4 10 28]`. The scans are made by `benchmarks.shared.dome` in
the folder, unless they are there already. Every size runs in a fresh process on at most two cores. Reading by pye57
alone is measured in another process just before. Times are of the processor (user and system), since other programs may
be running; wall-clock time and load are printed beside them. The exponent of a stage is the slope of log time over log
cells from the smallest to the largest scan.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

MAX_SECONDS, MAX_BYTES, MAX_READ_FACTOR, MAX_KEPT_FACTOR = 60.0, 2e9, 1.3, 1.5
STAGES = ("read", "register", "colour", "registered.png", "cloud.ply", "model.glb")

T = TypeVar("T")


class Stages:
    """Time and peak memory of stages of this process."""

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, float]] = {}
        self._peak = 0.0
        threading.Thread(target=self._watch, daemon=True).start()

    def run(self, name: str, work: Callable[[], T]) -> T:
        """Do some work as a stage."""
        self._peak = 0.0
        cpu, wall = time.process_time(), time.perf_counter()
        result = work()
        self.rows[name] = {
            "cpu_s": time.process_time() - cpu,
            "wall_s": time.perf_counter() - wall,
            "peak_bytes": max(self._peak, resident_bytes()),
        }
        return result

    def _watch(self) -> None:
        while True:
            self._peak = max(self._peak, resident_bytes())
            time.sleep(0.01)


def resident_bytes() -> float:
    """Return the resident memory of this process, bytes."""
    return float(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


def chain(folder: Path) -> dict[str, Any]:
    """Read, register and write one dome; return the figures."""
    from ladarreg.process_resources import keep_heap_small

    import ladarreg_core as lr
    from ladarreg_core.export.clouds.ply import write_ply
    from ladarreg_core.export.models.glb import write_model_glb
    from ladarreg_core.export.pictures.images import write_registered_png
    from ladarreg_core.formats.documents.pose_file import read_pose
    from ladarreg_core.surface.texture.photo_model import ModelPhoto, photo_model
    from ladarreg_core.surface.texture.registered_texture import texture_scan

    import_module("pye57")  # as loading it is no part of reading, on either side
    idle = resident_bytes()
    stages, progress = Stages(), []
    started = time.perf_counter()
    scan = stages.run("read", lambda: lr.read_scan(
        folder / "scan.e57", report=lambda _: progress.append(time.perf_counter() - started)
    ))  # fmt: skip
    kept = (
        scan.ranges.nbytes + scan.intensity.nbytes + scan.rays.nbytes + (0 if scan.color is None else scan.color.nbytes)
    )
    keep_heap_small()  # as the command `register` does
    photo = lr.read_photo(folder / "photo.png", camera=folder / "camera.json")
    found = stages.run("register", lambda: lr.register(scan, photo))
    pose, truth = found.camera_from_scanner, read_pose(folder / "truth.json")
    with tempfile.TemporaryDirectory() as out:
        texture = stages.run("colour", lambda: texture_scan(
            scan, photo, pose, camera=found.camera, covariance=found.joint_covariance
        ))  # fmt: skip
        stages.run("registered.png", lambda: write_registered_png(Path(out, "registered.png"), texture))
        stages.run("cloud.ply", lambda: write_ply(Path(out, "cloud.ply"), scan, texture))

        def model() -> tuple[int, float]:
            made = photo_model(scan, [ModelPhoto(photo.pixels, found.camera, pose, texture.labels)])
            write_model_glb(Path(out, "model.glb"), made)
            return made.faces, made.tolerance_m

        faces, tolerance_m = stages.run("model.glb", model)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "stages": stages.rows,
        "cells": scan.ranges.size,
        "kept_bytes": kept,
        "idle_bytes": idle,
        "first_progress_s": progress[0] if progress else None,
        "accepted": found.accepted,
        "error_deg": float(np.degrees(pose.angle_to(truth))),
        "error_mm": float(1000 * pose.distance_to(truth)),
        "faces": faces,
        "tolerance_mm": 1000 * tolerance_m,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "wall_s": time.perf_counter() - started,
        "peak_bytes": usage.ru_maxrss * 1024,
    }


def alone(folder: Path) -> dict[str, Any]:
    """Read the same fields by pye57 alone."""
    import pye57

    cpu = time.process_time()
    pye57.E57(str(folder / "scan.e57")).read_scan_raw(0)
    return {"cpu_s": time.process_time() - cpu}


def in_child(what: str, folder: Path) -> dict[str, Any]:
    """Run `chain` or `alone` in a fresh process on at most two cores."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    command = [sys.executable, "-m", "benchmarks.large", str(folder), "--child", what]
    child = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.sched_setaffinity(0, cores)
    )
    figures: dict[str, Any] = json.loads(child.stdout.splitlines()[-1])
    return figures


def measure(folder: Path, sizes: list[float]) -> None:
    """Measure all sizes and print the tables."""
    from benchmarks.shared.dome import dome_shape, make_dome

    results = []
    for size in sizes:
        home = folder / f"dome_{size:g}"
        if not (home / "truth.json").exists():
            make_dome(home, dome_shape(1e6 * size))
        by_pye57 = in_child("alone", home)["cpu_s"]
        found = in_child("chain", home)
        results.append(found)
        read = found["stages"]["read"]
        kept = (read["peak_bytes"] - found["idle_bytes"]) / found["kept_bytes"]
        print(f"\n{found['cells'] / 1e6:.1f} M cells, load {os.getloadavg()[0]:.1f}")
        print(f"  {'stage':<16}{'processor':>10}{'wall':>9}{'peak':>10}")
        for name, row in found["stages"].items():
            print(f"  {name:<16}{row['cpu_s']:8.2f} s{row['wall_s']:7.2f} s{row['peak_bytes'] / 1e6:7.0f} MB")
        print(f"  {'all':<16}{found['cpu_s']:8.2f} s{found['wall_s']:7.2f} s{found['peak_bytes'] / 1e6:7.0f} MB")
        print(
            f"  accepted {found['accepted']}, {found['error_deg']:.3f} deg and {found['error_mm']:.1f} mm off the truth"
        )
        print(f"  model of {found['faces']:,} triangles, reduced to an error of {found['tolerance_mm']:.1f} mm")
        print(f"  reading: {read['cpu_s'] / by_pye57:.2f} x pye57 alone ({by_pye57:.2f} s; asked: {MAX_READ_FACTOR})")
        print(f"  reading: peak {kept:.2f} x the arrays kept (asked: {MAX_KEPT_FACTOR})")
        print(f"  first progress after {found['first_progress_s']:.2f} s")
    last = results[-1]
    print(f"\nasked of the largest: {MAX_SECONDS:.0f} s and {MAX_BYTES / 1e9:.0f} GB")
    print(f"reached: {last['wall_s']:.0f} s ({last['cpu_s']:.0f} s of processor), {last['peak_bytes'] / 1e9:.2f} GB")
    if len(results) > 1:
        spread = np.log(last["cells"] / results[0]["cells"])
        print("growth of the processor time with the number of cells, exponent:")
        for name in STAGES:
            ratio = last["stages"][name]["cpu_s"] / max(results[0]["stages"][name]["cpu_s"], 1e-3)
            print(f"  {name:<16}{np.log(ratio) / spread:6.2f}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--cells", type=float, nargs="+", default=[1.0, 4.0, 10.0, 28.0], help="millions")
    parser.add_argument("--child", choices=("chain", "alone"))
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(chain(arguments.folder) if arguments.child == "chain" else alone(arguments.folder)))
    elif arguments.folder:
        measure(arguments.folder, arguments.cells)
    else:
        with tempfile.TemporaryDirectory() as folder:
            measure(Path(folder), arguments.cells)


if __name__ == "__main__":
    main()
