"""Many photographs together against one by one: how many are accepted, how far off they are, and what it costs.

    python -m benchmarks.batch [--rooms 4] [--first-seed 0] [--photos 6 12] [--time]

Each room is scanned once and photographed by one camera whose stated focal length is 1 to 3 % wrong, whose principal
point is off the middle and whose lens is distorted; one photograph of the same camera is of another room. Errors are of
the pose: the distance of the camera's centre, the median displacement of points of the scan in the photograph, and the
Mahalanobis distance by the reported covariance / sqrt 6, which is 1 in the mean square where that is right.

`--time` measures the wall and processor time of the command for the photographs of a room together, and of the command
for one pair, once for each photograph.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import ladarreg_core as lr
from ladarreg_core.camera import Camera, camera_from_model_fields
from ladarreg_core.camera.uncertainty import INTRINSICS
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.simulate.case import CAMERA
from testing.scenes.photo_set import PhotoSet, simulate_photo_set, write_phone_photo, write_photo_set

SCENES = ("office", "boxes", "desk", "people")
OTHER_ROOM = "other room.jpg"
_FOCAL_ERROR, _CENTRE_OF_WIDTH, _K1 = (0.01, 0.03), 0.007, 0.03
_FAR = 5.0
_EVERY = 97  # of the scan's points, which are projected


@dataclass(frozen=True)
class Row:
    """One photograph, by itself or together with others."""

    accepted: bool
    error_mm: float
    sigma_mm: float
    displaced_px: float
    """Median displacement of the points in the photograph."""
    mahalanobis: float
    """Distance to the truth / sqrt 6."""
    focal_ratio: float
    """Focal length relative to the true one."""


def room(seed: int, photos: int) -> tuple[PhotoSet, float]:
    """Return the photographs of a room, and the relative error of their stated focal length."""
    rng = np.random.default_rng([seed, 408])
    error = float(rng.choice((-1, 1)) * rng.uniform(*_FOCAL_ERROR))
    dx, dy = rng.normal(0, _CENTRE_OF_WIDTH * CAMERA.width, 2)
    camera = replace(
        CAMERA, cx=CAMERA.cx + dx, cy=CAMERA.cy + dy, distortion=(float(rng.normal(0, _K1)), 0.0, 0.0, 0.0)
    )
    return simulate_photo_set(SCENES[seed % len(SCENES)], seed=seed, photos=photos, camera=camera), error


def write_room(folder: Path, found: PhotoSet, focal_error: float, seed: int) -> list[Path]:
    """Write a room and one photograph of another one, and return the paths of the photographs."""
    paths = write_photo_set(folder, found, focal_error=focal_error)
    elsewhere = simulate_photo_set(SCENES[(seed + 1) % len(SCENES)], seed=seed + 500, photos=1, camera=found.camera)
    write_phone_photo(folder / OTHER_ROOM, elsewhere.pixels[0], found.camera, focal_error=focal_error)
    return [*paths, folder / OTHER_ROOM]


def row_of(scan: lr.Scan, truth: Rigid, true_camera: Camera, one: dict[str, Any]) -> Row:
    """Return how far off a photograph is.

    Args:
        scan: the scan.
        truth: the true `camera_from_scanner`.
        true_camera: the true camera.
        one: `camera_from_scanner`, `camera`, `covariance` and `accepted` of the result.
    """
    if not one["accepted"]:
        return Row(False, *[float("nan")] * 5)
    pose, camera = Rigid.from_matrix(one["camera_from_scanner"]), camera_from_model_fields(one["camera"])
    assert isinstance(camera, Camera)
    covariance = np.array(one["covariance"])
    turn = rotvec_from_rotation(truth.rotation @ pose.rotation.T)
    off = np.concatenate([turn, truth.centre - pose.centre])
    points = scan.points[scan.valid][::_EVERY].astype(np.float64)
    uv, true_uv = camera.project(pose @ points), true_camera.project(truth @ points)
    inside = true_camera.contains(true_uv)
    return Row(
        True,
        1000 * float(np.linalg.norm(off[3:])),
        1000 * float(np.sqrt(np.trace(covariance[3:, 3:]))),
        float(np.nanmedian(np.linalg.norm(uv - true_uv, axis=1)[inside])),
        float(np.sqrt(off @ np.linalg.solve(covariance, off) / 6)),
        camera.focal_px / true_camera.focal_px,
    )


def one_by_one(scan: lr.Scan, found: PhotoSet, paths: Sequence[Path]) -> list[Row]:
    """Register each photograph by itself; the last one is of another room."""
    rows = []
    for path, truth in zip(paths, [*found.poses, Rigid.identity()], strict=True):
        result = lr.register(scan, lr.read_photo(path))
        rows.append(row_of(scan, truth, found.camera, json.loads(result.to_json())))
    return rows


def together(scan: lr.Scan, found: PhotoSet, folder: Path, paths: Sequence[Path]) -> tuple[list[Row], float]:
    """Register photographs in one run; return also the Mahalanobis distance of the pooled camera / sqrt 4."""
    with tempfile.TemporaryDirectory() as out:
        result = lr.register_photos(folder / "scan.npz", paths, Path(out, "out"))
        truths = dict(
            zip([path.name for path in paths], [*found.poses[: len(paths) - 1], Rigid.identity()], strict=True)
        )
        rows = []
        for name, one in result.photos.items():
            written = result.photo_folder(name) / "registration.json"
            camera = json.loads(written.read_text(encoding="utf-8"))["camera"]
            rows.append(row_of(scan, truths[one["input"]["name"]], found.camera, {**one, "camera": camera}))
    (camera,) = result.cameras.values()
    return rows, _camera_distance(camera, found.camera)


def _camera_distance(fields: dict[str, Any], true: Camera) -> float:
    if not fields["pooled"]:
        return float("nan")
    camera = camera_from_model_fields(fields["camera"])
    assert isinstance(camera, Camera)
    values = [np.array([one.focal_px, one.distortion[0], one.cx, one.cy]) for one in (true, camera)]
    off = values[0] - values[1]
    return float(np.sqrt(off @ np.linalg.solve(np.array(fields["covariance"]), off) / len(INTRINSICS)))


def line(name: str, rows: Sequence[Row]) -> str:
    """Return the figures of photographs of one room; the last one is of another room."""
    right, wrong = rows[:-1], rows[-1]
    found = [one for one in right if one.accepted]

    def of(name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in found] or [np.nan])

    far = int((of("mahalanobis") > _FAR).sum())
    other = "ACCEPTED" if wrong.accepted else "refused"
    return (
        f"{name:<22} {len(found):2} of {len(right):2} accepted, other room {other}; "
        f"error median {np.median(of('error_mm')):5.1f} worst {of('error_mm').max():5.1f} mm (sigma "
        f"{np.median(of('sigma_mm')):5.1f}), {np.median(of('displaced_px')):.2f} / {of('displaced_px').max():.2f} px; "
        f"Mahalanobis rms {np.sqrt(np.mean(of('mahalanobis') ** 2)):.2f} worst {of('mahalanobis').max():.2f}, beyond "
        f"{_FAR:g}: {far}; focal {100 * np.sqrt(np.mean((of('focal_ratio') - 1) ** 2)):.3f} % rms"
    )


def timed(words: Sequence[str]) -> tuple[float, float]:
    """Run the command and return its wall and processor time, s, with those of its processes."""
    import resource

    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-m", "ladarreg", "register", *words, "--quiet"], check=False, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - started, used


def times(folder: Path, paths: Sequence[Path]) -> str:
    """Return what photographs cost together, and one by one."""
    scan = str(folder / "scan.npz")
    with tempfile.TemporaryDirectory() as made:
        alone = [timed([scan, str(path), "-o", os.path.join(made, path.stem)]) for path in paths]
        every = timed([scan, *map(str, paths), "-o", os.path.join(made, "all"), "--cache", os.path.join(made, "cache")])
    wall, used = (sum(column) for column in zip(*alone, strict=True))
    return (
        f"{len(paths)} photographs: one by one {wall:.1f} s ({used:.1f} s of processor), together {every[0]:.1f} s "
        f"({every[1]:.1f} s); {every[0] / wall:.2f} and {every[1] / used:.2f} of it"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--photos", type=int, nargs="+", default=[6, 12])
    parser.add_argument("--time", action="store_true")
    asked = parser.parse_args()
    every: dict[str, list[Row]] = {}
    for seed in range(asked.first_seed, asked.first_seed + asked.rooms):
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            found, error = room(seed, max(asked.photos))
            *paths, other = write_room(folder, found, error, seed)
            print(f"{SCENES[seed % len(SCENES)]} {seed}: focal length {100 * error:+.1f} %", flush=True)
            if asked.time:
                print(f"  {times(folder, [*paths[: min(asked.photos)], other])}", flush=True)
                continue
            scan = lr.read_scan(folder / "scan.npz")
            rows = {"one by one": (one_by_one(scan, found, [*paths, other]), float("nan"))}
            for count in asked.photos:
                rows[f"{count} together"] = together(scan, found, folder, [*paths[:count], other])
            for name, (of_room, distance) in rows.items():
                pooled = f"; pooled camera {distance:.2f}" if np.isfinite(distance) else ""
                print(f"  {line(name, of_room)}{pooled}", flush=True)
                every.setdefault(name, []).extend(of_room[:-1])
    for name, of_all in every.items():
        print(line(f"all, {name}", [*of_all, Row(False, *[float("nan")] * 5)]))


if __name__ == "__main__":
    main()
