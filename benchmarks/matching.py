"""Automatic matching, set by set, every peer in the same run: python -m benchmarks.matching [--sets A,B] [--json FILE].

Simulated sets as `ladarreg simulate` makes them; `intrinsics`: the stated focal length 5 % off or k1 .15 off; `wrong`:
the scan of one room and the photograph of another; `near`: climbs forced to start from a wrong place; `real`: the
captures beside the checkout, or where LADARREG_DATA says. Wrong and near ask one thing: what is accepted and is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import ladarreg_core as lr
from benchmarks.register import Row, errors, run, table
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.auto import AutoOptions
from ladarreg_core.register import RegisterOptions
from ladarreg_core.simulate import SCENES, SimulatedCase, simulate_case

_PEERS_TOO = ("standard", "hard", "wide", "rotated", "identical")
_LENSES: tuple[dict[str, float], ...] = (
    {"focal_error": 0.05},
    {"focal_error": -0.05},
    {"k1": -0.15, "k1_error": 0.15},
    {"focal_error": 0.05, "k1": -0.15, "k1_error": 0.15},
)
_OFF_DEG = (4.0, 8.0, 16.0)
_RIGHT_PX = 2.0


@dataclass(frozen=True)
class CameraRow:
    """What became of the stated camera."""

    scene: str
    seed: int
    accepted: bool
    error_px: float
    error_mm: float
    focal_percent: float
    k1: float
    seconds: float


@dataclass(frozen=True)
class Refusal:
    """A registration that has no right answer, or started where it should not."""

    what: str
    accepted: bool
    error_px: float
    seconds: float

    @property
    def wrong(self) -> bool:
        return self.accepted and not self.error_px <= _RIGHT_PX


def intrinsics_rows(seeds: range) -> Iterator[CameraRow]:
    """Cameras that are stated wrongly."""
    for scene in SCENES:
        for seed in seeds:
            case = simulate_case(scene, seed=seed, **_LENSES[seed % len(_LENSES)])  # type: ignore[arg-type]
            begin = time.perf_counter()
            result = lr.register(case.scan, case.photo)
            seconds = time.perf_counter() - begin
            px, mm = with_camera(case, result.camera_from_scanner, result.camera)
            found = result.camera.distortion[0] if result.camera.distortion else 0.0
            yield CameraRow(
                scene, seed, result.accepted, px, mm, 100 * abs(result.camera.focal_px / case.true_camera.focal_px - 1),
                abs(found - case.true_camera.distortion[0]), seconds,
            )  # fmt: skip


def with_camera(case: SimulatedCase, pose: Rigid, camera: Camera) -> tuple[float, float]:
    """Median displacement (px) by pose and camera together, and the distance of the centre (mm)."""
    points = case.scan.points[case.scan.valid][::29].astype(float)
    true = case.true_camera.project(case.camera_from_scanner @ points)
    seen = case.true_camera.contains(true)
    off = np.linalg.norm(true[seen] - camera.project(pose @ points[seen]), axis=1)
    return float(np.nanmedian(off)), 1000 * pose.distance_to(case.camera_from_scanner)


def wrong_rows(seeds: range) -> Iterator[Refusal]:
    """Photographs of another room: another scene, and its inks and lights besides."""
    scenes = list(SCENES)
    for seed in seeds:
        for k, scene in enumerate(scenes):
            other = scenes[(k + 1 + seed % (len(scenes) - 1)) % len(scenes)]
            scan = simulate_case(scene, seed=seed).scan
            photo = simulate_case(other, set_name="hard", seed=seed + 1).photo
            begin = time.perf_counter()
            result = lr.register(scan, photo)
            yield Refusal(f"{scene} with {other}, {seed}", result.accepted, np.inf, time.perf_counter() - begin)


def near_rows(seeds: range) -> Iterator[Refusal]:
    """Starts in the wrong place that nothing else may help."""
    options = RegisterOptions(auto=AutoOptions(reach="near_start"))
    for scene in SCENES:
        for seed in seeds:
            case = simulate_case(scene, set_name="hard", seed=seed)
            rng = np.random.default_rng([seed, 3])
            for off in _OFF_DEG:
                axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
                truth, angle = case.camera_from_scanner, np.deg2rad(off)
                start = Rigid.from_centre(
                    rotation_from_rotvec(axis * angle) @ truth.rotation, truth.centre + 3 * angle * way
                )
                begin = time.perf_counter()
                result = lr.register(case.scan, case.photo, initial=start, options=options)
                px = errors(case, result.camera_from_scanner)[0]
                yield Refusal(f"{scene} {seed}, {off:g} deg off", result.accepted, px, time.perf_counter() - begin)


def thermal_rows(seeds: range) -> Iterator[Row]:
    """Thermal pictures; px are those of the small thermal picture."""
    for scene in SCENES:
        for seed in seeds:
            case = simulate_case(scene, set_name="thermal", seed=seed)
            begin = time.perf_counter()
            result = lr.register(case.scan, case.photo)
            seconds = time.perf_counter() - begin
            px, deg, mm = errors(case, result.camera_from_scanner)
            yield Row("auto", "thermal", scene, seed, result.accepted, px, deg, mm, np.nan, seconds)


def real_rows() -> Iterator[Refusal]:
    """Real captures against the truth that is known of them."""
    data = Path(os.environ.get("LADARREG_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    captures = (
        ("kinect", "scan.json", "color_1.jpg"),
        ("garage", "scan.npz", "frame9.png"),
        ("street", "scan.pcd", "photo.png"),
    )
    for name, scan_file, photo_file in captures:
        folder = data / name
        if not folder.is_dir():
            print(f"  {name}: not there, skipped")
            continue
        scan = lr.read_scan(folder / scan_file)
        photo = lr.read_photo(folder / photo_file, camera=folder / "camera.json")
        truth = Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
        begin = time.perf_counter()
        result = lr.register(scan, photo)
        seconds = time.perf_counter() - begin
        points = scan.points[scan.valid][::7].astype(float)
        true = photo.camera.project(truth @ points)
        seen = photo.camera.contains(true)
        off = np.linalg.norm(true[seen] - result.camera.project(result.camera_from_scanner @ points[seen]), axis=1)
        yield Refusal(name, result.accepted, float(np.nanmedian(off)), seconds)


def tell_cameras(rows: list[CameraRow]) -> None:
    """Print what became of the stated cameras."""
    taken = [row for row in rows if row.accepted]
    print(f"intrinsics: {len(taken)} of {len(rows)} accepted; of these median / worst")
    for name, unit in (("error_px", "px"), ("error_mm", "mm"), ("focal_percent", "% of f"), ("k1", "k1")):
        values = [getattr(row, name) for row in taken] or [np.nan]
        print(f"  {unit:8} {np.median(values):8.3f} {np.max(values):8.3f}")


def tell_refusals(name: str, rows: list[Refusal]) -> None:
    """Print how many were accepted, and how many of these are wrong."""
    taken, wrong = sum(row.accepted for row in rows), [row for row in rows if row.wrong]
    seconds = np.median([row.seconds for row in rows]) if rows else np.nan
    print(f"{name}: {taken} of {len(rows)} accepted, {len(wrong)} of these wrong; {seconds:.2f} s each")
    for row in wrong:
        print(f"  WRONG {row.what}: {row.error_px:.1f} px")


def main() -> None:
    sets = (*_PEERS_TOO, "intrinsics", "thermal", "wrong", "near", "real")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", default="standard,hard", help=f"by commas, of {', '.join(sets)}")
    parser.add_argument("--seeds", type=int, default=2, help="cases per scene and set")
    parser.add_argument("--seed-offset", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write every row here")
    arguments = parser.parse_args()
    chosen = arguments.sets.split(",")
    if unknown := set(chosen) - set(sets):
        parser.error(f"there is no set {', '.join(sorted(unknown))}; choose of {', '.join(sets)}")
    seeds = range(arguments.seed_offset, arguments.seed_offset + arguments.seeds)
    written: dict[str, list[dict[str, object]]] = {}

    steps: dict[str, list[float]] = defaultdict(list)
    rows: list[Row] = []
    for name in [name for name in chosen if name in _PEERS_TOO]:
        for scene in SCENES:
            for seed in seeds:
                rows += run(simulate_case(scene, set_name=name, seed=seed), name, scene, seed, steps)
    if "thermal" in chosen:
        rows += thermal_rows(seeds)
    if rows:
        table(rows)
        written["registrations"] = [asdict(row) for row in rows]
    if steps:
        print("median seconds a step: " + ", ".join(f"{name} {np.median(s):.3f}" for name, s in steps.items()))
    if "intrinsics" in chosen:
        cameras = list(intrinsics_rows(seeds))
        tell_cameras(cameras)
        written["intrinsics"] = [asdict(row) for row in cameras]
    refusing: dict[str, Callable[[], Iterator[Refusal]]] = {
        "wrong": lambda: wrong_rows(seeds), "near": lambda: near_rows(seeds), "real": real_rows,
    }  # fmt: skip
    for name, ask in refusing.items():
        if name in chosen:
            refusals = list(ask())
            tell_refusals(name, refusals)
            written[name] = [asdict(row) for row in refusals]
    if arguments.json:
        arguments.json.write_text(json.dumps(written, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
