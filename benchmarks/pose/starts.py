"""Convergence by distance of the start, and correctness of the verdict on a pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.pose.peers import opencv_from_a_start
from benchmarks.pose.report import Bar, Section, first_third, percent, table
from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.multistart import probe_basin
from ladarreg_core.thesis.estimators.stereo_simplex import SimplexOptions
from testing.scenes.accuracy import SUCCESS_SIGMAS, Answer, default, length_in_sigmas
from testing.scenes.pose_case import Case, difference, start_near
from testing.scenes.room import plane_case, repeated_case, room_case

STARTS = ((5.0, 0.25), (10.0, 0.5), (20.0, 1.0), (40.0, 2.0))
"""Distances of starts: degrees and metres, in random directions."""
HOME_M = 0.05

FromStart = Callable[[Case, Rigid], "Answer | None"]


def _default(case: Case, start: Rigid) -> Answer | None:
    return default(case, initial=start, ransac_iterations=0)


def _simplex(method: str, restarts: int) -> FromStart:
    def solve(case: Case, start: Rigid) -> Answer | None:
        return default(case, initial=start, method=method, simplex=SimplexOptions(restarts=restarts))

    return solve


def basins_section(seeds: Sequence[int]) -> Section:
    """Measure the share that converges from these distances, without RANSAC."""
    fewer = first_third(seeds)
    solvers: dict[str, tuple[FromStart, Sequence[int]]] = {
        "default": (_default, seeds),
        "stereo-simplex": (_simplex("stereo_simplex", 0), fewer),
        "stereo-simplex, with other starts": (_simplex("stereo_simplex", 2), fewer),
        "epipolar-simplex": (_simplex("epipolar_simplex", 0), fewer),
        "epipolar-simplex, with other starts": (_simplex("epipolar_simplex", 2), fewer),
        "OpenCV solvePnP ITERATIVE": (opencv_from_a_start, seeds),
    }
    heads = ("cases", *(f"{degrees:g} deg, {metres:g} m" for degrees, metres in STARTS))
    tables, figures, bars = [], {}, []
    for outliers in (0.0, 0.3):
        home: dict[str, list[float]] = {}
        for name, (solve, those) in solvers.items():
            home[name] = [_share_home(solve, those, outliers, far) for far in STARTS]
        rows = [(name, str(len(solvers[name][1])), *(percent(s) for s in row)) for name, row in home.items()]
        tables.append((f"{percent(outliers, 0)} mismatches", table(heads, rows)))
        figures[percent(outliers, 0)] = {
            name: {"cases": len(solvers[name][1]), **dict(zip(heads[1:], row, strict=True))}
            for name, row in home.items()
        }
    success = _share_home(_default, seeds, 0.0, STARTS[-1], by_bound=True)
    bars.append(Bar("from 40 deg, 2 m without RANSAC, no mismatches: success, %", 100 * success, least=98, digits=1))
    return Section(
        "basins",
        "Basins: convergence without RANSAC (room, n = 200)",
        f"Share of starts so far away, any way, that end within {100 * HOME_M:g} cm of the truth. The simplices reject "
        "mismatches as they do by default; with other starts (their default) they continue from the linear pose "
        "where the result is doubtful. They are slow and run on the first third of the cases only. OpenCV's Levenberg-"
        "Marquardt has no defence against mismatches and is not meant to.",
        tuple(tables),
        tuple(bars),
        {**figures, "success_from_the_farthest": success},
    )


def _share_home(
    solve: FromStart, seeds: Sequence[int], outliers: float, far: tuple[float, float], *, by_bound: bool = False
) -> float:
    home = 0
    for seed in seeds:
        case = room_case(seed, outliers=outliers)
        found = solve(case, start_near(case, seed, *far))
        if found is None:
            continue
        step = difference(case.pose, found[0])
        home += bool(
            step @ case.bound() @ step <= SUCCESS_SIGMAS**2 if by_bound else np.linalg.norm(step[3:]) <= HOME_M
        )
    return home / len(seeds)


VERDICT_CASES: dict[str, Callable[[int], Case]] = {
    "room, no mismatches": room_case,
    "room, 30 % mismatches": lambda seed: room_case(seed, outliers=0.3),
    "room, 50 % mismatches": lambda seed: room_case(seed, outliers=0.5),
    "room, 70 % mismatches": lambda seed: room_case(seed, outliers=0.7),
    "room, 20 matches, half of them mismatched": lambda seed: room_case(seed, count=20, outliers=0.5),
    "all mismatched": lambda seed: room_case(seed, count=60, outliers=1.0),
    "large plane (2.4 m at 5 m)": lambda seed: plane_case(seed, extent_m=1.2, distance_m=5.0),
    "plane (.8 m at 5 m)": lambda seed: plane_case(seed, extent_m=0.4, distance_m=5.0),
    "small plane (.5 m at 9 m)": lambda seed: plane_case(seed, extent_m=0.25, distance_m=9.0),
    "repeated: half of the matches a window on": lambda seed: repeated_case(seed, share=0.5),
    "repeated: 40 % of the matches a window on": lambda seed: repeated_case(seed, share=0.4),
    "repeated: 25 % of the matches a window on": lambda seed: repeated_case(seed, share=0.25),
}


def verdicts_section(seeds: Sequence[int]) -> Section:
    """What `probe_basin` says of the default's poses, and how often it confirms a wrong one."""
    heads = ("unique", "ambiguous", "failed", "no pose", "pose wrong", "'unique' and wrong", "accepted and wrong")
    tables, figures = [], {}
    for stated in (True, False):
        rows = []
        for name, make in VERDICT_CASES.items():
            counts = _verdicts([make(seed) for seed in seeds], stated=stated)
            rows.append((name, *(percent(counts[head] / len(seeds)) for head in heads)))
            figures[f"{name}, noise {'stated' if stated else 'not stated'}"] = {
                h: counts[h] / len(seeds) for h in heads
            }
        tables.append((f"Noise {'stated' if stated else 'not stated'}", table(heads, rows)))
    return Section(
        "verdicts",
        "Verdicts from many starts",
        "What `probe_basin` says of the default's pose, share of the cases. Wrong: further than 6 of its own sigmas "
        "from the truth, and by more than 2 cm or half a degree. A repeated structure and a small plane far away leave "
        "two poses; there 'ambiguous' is right.",
        tuple(tables),
        (),
        figures,
    )


def _verdicts(cases: Sequence[Case], *, stated: bool) -> Counter[str]:
    counts: Counter[str] = Counter()
    for seed, case in enumerate(cases):
        noise = {"sigma_px": case.sigma_px, "sigma_range_m": case.sigma_range_m} if stated else {}
        try:
            result = solve_pose(case.matches, case.camera, PoseOptions(**noise))
        except LadarregError:
            counts["no pose"] += 1
            continue
        verdict = probe_basin(result, seed=seed).verdict
        step = difference(case.pose, result.camera_from_scanner)
        wrong = length_in_sigmas(step, result.covariance) > SUCCESS_SIGMAS and (
            np.linalg.norm(step[3:]) > 0.02 or np.linalg.norm(step[:3]) > np.deg2rad(0.5)
        )
        counts[verdict] += 1
        counts["pose wrong"] += bool(wrong)
        counts["'unique' and wrong"] += bool(wrong and verdict == "unique")
        counts["accepted and wrong"] += bool(wrong and result.accepted)
    return counts
