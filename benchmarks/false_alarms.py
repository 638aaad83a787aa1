"""Stated against observed probabilities of a false agreement: python -m benchmarks.false_alarms [--seeds N].

Scans of sparse lidars with photographs of other places, from rough guesses. Every search is made to end in a finished
pose, however little agrees there, and that pose is judged beside wrong poses of its pair: of all these wrong pairs, a
tenth should be stated with a probability of a tenth or less, and a hundredth with one of a hundredth.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import get_args

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

import ladarreg_core as lr
from benchmarks.matching.sparse_sets import off_by, outdoor_case
from ladarreg_core.matching.auto import AutoOptions
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.simulate.robot_lidar import LidarName
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS

_GUESS_DEG, _GUESS_M = 3.0, 0.2
_NONE = 10**6
_FORCED = RegisterOptions(
    auto=AutoOptions(
        least_fraction=0.0,
        reach="near_start",
        gate=GateOptions(
            least_regions=1, fraction=0.0, contrast=-math.inf, fine_fraction=0.0, shape_fraction=0.0,
            shape_contrast=-math.inf, shape_fine_fraction=0.0, many=_NONE, shape_many=_NONE, few=_NONE,
            false_alarm=0.0, own_false_alarm=1.0, own_margin=0.0,
        ),
    )
)  # fmt: skip
_STATED = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 1e-3, 1e-4)


def wrong_pairs(seeds: range) -> Iterator[tuple[str, float | None]]:
    """Yield the kind of each pair, and the probability that is stated of its pose; None: nothing could be compared."""
    for seed in seeds:
        for lidar in get_args(LidarName):
            for scene in OUTDOORS:
                case, other = outdoor_case(scene, lidar, seed), outdoor_case(scene, lidar, seed + 1)
                guess = off_by(case.camera_from_scanner, seed, degrees=_GUESS_DEG, metres=_GUESS_M)
                result = lr.register(case.scan, other.photo, initial=guess, options=_FORCED)
                verdict = result.diagnostics.get("verification", {})
                yield f"{lidar}, {scene}, {seed}", verdict["false_alarm"] if verdict.get("wrong_poses") else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4, help="cases per scene and lidar")
    parser.add_argument("--seed-offset", type=int, default=20_000)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    stated: list[float] = []
    pairs = 0
    with threadpool_limits(1):
        for what, probability in wrong_pairs(range(arguments.seed_offset, arguments.seed_offset + arguments.seeds)):
            pairs += 1
            print(what, "not measured" if probability is None else f"{probability:.2g}", flush=True)
            if probability is not None:
                stated.append(probability)
    print(f"\n{pairs} wrong pairs, {len(stated)} measured\n\n| stated at most | observed |\n|---|---|")
    for most in _STATED:
        print(f"| {most:g} | {np.mean(np.array(stated) <= most):.4f} |")


if __name__ == "__main__":
    main()
