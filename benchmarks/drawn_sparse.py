"""Matches drawn on sparse lidars: what becomes of ten careful ones, python -m benchmarks.drawn_sparse [--cases N].

The operator clicks on corners of the photograph, and on the same places of the scan's picture by .3 of a cell of the
scan: simulated places of streets and courtyards, where rays tell what lies there, and the real captures with their
published calibrations, where the scan itself does. One click of ten is on something else.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

import ladarreg_core as lr
from benchmarks.matching.sparse_sets import REAL_LIMITS_PX, RIGHT_PX, real_cases
from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.photo import Photo
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.outdoor_case import outdoor_triangles, simulate_outdoors
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.robot_lidar import LidarName
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS

_PICKS, _WRONG = 10, 1
_CLICK_CELLS, _CLICK_PX = 0.3, 1.0
_APART_PX = 40.0
_FARTHEST_M = 60.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of the matches of one case."""

    name: str
    kept: int
    error_px: float
    accepted: bool
    limit_px: float
    reason: str


def draw(scan: Scan, uv: NDArray[np.float64], rays: NDArray[np.float64], rng: np.random.Generator) -> list[Pick]:
    """Return picks as an operator draws them: places in the photo (N, 2) and the rays (N, 3) to the same places."""
    cells = np.asarray(scan.geometry.cell_of(rays)) + rng.normal(0, _CLICK_CELLS, (len(rays), 2))
    clicked = np.asarray(scan.geometry.ray_at(cells))
    photo = uv + rng.normal(0, _CLICK_PX, uv.shape)
    wrong = rng.choice(len(uv), _WRONG, replace=False)
    photo[wrong] += rng.uniform(30, 80, (len(wrong), 2)) * rng.choice([-1, 1], (len(wrong), 2))
    return [Pick(str(k), "point", clicked[k : k + 1], photo[k : k + 1]) for k in range(len(uv))]


