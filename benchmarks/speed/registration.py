"""Rows of `benchmarks.speed` on whole registrations, against SIFT, matching and RANSAC of the same pictures."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import ladarreg_core as lr
from benchmarks.matching.peers import by_sift
from benchmarks.speed.clock import Duration, Measure, compared, in_turn
from ladarreg_core.simulate import SCENES, SimulatedCase, simulate_case
from ladarreg_core.simulate.case import write_case

_SEEDS, _TIMES = 3, 3
_QUICK_CASES, _QUICK_TIMES = 3, 2
_SIFT = "SIFT, matching and RANSAC"
_STRIDES = (4, 3, 2, 1)
_SHARES = (0.35, 0.5, 0.7, 1.0)
_PHOTOS = (1, 2, 4)
_FRESH_PROCESS = """
import sys, time
import ladarreg_core as lr
from dataclasses import replace
scan, photo = lr.read_scan(sys.argv[1] + "/scan.npz"), lr.read_photo(sys.argv[1] + "/photo.png",
                                                                       camera=sys.argv[1] + "/camera.json")
took = []
for _ in range(6):
    start = time.perf_counter()
    lr.register(replace(scan), photo)
    took.append(time.perf_counter() - start)
print(took[0], min(took[1:]))
"""


def _as_installed(folder: str) -> dict[str, str]:
    """Return an environment in which Python keeps compiled modules, in a folder of its own, and threads are free."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONDONTWRITEBYTECODE", "OMP_NUM_THREADS")}
    return {**kept, "PYTHONPYCACHEPREFIX": str(Path(folder) / "compiled")}


def _cases(*, quick: bool, set_name: str = "standard") -> Iterator[SimulatedCase]:
    made = (simulate_case(scene, set_name=set_name, seed=seed) for seed in range(_SEEDS) for scene in SCENES)
    return islice(made, _QUICK_CASES) if quick else made


def _times(*, quick: bool) -> int:
    return _QUICK_TIMES if quick else _TIMES


def _register(scan: lr.Scan, photo: lr.Photo) -> lr.Registration:
    """Register with a copy of the scan, for which nothing has been kept."""
    return lr.register(replace(scan), photo)


def _warm_up() -> None:
    case = simulate_case("boxes", seed=90)
    _register(case.scan, case.photo)
    by_sift(case)


def _against_sift(pairs: Iterator[SimulatedCase], name: str, goal: str, *, accepted: bool, quick: bool) -> str:
    _warm_up()
    found: list[tuple[Duration, Duration]] = []
    others = 0
    for case in pairs:
        if _register(case.scan, case.photo).accepted != accepted:
            others += 1
            continue
        own, peer = in_turn(
            [partial(_register, case.scan, case.photo), partial(by_sift, case)], times=_times(quick=quick)
        )
        found.append((own, peer))
    left_out = f"; {others} with the other verdict left out" if others else ""
    return compared(name, found, _SIFT, goal=goal) + left_out


def registration(*, quick: bool) -> Iterator[str]:
    """Accepted registrations."""
    yield _against_sift(_cases(quick=quick), "registration", "median 1.3, worst 2.5", accepted=True, quick=quick)


def refusal(*, quick: bool) -> Iterator[str]:
    """Photographs of another room."""
    cases = list(_cases(quick=quick))
    wrong = (replace(case, photo=other.photo) for case, other in zip(cases, cases[1:] + cases[:1], strict=True))
    yield _against_sift(wrong, "refusal", "4", accepted=False, quick=quick)


def second_photograph(*, quick: bool) -> Iterator[str]:
    """A photograph on a scan that another one of the same camera was registered with, against the same one alone."""
    _warm_up()
    found = []
    for number, case in enumerate(_cases(quick=quick)):
        noise = np.random.default_rng(number).normal(0, 3, case.photo.pixels.shape)
        other = replace(case.photo, pixels=np.clip(case.photo.pixels + noise, 0, 255).astype(np.uint8))
        rounds = []
        for _ in range(_times(quick=quick)):
            scan = replace(case.scan)
            lr.register(scan, case.photo)
            rounds.append(in_turn([partial(lr.register, scan, other), partial(_register, scan, other)], times=1))
        best = [min(took, key=lambda d: d.wall) for took in zip(*rounds, strict=True)]
        found.append((best[0], best[1]))
    yield compared("second photograph", found, "the same one alone", goal="0.6")


def first(*, quick: bool) -> Iterator[str]:
    """The first registration of a process, with what it imports, against a warm one of the same process."""
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(_cases(quick=quick)):
            write_case(case, Path(folder) / str(number))
            call = [sys.executable, "-c", _FRESH_PROCESS, str(Path(folder) / str(number))]
            run = partial(subprocess.run, call, check=True, capture_output=True, text=True, env=_as_installed(folder))
            if not number:
                run()  # compiles the modules
            cold, warm = map(float, run().stdout.split())
            ratios.append(cold / warm)
    yield (
        f"first: x {np.median(ratios):.2f} median, {max(ratios):.2f} worst of a warm one; {len(ratios)} processes "
        "(asked: 1.5)"
    )


def command(*, quick: bool) -> Iterator[str]:
    """The whole command in a process of its own, with all files written."""
    _warm_up()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(_cases(quick=quick)):
            where = Path(folder) / str(number)
            write_case(case, where)
            call = [
                sys.executable, "-m", "ladarreg", "register", where / "scan.npz", where / "photo.png",
                "--camera", where / "camera.json", "-o", where / "out", "--force",
            ]  # fmt: skip
            run = partial(subprocess.run, call, check=True, capture_output=True, env=_as_installed(folder))
            own, peer = in_turn([run, partial(by_sift, case)], times=_times(quick=quick))
            found.append((own, peer))
    yield compared("command", found, _SIFT, goal="4")


def exponents(*, quick: bool) -> Iterator[str]:
    """Growth of the processor's time with cells, photo pixels and photographs on one scan."""
    _warm_up()
    case = simulate_case("office", seed=0)
    times = _times(quick=quick)
    rows, columns = case.scan.shape
    by_cells: dict[float, Callable[[], object]] = {}
    for stride in _STRIDES:
        scan = case.scan.window(slice(0, rows, stride), slice(0, columns, stride))
        by_cells[scan.ranges.size] = partial(_register, scan, case.photo)
    by_pixels: dict[float, Callable[[], object]] = {}
    for share in _SHARES:
        camera = case.photo.camera.scaled(share)
        photo = replace(case.photo, pixels=_shrunk(case.photo.pixels, camera.size), camera=camera)
        by_pixels[camera.width * camera.height] = partial(_register, case.scan, photo)
    by_photos: dict[float, Callable[[], object]] = {count: partial(_several, case, count) for count in _PHOTOS}
    for name, calls in (("cells", by_cells), ("photo pixels", by_pixels), ("photographs on one scan", by_photos)):
        took = in_turn(list(calls.values()), times=times)
        sizes = np.log(list(calls))
        slope = float(np.polyfit(sizes, np.log([d.processor for d in took]), 1)[0])
        listed = ", ".join(f"{size:,.0f}: {d.processor:.2f} s" for size, d in zip(calls, took, strict=True))
        yield f"exponent of {name}: {slope:.2f} ({listed})"


def _several(case: SimulatedCase, count: int) -> None:
    scan = replace(case.scan)
    for _ in range(count):
        lr.register(scan, case.photo)


def _shrunk(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


REGISTRATION_ROWS: dict[str, Measure] = {
    "registration": registration,
    "refusal": refusal,
    "second photograph": second_photograph,
    "first": first,
    "command": command,
    "exponents": exponents,
}
"""Rows by name."""
