"""Stated against observed probabilities of a false agreement: python -m benchmarks.false_alarms [--seeds N]; or the
number of wrong pairs that are accepted: python -m benchmarks.false_alarms --journal FILE [--minutes M] [--seeds N].

Scans of sparse lidars with photographs of other places, from rough guesses. Every search is made to end in a finished
pose, however little agrees there, and that pose is judged beside wrong poses of its pair: of all these wrong pairs, a
tenth should be stated with a probability of a tenth or less, and a hundredth with one of a hundredth.

With a journal, wrong pairs are registered as usual, alternately from a rough guess and from none, and one line is
appended for each. A run that was stopped goes on where it was, so that thousands can be tried in the background; every
scan and every photograph is of one pair only, so that the pairs are independent.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

import ladarreg_core as lr
from benchmarks.matching.sparse_sets import off_by, outdoor_case
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.simulate.outdoor_case import simulate_outdoors
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
_CONFIDENCE = 0.95
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


def tried_pairs(journal: Path, seeds: range, *, until: float) -> list[bool]:
    """Register the wrong pairs that a journal does not have yet, until a time; return which of all were accepted.

    Args:
        journal: file with one JSON object a line; made if it is not there.
        seeds: of the cases.
        until: `time.monotonic()` at which no further pair is begun.
    """
    text = journal.read_text() if journal.exists() else ""
    done = {one["pair"]: bool(one["accepted"]) for one in map(json.loads, filter(_is_whole, text.splitlines()))}
    if text and not text.endswith("\n"):  # the next line must not be joined to one that was cut
        with journal.open("a") as file:
            file.write("\n")
    for seed in seeds:
        for lidar in get_args(LidarName):
            for number, scene in enumerate(OUTDOORS):
                name = f"{lidar}, {scene}, {seed}"
                if name in done:
                    continue
                if time.monotonic() >= until:
                    return list(done.values())
                case = simulate_outdoors(scene, lidar=lidar, seed=2 * seed)
                other = simulate_outdoors(scene, lidar=lidar, seed=2 * seed + 1)
                guess = off_by(case.camera_from_scanner, seed) if (seed + number) % 2 else None
                accepted = lr.register(case.scan, other.photo, initial=guess).accepted
                done[name] = accepted
                with journal.open("a") as file:
                    file.write(json.dumps({"pair": name, "guess": guess is not None, "accepted": accepted}) + "\n")
    return list(done.values())


def most_probable_rate(accepted: int, tried: int) -> float:
    """Return the rate of acceptance that so few acceptances exclude with 95 % confidence.

    Source: Clopper and Pearson (1934), one-sided.
    """
    from scipy.special import betaincinv

    return 1.0 if accepted >= tried else float(betaincinv(accepted + 1, tried - accepted, _CONFIDENCE))


def _is_whole(line: str) -> bool:
    """Return whether a line was written completely: the last one of a run that was killed may not be."""
    return line.startswith("{") and line.endswith("}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4, help="cases per scene and lidar")
    parser.add_argument("--seed-offset", type=int, default=20_000)
    parser.add_argument("--journal", type=Path, help="count accepted wrong pairs; appended to, and continued")
    parser.add_argument("--minutes", type=float, default=math.inf, help="with a journal: begin no pair later")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.journal:
        seeds = range(arguments.seed_offset, arguments.seed_offset + arguments.seeds)
        with threadpool_limits(1):
            found = tried_pairs(arguments.journal, seeds, until=time.monotonic() + 60 * arguments.minutes)
        rate = most_probable_rate(sum(found), len(found))
        print(f"{len(found)} wrong pairs, {sum(found)} accepted: a rate below {rate:.2g} with 95 % confidence")
        return
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
