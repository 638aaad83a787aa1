"""The room: accuracy with outliers, times, and baselines."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np

from benchmarks.pose.peers import HAS_POSELIB, PEERS, opencv_peer, poselib_peer
from benchmarks.pose.report import Bar, Section, first_third, number, percent, table
from ladarreg_core.frames import Rigid
from ladarreg_core.thesis.estimators.epipolar import epipolar_cost
from ladarreg_core.thesis.estimators.stereo import StereoPairs, stereo_cost
from testing.scenes.accuracy import Answers, Solver, ask, default, figures_of, length_in_sigmas, measure
from testing.scenes.pose_case import Case, difference
from testing.scenes.room import room_case

OUTLIERS = (0.0, 0.3, 0.5, 0.7)
SAME_SIGMAS = 0.1
COUNTS = (50, 200, 2000)
TIMED_CASES, TIMED_ROUNDS = 15, 3
TIMED_OUTLIERS = 0.3
BASELINES: dict[str, tuple[float, tuple[float, float, float] | None]] = {
    "0": (0.0, None),
    "1 cm": (0.01, None),
    "5 cm": (0.05, None),
    "20 cm": (0.2, None),
    "50 cm": (0.5, None),
    "forward 50 cm": (0.5, (1.0, 0.0, 0.0)),
}


def mismatches_section(seeds: Sequence[int]) -> Section:
    """Compare every peer on the same cases."""
    tables, bars, figures, apart = [], [], {}, {}
    for outliers in OUTLIERS:
        cases = [room_case(seed, outliers=outliers) for seed in seeds]
        answers = {name: ask(solver, cases) for name, solver in PEERS.items()}
        found = {name: figures_of(given, cases) for name, given in answers.items()}
        apart[percent(outliers, 0)] = backends_apart(answers["default"], answers["default, OpenCV's RANSAC"])
        figures[percent(outliers, 0)] = {name: asdict(f) for name, f in found.items()}
        rows = [
            (
                name,
                percent(f.success),
                f"{number(f.efficiency)} ± {number(f.efficiency_error)}",
                number(f.consistency),
                number(f.position_mm),
                number(f.milliseconds),
            )
            for name, f in found.items()
        ]
        heads = ("success", "efficiency", "consistency", "median mm", "median ms")
        tables.append((f"{percent(outliers, 0)} mismatches", table(heads, rows)))
        best, where = found["default"], f"room, {percent(outliers, 0)} mismatches"
        bars += [
            Bar(f"{where}: success, %", 100 * best.success, least=99 if outliers <= 0.5 else 98, digits=1),
            Bar(
                f"{where}: efficiency",
                best.efficiency,
                least=0.85 if outliers <= 0.5 else 0.8,
                error=best.efficiency_error,
            ),
            Bar(f"{where}: consistency", best.consistency, least=0.9, most=1.1),
        ]
    if HAS_POSELIB:
        rows = [
            (name, percent(float(np.mean(d <= SAME_SIGMAS))), number(float(d.max()), 3)) for name, d in apart.items()
        ]
        tables.append(
            (
                "The default's answers with poselib's RANSAC and with OpenCV's, beside each other",
                table((f"the same to {SAME_SIGMAS} sigma", "furthest apart, sigmas"), rows),
            )
        )
    return Section(
        "mismatches",
        "Among mismatches (room, n = 200, baseline .5 m)",
        "Success: within 6 sigmas of the truth, by the Cramer-Rao bound of the true matches. Efficiency: the bound's "
        "variance over the empirical one, mean of the six parameters, over the successes, with its standard error. "
        "Consistency: RMS Mahalanobis distance / sqrt 6 by the reported covariance. The peers know the pixels' "
        "noise (their threshold is 6 sigma) and not the ranges'; where stated, they are given the true inliers.",
        tuple(tables),
        tuple(bars),
        {"peers": figures, "backends_apart_sigmas": apart},
    )


def backends_apart(ours: Answers, others: Answers) -> np.ndarray:
    """Return the distance in sigmas between two poses of each case (N,); infinite where only one was found."""
    found = []
    for a, b in zip(ours.found, others.found, strict=True):
        if a is None or b is None or a[1] is None:
            found.append(0.0 if a is b else np.inf)
        else:
            found.append(length_in_sigmas(difference(a[0], b[0]), a[1]))
    return np.array(found)


def times_section(seeds: Sequence[int]) -> Section:
    """Measure the time of every peer."""
    rows, figures = [], {}
    cases = {n: [room_case(seed, count=n, outliers=TIMED_OUTLIERS) for seed in seeds[:TIMED_CASES]] for n in COUNTS}
    for name, solver in PEERS.items():
        spent = {n: milliseconds(solver, cases[n]) for n in COUNTS}
        figures[name] = {str(n): {"best": ms.min(), "median": np.median(ms)} for n, ms in spent.items()}
        rows.append((name, *(f"{number(ms.min())} / {number(float(np.median(ms)))}" for ms in spent.values())))
    rates = {cost.__name__: evaluations_per_second(cost) for cost in (stereo_cost, epipolar_cost)}
    return Section(
        "times",
        f"Times (room, {percent(TIMED_OUTLIERS, 0)} mismatches, one core)",
        f"Best / median over {len(cases[200])} cases, ms; each case is solved {TIMED_ROUNDS} times and the quickest "
        "counts. It is the processor's time, so that other work does not count. The default's includes its "
        "covariance, its verdict, and the questions whether another pose or another camera explains the matches.",
        (
            ("", table([f"n = {n}" for n in COUNTS], rows)),
            (
                "Evaluations of the simplices' objectives, n = 200",
                table(("a second",), [(name, number(rate, 0)) for name, rate in rates.items()]),
            ),
        ),
        (
            Bar("time at n = 200, median, ms", figures["default"]["200"]["median"], most=10),
            Bar(
                "stereo-simplex objective, n = 200, evaluations a second", rates["stereo_cost"], least=60_000, digits=0
            ),
        ),
        {"milliseconds": figures, "evaluations_per_second": rates},
    )


def milliseconds(solver: Solver, cases: Sequence[Case]) -> np.ndarray:
    """Return the processor time of each case (N,), the least of some rounds, since other load only slows it down."""
    solver(cases[0])
    found = []
    for case in cases:
        rounds = []
        for _ in range(TIMED_ROUNDS):
            begin = time.process_time()
            solver(case)
            rounds.append(time.process_time() - begin)
        found.append(1000 * min(rounds))
    return np.array(found)


def evaluations_per_second(
    cost: Callable[[StereoPairs], Callable[[np.ndarray], float]], *, rounds: int = 15, count: int = 2000
) -> float:
    """Return the best time of some rounds on 200 matches of the room."""
    case = room_case(0)
    pairs = StereoPairs.of(case.matches, case.camera)
    evaluate, x = cost(pairs), pairs.parameters(case.pose)
    seconds = []
    for _ in range(rounds):
        begin = time.process_time()
        for _ in range(count):
            evaluate(x)
        seconds.append(time.process_time() - begin)
    return count / min(seconds)


def _simplex(method: str) -> Solver:
    def solve(case: Case) -> tuple[Rigid, np.ndarray | None] | None:
        return default(case, method=method)

    return solve


def placement_section(seeds: Sequence[int]) -> Section:
    """Compare baselines from zero to half a metre."""
    slow: dict[str, Solver] = {
        "stereo-simplex": _simplex("stereo_simplex"),
        "epipolar-simplex": _simplex("epipolar_simplex"),
    }
    solvers: dict[str, Solver] = {
        **slow,
        **({"poselib RANSAC + bundle": poselib_peer} if HAS_POSELIB else {}),
        "OpenCV RANSAC + refineLM": opencv_peer,
        "default": default,
    }
    fewer = len(first_third(seeds))
    found: dict[str, list[float]] = {name: [] for name in solvers}
    for baseline_m, direction in BASELINES.values():
        cases = [room_case(seed, count=150, baseline_m=baseline_m, direction=direction) for seed in seeds]
        for name, solver in solvers.items():
            found[name].append(measure(solver, cases[:fewer] if name in slow else cases).position_mm)
    return Section(
        "placement",
        "Placement (room, n = 150, no mismatches)",
        "Median error of the camera's position, mm, by the distance between scanner and camera. The simplices begin "
        f"where they would without a hint and run on the first {fewer} cases only, since they are slow.",
        (("", table(tuple(BASELINES), [(name, *(number(mm, 1) for mm in row)) for name, row in found.items()])),),
        (Bar("identical placement: median mm", found["default"][0], most=2.5),),
        {name: dict(zip(BASELINES, row, strict=True)) for name, row in found.items()},
    )
