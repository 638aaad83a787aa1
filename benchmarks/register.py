"""Registrations, their accuracy and a time per step, beside the thesis's chain and SIFT with RANSAC in the same run.

Run it as `python -m benchmarks.register [--seeds N] [--seed-offset K] [--sets standard,hard,...] [--json FILE]`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from dataclasses import asdict, dataclass

import cv2
import numpy as np

import ladarreg_core as lr
from ladarreg_core.matching.densify import DensifyOptions
from ladarreg_core.matching.thesis import ThesisOptions
from ladarreg_core.matching.thesis_matches import ThesisMatchOptions
from ladarreg_core.pose.estimate import PoseOptions
from ladarreg_core.pose.ransac import ransac_pose
from ladarreg_core.pose.stereo_simplex import SimplexOptions
from ladarreg_core.register import RegisterOptions
from ladarreg_core.simulate import SCENES, SETS, SimulatedCase, simulate_case
from ladarreg_core.surface_range import surface_range


@dataclass(frozen=True)
class Row:
    """One case by one method."""

    method: str
    set_name: str
    scene: str
    seed: int
    accepted: bool
    error_px: float
    error_deg: float
    error_mm: float
    sigmas: float
    seconds: float


def errors(case: SimulatedCase, pose: lr.Rigid) -> tuple[float, float, float]:
    """Return the median displacement of visible cells (px), the angle (deg) and the distance (mm) from the truth."""
    points = case.scan.points[case.scan.valid][::29].astype(float)
    camera, truth = case.true_camera, case.camera_from_scanner
    true = camera.project(truth @ points)
    off = np.hypot(*(true - camera.project(pose @ points))[camera.contains(true)].T)
    seen = off[np.isfinite(off)]
    px = float(np.median(seen)) if len(seen) else float("nan")
    return px, float(np.degrees(pose.angle_to(truth))), 1e3 * pose.distance_to(truth)


def by_sift(case: SimulatedCase) -> lr.Rigid | None:
    """Match SIFT features of the perspective intensity image and the photo, and solve by RANSAC: the usual way."""
    view = lr.perspective_view(case.scan, case.photo.camera)
    gray = np.sqrt(np.maximum(view.intensity, 0))
    gray = np.clip(gray * (255 / np.percentile(gray, 99.5)), 0, 255).astype(np.uint8)
    sift = cv2.SIFT_create()
    scan_keys, scan_features = sift.detectAndCompute(gray, None)
    photo_keys, photo_features = sift.detectAndCompute(cv2.cvtColor(case.photo.pixels, cv2.COLOR_RGB2GRAY), None)
    pairs = cv2.BFMatcher().knnMatch(scan_features, photo_features, k=2)
    good = [first for first, second in pairs if first.distance < 0.85 * second.distance]
    if len(good) < 6:
        return None
    rays = view.rays_at(np.array([scan_keys[m.queryIdx].pt for m in good]))
    ranges = surface_range(case.scan, rays)
    known = np.isfinite(ranges)
    uv = np.array([photo_keys[m.trainIdx].pt for m in good])
    found = ransac_pose(
        (rays * ranges[:, None])[known], uv[known], case.photo.camera, threshold_px=5, iterations=5000, seed=0
    )
    return found.camera_from_scanner if found else None


THESIS = {
    "thesis": ThesisOptions(),
    "to the letter": ThesisOptions(
        first_pose="linear_only",
        residual="stereo",
        matching=ThesisMatchOptions(
            first_search_px=15, depth_edges="foreground", densify=DensifyOptions(kappa="equal"), culling="one_sided"
        ),
        pose=PoseOptions(simplex=SimplexOptions(restarts=0)),
    ),
}
"""The chain with what was added to it, and without."""


def by_thesis(case: SimulatedCase, name: str, options: ThesisOptions, set_name: str, scene: str, seed: int) -> Row:
    """Register by the thesis's chain."""
    started = time.perf_counter()
    result = lr.register(case.scan, case.photo, method="thesis", options=RegisterOptions(thesis=options))
    seconds = time.perf_counter() - started
    px, deg, mm = errors(case, result.camera_from_scanner) if len(result.matches) else (np.nan, np.nan, np.nan)
    return Row(name, set_name, scene, seed, result.accepted, px, deg, mm, np.nan, seconds)