def corners(photo: Photo, allowed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return corners (N, 2) of the photograph, best first."""
    gray = cv2.GaussianBlur(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY), (0, 0), 2.0)
    found = cv2.goodFeaturesToTrack(gray, 300, 0.01, _APART_PX, mask=allowed)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


def hits(
    caster: RayCaster, triangles: NDArray[np.float64], origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the points (N, 3) that rays (N, 3) from a point hit first; NaN for none."""
    hit = caster.first_hit(origin, directions)
    corner = triangles[np.maximum(hit, 0)]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        along = ((corner[:, 0] - origin) * normal).sum(axis=1) / (directions * normal).sum(axis=1)
    return np.asarray(np.where((hit >= 0)[:, None], origin + along[:, None] * directions, np.nan))


def spread(uv: NDArray[np.float64], points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.intp]:
    """Return which corners an operator takes: those of all parts of the picture, near and far."""
    chosen = [int(rng.integers(len(uv)))]
    while len(chosen) < min(_PICKS, len(uv)):
        far = np.linalg.norm(uv[:, None] - uv[chosen], axis=2).min(axis=1) / 400
        depth = np.abs(np.log(np.linalg.norm(points, axis=1))[:, None] - np.log(np.linalg.norm(points[chosen], axis=1)))
        score = far + 0.3 * depth.min(axis=1)
        score[chosen] = -1
        chosen.append(int(score.argmax()))
    return np.array(chosen)


def simulated(
    seeds: range,
) -> Iterator[tuple[str, Scan, Photo, Rigid, NDArray[np.float64], NDArray[np.float64], float]]:
    """Yield simulated cases with places in the photo and the same places in space, m."""
    for seed in seeds:
        for scene in OUTDOORS:
            for lidar in get_args(LidarName):
                case = simulate_outdoors(scene, lidar=lidar, seed=seed)
                triangles = np.asarray(outdoor_triangles(scene, lidar=lidar, seed=seed), np.float64)
                caster = RayCaster(triangles)
                pose, camera = case.camera_from_scanner, case.true_camera
                uv = corners(case.photo, np.full(case.photo.pixels.shape[:2], 255, np.uint8))
                to = camera.unproject(uv) @ pose.rotation
                points = hits(caster, triangles, pose.centre, to)
                seen = np.isfinite(points).all(axis=1) & (np.linalg.norm(np.nan_to_num(points), axis=1) < _FARTHEST_M)
                seen[seen] &= caster.sees(0.999 * points[seen], np.zeros(3))
                where = np.asarray(case.scan.geometry.cell_of(np.nan_to_num(points, nan=1.0)))
                seen &= ((where >= 0) & (where <= np.array(case.scan.shape) - 1)).all(axis=1)
                yield f"{lidar}", case.scan, case.photo, pose, uv[seen], points[seen], RIGHT_PX


def real() -> Iterator[tuple[str, Scan, Photo, Rigid, NDArray[np.float64], NDArray[np.float64], float]]:
    """Yield the real captures; places are corners of the photo at which a return lies, by the published pose."""
    for name, scan, photo, pose in real_cases():
        points = scan.points[scan.valid].astype(np.float64)
        uv = photo.camera.project(pose @ points)
        inside = photo.camera.contains(uv) & ((pose @ points)[:, 2] > 0.5)
        points, uv = points[inside], uv[inside]
        found = corners(photo, np.full(photo.pixels.shape[:2], 255, np.uint8))
        apart = np.linalg.norm(found[:, None] - uv, axis=2)
        near = np.where(apart < 15, np.linalg.norm(points, axis=1), np.inf)
        at = near.argmin(axis=1)
        good = np.isfinite(near.min(axis=1))
        yield name, scan, photo, pose, uv[at[good]], points[at[good]], REAL_LIMITS_PX[name]


def outcome(
    name: str, scan: Scan, photo: Photo, truth: Rigid, uv: NDArray[np.float64], points: NDArray[np.float64],
    limit_px: float, seed: int,
) -> Outcome:  # fmt: skip
    """Draw ten matches, solve them, and compare the pose with the true one."""
    rng = np.random.default_rng([seed, 17])
    if len(uv) < _PICKS:
        return Outcome(name, 0, np.nan, False, limit_px, f"only {len(uv)} places")
    chosen = spread(uv, points, rng)
    rays = points[chosen] / np.linalg.norm(points[chosen], axis=1, keepdims=True)
    picks = draw(scan, uv[chosen], rays, rng)
    matches, _ = matches_from_picks(scan, picks, camera=photo.camera)
    try:
        result = lr.register(scan, photo, method="manual", picks=picks)
    except LadarregError as error:
        return Outcome(name, len(matches), np.nan, False, limit_px, str(error))
    error_px = _error_px(scan, photo.camera, result.camera_from_scanner, truth)
    return Outcome(name, len(matches), error_px, bool(result.accepted), limit_px, " ".join(map(str, result.reasons)))


def _error_px(scan: Scan, camera: CameraModel, pose: Rigid, truth: Rigid) -> float:
    points = scan.points[scan.valid].astype(np.float64)[::7]
    a, b = camera.project(pose @ points), camera.project(truth @ points)
    seen = camera.contains(b)
    return float(np.median(np.linalg.norm(a[seen] - b[seen], axis=1)))


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes by lidar as a table."""
    lines = [
        "| lidar | cases | matches kept of ten | found | accepted, right | accepted, wrong | median error, px |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(one.name for one in outcomes):
        of = [one for one in outcomes if one.name == name]
        right = [one.error_px <= one.limit_px for one in of]
        errors = [one.error_px for one in of if np.isfinite(one.error_px)]
        lines.append(
            f"| {name} | {len(of)} | {np.mean([one.kept for one in of]):.1f} | {sum(right)} | "
            f"{sum(r and one.accepted for r, one in zip(right, of, strict=True))} | "
            f"{sum(not r and one.accepted for r, one in zip(right, of, strict=True))} | "
            f"{np.median(errors) if errors else np.nan:.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=6, help="places of each scene")
    parser.add_argument("--first", type=int, default=500, help="first seed")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    outcomes = []
    for number, case in enumerate(simulated(range(arguments.first, arguments.first + arguments.cases))):
        outcomes.append(outcome(*case, number))
        print(outcomes[-1], flush=True)
    for seed in range(arguments.cases):
        for case in real():
            outcomes.append(outcome(*case, seed))
            print(outcomes[-1], flush=True)
    print(table(outcomes))
    if arguments.json:
        arguments.json.write_text(json.dumps([[getattr(o, n) for n in Outcome.__slots__] for o in outcomes]))


if __name__ == "__main__":
    main()
