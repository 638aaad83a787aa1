"""How often the images decide on a pose that is given: python -m benchmarks.verify_pose [--seeds N].

Scans of sparse lidars outdoors with their photographs: `verify_pose` at the true pose, which should be verified, and at
a pose half a degree and 5 cm off, and one 4 degrees off, which must not be.
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import get_args

import cv2
from threadpoolctl import threadpool_limits

import ladarreg_core as lr
from benchmarks.matching.sparse_sets import off_by
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.outdoor_case import simulate_outdoors
from ladarreg_core.simulate.robot_lidar import LidarName
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS

POSES = {"true": (0.0, 0.0), ".5 deg, 5 cm off": (0.5, 0.05), "4 deg, 20 cm off": (4.0, 0.2)}
"""How far off the poses are, degrees and metres."""


def outcomes(lidar: LidarName, scene: str, seed: int) -> dict[str, str]:
    """Return what the images say of each pose of a case."""
    case = simulate_outdoors(scene, lidar=lidar, seed=seed)
    truth = case.camera_from_scanner
    found = {}
    for what, (degrees, metres) in POSES.items():
        pose: Rigid = off_by(truth, seed, degrees=degrees, metres=metres) if degrees else truth
        found[what] = str(lr.verify_pose(case.scan, case.photo, pose).outcome)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1, help="cases per scene and lidar")
    parser.add_argument("--seed-offset", type=int, default=40_000)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    counts: dict[str, Counter[str]] = {what: Counter() for what in POSES}
    with threadpool_limits(1):
        for seed in range(arguments.seed_offset, arguments.seed_offset + arguments.seeds):
            for lidar in get_args(LidarName):
                for scene in OUTDOORS:
                    found = outcomes(lidar, scene, seed)
                    print(f"{lidar}, {scene}, {seed}: {found}", flush=True)
                    for what, outcome in found.items():
                        counts[what][outcome] += 1
    print("\n| pose | verified | contradicted | undecidable |\n|---|---|---|---|")
    for what, count in counts.items():
        print(f"| {what} | {count['verified']} | {count['contradicted']} | {count['undecidable']} |")


if __name__ == "__main__":
    main()
