"""Whether registrations of sparse lidars end at one pose from any start: `python -m benchmarks.matching.sparse_starts`.

Each pair is registered from the true pose and from others 3 degrees and .2 m off. Ends are compared with the first
accepted one, in its own standard deviations, and all that are accepted with the truth.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from typing import get_args

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

import ladarreg_core as lr
from benchmarks.matching.sparse_sets import off_by, outdoor_case
from benchmarks.register import timed
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.simulate.robot_lidar import LidarName
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS

_GUESS_DEG, _GUESS_M = 3.0, 0.2
_SAME_SIGMAS, _RIGHT_SIGMAS = 0.3, 3.0
_NEAR = RegisterOptions(auto=AutoOptions(reach="near_start"))


@dataclass
class Ends:
    """What the registrations of a lidar ended in."""

    runs: int = 0
    apart: list[float] = field(default_factory=list)
    """Distances from the pair's first accepted end, in its standard deviations."""
    errors: list[float] = field(default_factory=list)
    """Errors of what was accepted, in its own standard deviations."""
    seconds: float = 0.0

    def add(self, results: list[lr.Registration], truth: Rigid) -> None:
        accepted = [result for result in results if result.accepted]
        self.runs += len(results)
        self.errors += [_sigmas(result, truth) for result in accepted]
        self.apart += [_sigmas(accepted[0], other.camera_from_scanner) for other in accepted[1:]]

    def row(self, name: str) -> str:
        same = np.mean(np.array(self.apart) <= _SAME_SIGMAS) if self.apart else np.nan
        right = np.mean(np.array(self.errors) <= _RIGHT_SIGMAS) if self.errors else np.nan
        median = np.median(self.apart) if self.apart else np.nan
        return (
            f"| {name} | {self.runs} | {len(self.errors)} | {same:.0%} | {median:.2f} | {right:.0%} | "
            f"{self.seconds / max(self.runs, 1):.1f} |"
        )


def _sigmas(result: lr.Registration, other: Rigid) -> float:
    pose = result.camera_from_scanner
    turn = rotvec_from_rotation(other.rotation @ pose.rotation.T)
    apart = np.concatenate([turn, other.centre - pose.centre])
    return float(np.sqrt(apart @ np.linalg.solve(result.covariance, apart) / 6))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="cases per scene and lidar")
    parser.add_argument("--seed-offset", type=int, default=930)
    parser.add_argument("--starts", type=int, default=5, help="starts beside the true pose")
    parser.add_argument("--lidars", default=",".join(get_args(LidarName)))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print("| lidar | runs | accepted | within .3 sigma of the first | median | errors within 3 sigma | s |")
    print("|---|---|---|---|---|---|---|", flush=True)
    with threadpool_limits(1):
        for lidar in arguments.lidars.split(","):
            ends = Ends()
            for seed in range(arguments.seed_offset, arguments.seed_offset + arguments.seeds):
                for scene in OUTDOORS:
                    case = outdoor_case(scene, lidar, seed)
                    truth = case.camera_from_scanner
                    starts = [off_by(truth, 1000 * seed + k, degrees=_GUESS_DEG, metres=_GUESS_M)
                              for k in range(arguments.starts)]  # fmt: skip
                    found = [timed(case.scan, case.photo, initial=start, options=_NEAR) for start in (truth, *starts)]
                    ends.seconds += sum(seconds for _, seconds, _ in found)
                    ends.add([result for result, _, _ in found], truth)
            print(ends.row(lidar), flush=True)


if __name__ == "__main__":
    main()
