"""Sets of sparse, accumulated and multi-line lidars outdoors: simulated, shuffled and real."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

import ladarreg_core as lr
from benchmarks.register import Row, timed
from ladarreg_core.camera import CameraModel
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.simulate.outdoor_case import OutdoorCase, simulate_outdoors
from ladarreg_core.simulate.robot_lidar import LidarName
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS

GUESS_DEG, GUESS_M = 5.0, 0.3
"""How far off a rough guess is."""
ROUGH, NONE = "rough guess", "no guess"
"""How the rows of a set end."""
RIGHT_PX = 6.0
"""Error up to which a pose from such a scan counts as right, px of a photograph of 960 x 640."""
_REAL = (
    ("garage", "pointcloud9.pcd", "frame9.png", "truth_refined.json"),
    ("street", "scan.pcd", "photo.png", "truth.json"),
)
REAL_LIMITS_PX = {"garage": 8.0, "street": 12.0}
"""Error up to which a pose counts as right, px of the photograph of a real capture, whose true pose is no better."""
_REAL_GUESSES = 6


@lru_cache(maxsize=2)
def outdoor_case(scene: str, lidar: LidarName, seed: int) -> OutdoorCase:
    """Return a case; the last ones are kept."""
    return simulate_outdoors(scene, lidar=lidar, seed=seed)


def off_by(truth: Rigid, seed: int, *, degrees: float = GUESS_DEG, metres: float = GUESS_M) -> Rigid:
    """Return a pose that is exactly so far from the truth, in a direction of the seed's."""
    axis, way = (v / np.linalg.norm(v) for v in np.random.default_rng([seed, 9]).normal(size=(2, 3)))
    return Rigid.from_centre(
        rotation_from_rotvec(axis * np.radians(degrees)) @ truth.rotation, truth.centre + metres * way
    )


def rows_of(lidar: LidarName) -> Callable[[range], Iterator[Row]]:
    """Return the set of a lidar: every place from a rough guess and from none."""

    def rows(seeds: range) -> Iterator[Row]:
        for seed in seeds:
            for scene in OUTDOORS:
                case = outdoor_case(scene, lidar, seed)
                for how in (ROUGH, NONE):
                    guess = off_by(case.camera_from_scanner, seed) if how == ROUGH else None
                    result, seconds, steps = timed(case.scan, case.photo, initial=guess)
                    yield _row(lidar, f"{scene}, {how}", seed, result, seconds, steps, case.scan, case.photo.camera,
                               case.camera_from_scanner)  # fmt: skip

    return rows


def shuffled_rows(seeds: range) -> Iterator[Row]:
    """Scans with the photograph of another place, alternately from a rough guess and from none."""
    for seed in seeds:
        for lidar in get_args(LidarName):
            for number, scene in enumerate(OUTDOORS):
                case, other = outdoor_case(scene, lidar, seed), outdoor_case(scene, lidar, seed + 1)
                guess = off_by(case.camera_from_scanner, seed) if (seed + number) % 2 else None
                result, seconds, steps = timed(case.scan, other.photo, initial=guess)
                how = ROUGH if guess is not None else NONE
                yield Row("auto", "sparse shuffled", f"{lidar}, {scene}, {how}", seed, result.accepted, np.inf, np.nan,
                          np.nan, seconds, steps=steps)  # fmt: skip


def real_cases() -> Iterator[tuple[str, lr.Scan, lr.Photo, Rigid]]:
    """Yield the captures beside the checkout, or in LADARREG_DATA, with their published poses."""
    data = Path(os.environ.get("LADARREG_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    for name, scan_file, photo_file, truth_file in _REAL:
        folder = data / name
        if not (folder / truth_file).is_file():
            print(f"  {name}: not there, skipped")
            continue
        scan = lr.read_scan(folder / scan_file)
        photo = lr.read_photo(folder / photo_file, camera=folder / "camera.json")
        truth = Rigid.from_matrix(json.loads((folder / truth_file).read_text())["camera_from_scanner"])
        yield name, scan, photo, truth


def real_rows(seeds: range) -> Iterator[Row]:
    """Captures beside the checkout, or in LADARREG_DATA, from rough guesses and from none."""
    for name, scan, photo, truth in real_cases():
        for seed in (*seeds, None):
            guess = None if seed is None else off_by(truth, seed)
            result, seconds, steps = timed(scan, photo, initial=guess)
            how = NONE if guess is None else ROUGH
            yield _row("sparse real", f"{name}, {how}", seed or 0, result, seconds, steps, scan,
                       photo.camera, truth)  # fmt: skip


def error_px(
    scan: lr.Scan, pose: Rigid, camera: CameraModel, truth: Rigid, *, found: CameraModel | None = None
) -> float:
    """Return the median displacement of what the photo sees of a scan, px, by a pose and a camera that was found."""
    points = scan.points[scan.valid].astype(float)
    points = points[:: max(1, len(points) // 5000)]
    true = camera.project(truth @ points)
    seen = camera.contains(true)
    off = np.linalg.norm(true[seen] - (found or camera).project(pose @ points[seen]), axis=1)
    off[~np.isfinite(off)] = np.inf  # behind the camera that was found
    return float(np.median(off))


def _row(
    set_name: str, what: str, seed: int, result: lr.Registration, seconds: float, steps: dict[str, float],
    scan: lr.Scan, camera: CameraModel, truth: Rigid,
) -> Row:  # fmt: skip
    pose = result.camera_from_scanner
    turn = cv2.Rodrigues(truth.rotation @ pose.rotation.T)[0][:, 0]
    apart = np.concatenate([turn, truth.centre - pose.centre])
    return Row(
        "auto", set_name, what, seed, result.accepted, error_px(scan, pose, camera, truth, found=result.camera),
        float(np.degrees(pose.angle_to(truth))), 1e3 * pose.distance_to(truth), seconds,
        sigmas=float(np.sqrt(apart @ np.linalg.solve(result.covariance, apart) / 6)), steps=steps,
    )  # fmt: skip


SPARSE_LIDARS: dict[str, tuple[Callable[[range], Iterator[Row]], int]] = {
    lidar: (rows_of(lidar), 12) for lidar in get_args(LidarName)
}
"""Sets by lidar, with the number of seeds for each of the two places."""
SPARSE_SETS: dict[str, tuple[Callable[[range], Iterator[Row]], int]] = {
    **SPARSE_LIDARS,
    "sparse shuffled": (shuffled_rows, 25),
    "sparse real": (real_rows, _REAL_GUESSES),
}
"""All sets of this module."""
