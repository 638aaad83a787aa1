"""Sets of cases for automatic matching: each yields its cases and their results, row by row."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import ladarreg_core as lr
from benchmarks.matching.rig_sets import rig_rows
from benchmarks.matching.sparse_peers import PEERS_SET, peer_rows
from benchmarks.matching.sparse_sets import SPARSE_SETS
from benchmarks.register import Row, by_default, by_peers, timed
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.simulate import SCENES, simulate_case

_LENSES: tuple[dict[str, float], ...] = (
    {"focal_error": 0.05},
    {"focal_error": -0.05},
    {"k1": -0.15, "k1_error": 0.15},
    {"focal_error": 0.05, "k1": -0.15, "k1_error": 0.15},
)
_OFF_DEG = (4.0, 8.0, 16.0)
_SLOW_PEERS_OF = 3
_NOWHERE = {"error_px": np.inf, "error_deg": np.nan, "error_mm": np.nan}


def with_peers(name: str, seeds: range) -> Iterator[Row]:
    """A set of the simulator by every method; the slow peers get a third of it."""
    number = 0
    for seed in seeds:
        for scene in SCENES:
            case = simulate_case(scene, set_name=name, seed=seed)
            yield by_default(case, name, scene, seed)
            yield from by_peers(case, name, scene, seed, slow_too=number % _SLOW_PEERS_OF == 0)
            number += 1


def intrinsics_rows(seeds: range) -> Iterator[Row]:
    """Photos with wrongly stated cameras."""
    for scene in SCENES:
        for seed in seeds:
            case = simulate_case(scene, seed=seed, **_LENSES[seed % len(_LENSES)])  # type: ignore[arg-type]
            yield by_default(case, "intrinsics", scene, seed)


def thermal_rows(seeds: range) -> Iterator[Row]:
    """Thermal photos; errors in their own pixels."""
    for scene in SCENES:
        for seed in seeds:
            yield by_default(simulate_case(scene, set_name="thermal", seed=seed), "thermal", scene, seed)


def wrong_rows(seeds: range) -> Iterator[Row]:
    """Photos of another room, with other inks and lights."""
    yield from _other_rooms("wrong", "standard", "hard", seeds)


def thermal_wrong_rows(seeds: range) -> Iterator[Row]:
    """Thermal photos of another room."""
    yield from _other_rooms("thermal wrong", "thermal", "thermal", seeds)


def _other_rooms(name: str, scanned: str, photographed: str, seeds: range) -> Iterator[Row]:
    scenes = list(SCENES)
    for seed in seeds:
        for k, scene in enumerate(scenes):
            other = scenes[(k + 1 + seed % (len(scenes) - 1)) % len(scenes)]
            scan = simulate_case(scene, set_name=scanned, seed=seed).scan
            photo = simulate_case(other, set_name=photographed, seed=seed + 1).photo
            yield _refused(name, f"{scene} with {other}", seed, scan, photo)


def blank_rows(seeds: range) -> Iterator[Row]:
    """Photos without content: one gray level, noise, soft clouds."""
    for seed in seeds:
        rng = np.random.default_rng([seed, 5])
        for scene in SCENES:
            case = simulate_case(scene, seed=seed)
            height, width = case.photo.pixels.shape[:2]
            coarse = rng.uniform(0, 255, (height // 32, width // 32, 3))
            pictures = {
                "one gray level": np.full((height, width, 3), 128.0),
                "noise": rng.uniform(0, 255, (height, width, 3)),
                "coarse noise": np.kron(coarse, np.ones((32, 32, 1))),
            }
            for what, pixels in pictures.items():
                photo = replace(case.photo, pixels=pixels.astype(np.uint8))
                yield _refused("blank", f"{scene} with {what}", seed, case.scan, photo)


def _refused(name: str, what: str, seed: int, scan: lr.Scan, photo: lr.Photo) -> Row:
    result, seconds, steps = timed(scan, photo)
    return Row("auto", name, what, seed, result.accepted, seconds=seconds, steps=steps, **_NOWHERE)


def near_rows(seeds: range) -> Iterator[Row]:
    """Wrong initial poses without any other candidate."""
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
                yield by_default(case, "near", f"{scene}, {off:g} deg off", seed, initial=start, options=options)


def real_rows(seeds: range) -> Iterator[Row]:
    """Real captures beside the checkout, or in LADARREG_DATA, against their known poses."""
    data = Path(os.environ.get("LADARREG_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
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
        result, seconds, steps = timed(scan, photo)
        pose = result.camera_from_scanner
        points = scan.points[scan.valid][::7].astype(float)
        true = photo.camera.project(truth @ points)
        seen = photo.camera.contains(true)
        off = np.linalg.norm(true[seen] - result.camera.project(pose @ points[seen]), axis=1)
        yield Row(
            "auto", "real", name, 0, result.accepted, float(np.nanmedian(off)), float(np.degrees(pose.angle_to(truth))),
            1e3 * pose.distance_to(truth), seconds, steps=steps,
        )  # fmt: skip


SETS: dict[str, tuple[Callable[[range], Iterator[Row]], int]] = {
    "standard": (lambda seeds: with_peers("standard", seeds), 6),
    "hard": (lambda seeds: with_peers("hard", seeds), 6),
    "wide": (lambda seeds: with_peers("wide", seeds), 3),
    "rotated": (lambda seeds: with_peers("rotated", seeds), 2),
    "identical": (lambda seeds: with_peers("identical", seeds), 1),
    "intrinsics": (intrinsics_rows, 4),
    "thermal": (thermal_rows, 3),
    "wrong": (wrong_rows, 15),
    "near": (near_rows, 5),
    "blank": (blank_rows, 1),
    "thermal wrong": (thermal_wrong_rows, 8),
    "real": (real_rows, 1),
    **SPARSE_SETS,
    PEERS_SET: (peer_rows, 3),
    "rigs": (rig_rows, 6),
}
"""Sets by name, with the number of seeds for each of the scenes."""
WITH_PEERS = ("standard", "hard", "wide", "rotated", "identical")
"""Sets on which other methods are run too."""
