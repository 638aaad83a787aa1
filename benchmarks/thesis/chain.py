"""The thesis's estimators compared with the default, from good matches: python -m benchmarks.thesis.chain [--seeds N].

Good matches are the sub-pixel block matches of the default's own registration. Distances are median displacements, in
photo pixels, of what the photo sees of the scan.
"""

from __future__ import annotations

import argparse

import numpy as np

import ladarreg_core as lr
from ladarreg_core.pose.estimate import solve_pose
from ladarreg_core.results.steps import StepLog
from ladarreg_core.simulate import SCENES, SimulatedCase, simulate_case
from ladarreg_core.thesis.matching.chain import ThesisOptions, solve_thesis


def apart_px(case: SimulatedCase, first: lr.Rigid, second: lr.Rigid) -> float:
    """Return the median displacement between two poses."""
    points = case.scan.points[case.scan.valid][::29].astype(float)
    camera = case.photo.camera
    one, other = camera.project(first @ points), camera.project(second @ points)
    return float(np.nanmedian(np.hypot(*(one - other)[camera.contains(one)].T)))


def distances(case: SimulatedCase) -> dict[str, float]:
    """Return the distance of each estimator from the pose of the default."""
    default = lr.register(case.scan, case.photo)
    good, camera = default.matches.subset(default.inliers), case.photo.camera
    poses = {"truth": case.camera_from_scanner, "robust": solve_pose(good, camera).camera_from_scanner}
    for residual in ("epipolar", "stereo"):
        found = solve_thesis(good, camera, StepLog(), options=ThesisOptions(residual=residual))
        for stage in found.stages:
            if stage.result is not None:
                name = stage.name if stage.name == "linear" else f"{residual} {stage.name.replace('_', ' ')}"
                poses[name] = stage.result.camera_from_scanner
    return {name: apart_px(case, default.camera_from_scanner, pose) for name, pose in poses.items()}


def main() -> None:
    """Run the standard set and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="cases per scene")
    parser.add_argument("--seed-offset", type=int, default=600)
    arguments = parser.parse_args()
    seeds = range(arguments.seed_offset, arguments.seed_offset + arguments.seeds)
    rows = [distances(simulate_case(scene, seed=seed)) for scene in SCENES for seed in seeds]
    print(f"distance from the default's pose, px, {len(rows)} standard cases   median     max   (required: <= .1)")
    for name in dict.fromkeys(name for row in rows for name in row):
        values = [row[name] for row in rows if name in row]
        print(f"  {name:58} {np.median(values):6.3f}  {np.max(values):6.3f}")


if __name__ == "__main__":
    main()