def run(case: SimulatedCase, set_name: str, scene: str, seed: int, steps: dict[str, list[float]]) -> list[Row]:
    """Register one case by every method."""
    started = time.perf_counter()
    result = lr.register(case.scan, case.photo)
    seconds = time.perf_counter() - started
    of_this: dict[str, float] = defaultdict(float)
    for step in result.steps:
        of_this[step.name] += step.seconds
    for name, spent in of_this.items():
        steps[name].append(spent)
    px, deg, mm = errors(case, result.camera_from_scanner)
    w = cv2.Rodrigues(case.camera_from_scanner.rotation @ result.camera_from_scanner.rotation.T)[0][:, 0]
    d = np.concatenate([w, case.camera_from_scanner.centre - result.camera_from_scanner.centre])
    sigmas = float(np.sqrt(d @ np.linalg.solve(result.covariance, d) / 6))
    rows = [Row("auto", set_name, scene, seed, result.accepted, px, deg, mm, sigmas, seconds)]
    rows += [by_thesis(case, name, options, set_name, scene, seed) for name, options in THESIS.items()]

    started = time.perf_counter()
    pose = by_sift(case)
    seconds = time.perf_counter() - started
    px, deg, mm = errors(case, pose) if pose else (np.nan, np.nan, np.nan)
    rows.append(Row("SIFT + RANSAC", set_name, scene, seed, pose is not None, px, deg, mm, np.nan, seconds))
    return rows


def table(rows: list[Row]) -> None:
    """Print a line per set and method."""
    heads = ("set", "method", "accepted", "<.6 px", "px", "max px", "deg", "mm", "s", "sigmas")
    print(f"{heads[0]:10} {heads[1]:14} {heads[2]:>9}" + "".join(f"{head:>8}" for head in heads[3:]))
    for set_name in dict.fromkeys(row.set_name for row in rows):
        for method in dict.fromkeys(row.method for row in rows):
            mine = [row for row in rows if row.set_name == set_name and row.method == method]
            taken = [row for row in mine if row.accepted]
            px, deg, mm, sigmas = (
                np.array([getattr(row, name) for row in taken] or [np.nan])
                for name in ("error_px", "error_deg", "error_mm", "sigmas")
            )
            figures = [
                f"{int((px < 0.6).sum())}",
                f"{np.median(px):.2f}",
                f"{np.max(px):.2f}",
                f"{np.median(deg):.3f}",
                f"{np.median(mm):.1f}",
                f"{np.median([row.seconds for row in mine]):.2f}",
                f"{np.sqrt(np.mean(sigmas**2)):.2f}",
            ]
            print(
                f"{set_name:10} {method:14} {len(taken):5}/{len(mine):<3}" + "".join(f"{text:>8}" for text in figures)
            )


def main() -> None:
    """Run the cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="cases per scene and set")
    parser.add_argument("--seed-offset", type=int, default=0)
    parser.add_argument("--sets", default="standard", help=f"of {', '.join(SETS)}")
    parser.add_argument("--json", help="write all rows here")
    arguments = parser.parse_args()
    rows: list[Row] = []
    steps: dict[str, list[float]] = defaultdict(list)
    lr.register(*((made := simulate_case("boxes", seed=0)).scan, made.photo))  # imports and caches
    for set_name in arguments.sets.split(","):
        for scene in SCENES:
            for seed in range(arguments.seed_offset, arguments.seed_offset + arguments.seeds):
                rows += run(simulate_case(scene, set_name=set_name, seed=seed), set_name, scene, seed, steps)
    table(rows)
    print("\nmedian seconds a step (1000 x 700 cells, 768 x 512 pixels)")
    for name, spent in steps.items():
        print(f"  {name:16} {np.median(spent):6.3f}")
    print(f"  {'all':16} {np.median([row.seconds for row in rows if row.method == 'auto']):6.3f}   (asked: <= 1.5)")
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump([asdict(row) for row in rows], file, indent=1)


if __name__ == "__main__":
    main()
