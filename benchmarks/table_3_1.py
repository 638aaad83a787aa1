"""Table 3.1 of the thesis, the apple in its three readings, by every method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks import thesis_printed as printed
from benchmarks.apple import APPLE_READINGS, apple_case, apple_error_percent
from benchmarks.case import first_third
from benchmarks.peers import PEERS, Solver, linear, simplex_poses
from benchmarks.pose_report import Bar, Section, number, table
from ladarreg_core.pose.thesis.stereo_simplex import Residual

THRESHOLD_M = 0.5
"""Of the stereo-simplex's depth errors; from .35 to .7 the results are the same."""
STEREO_MOST = {"A": 5.2, "B": 2.5, "C": 2.0}
_OF_KNOWN = 1.1
_RESAMPLED = 400
_SOLVERS: dict[str, Solver] = {
    "linear": linear,
    **{
        name: peer
        for name, peer in PEERS.items()
        if not name.startswith(("our RANSAC", "OpenCV EPnP", "default, OpenCV"))
    },
}


def simplex_apple_figures(
    residual: Residual, reading: str, seeds: Sequence[int], threshold: float | None
) -> np.ndarray:
    """Mean |error| % of every seed, (N, 2): all points, outliers rejected."""
    errors = []
    for seed in seeds:
        poses = simplex_poses(apple_case(reading, seed), residual, threshold_m=threshold)
        errors.append([apple_error_percent(pose) for pose in poses])
    return np.array(errors)


def apple_errors(solver: Solver, reading: str, seeds: Sequence[int]) -> np.ndarray:
    """Mean |error| % of every seed (N,); infinite where there is no pose."""
    found = [solver(apple_case(reading, seed)) for seed in seeds]
    return np.array([apple_error_percent(f[0]) if f else np.inf for f in found])


def apple_figures(solver: Solver, reading: str, seeds: int) -> tuple[float, float]:
    """Median and 95th percentile of the mean |error| %, over seeds."""
    return median_and_p95(apple_errors(solver, reading, range(seeds)))


def median_and_p95(errors: np.ndarray) -> tuple[float, float]:
    how = "linear" if np.isfinite(errors).all() else "higher"  # between a number and no pose lies nothing
    return float(np.median(errors)), float(np.percentile(errors, 95, method=how))  # type: ignore[call-overload]


def table_3_1_section(seeds: Sequence[int]) -> Section:
    """Every method from the thesis's start, or from none where it needs none."""
    errors: dict[str, dict[str, np.ndarray]] = {}
    fewer = first_third(seeds)
    for reading in APPLE_READINGS:
        for name, solver in _SOLVERS.items():
            errors.setdefault(name, {})[reading] = apple_errors(solver, reading, seeds)
        for residual, threshold, those in (("stereo", THRESHOLD_M, seeds), ("epipolar", None, fewer)):
            both = simplex_apple_figures(residual, reading, those, threshold)  # type: ignore[arg-type]
            errors.setdefault(f"{residual}-simplex, all points", {})[reading] = both[:, 0]
            errors.setdefault(f"{residual}-simplex, outliers rejected", {})[reading] = both[:, 1]
    found = {name: {r: median_and_p95(e) for r, e in of.items()} for name, of in errors.items()}
    rows = [
        (name, *(f"{number(middle)} / {number(p95, 1)}" for middle, p95 in of.values())) for name, of in found.items()
    ]
    before, after = (printed.mean_percent(p) for p in (printed.APPLE_BEFORE_PERCENT, printed.APPLE_AFTER_PERCENT))
    bars = [
        Bar(
            f"Table 3.1 {reading}: default's {what} over that of the true inliers known",
            ratio,
            most=_OF_KNOWN,
            error=off,
        )
        for reading in APPLE_READINGS
        for what, ratio, off in _ratios(errors["default"][reading], errors["default, true inliers known"][reading])
    ]
    bars += [
        Bar(
            f"Table 3.1 {reading}: stereo-simplex after rejection, median %",
            found["stereo-simplex, outliers rejected"][reading][0],
            most=most,
        )
        for reading, most in STEREO_MOST.items()
    ]
    return Section(
        "table_3_1",
        "Table 3.1: the apple",
        "Mean |error| of the six parameters, %: median / 95th percentile. A: radius 1, f = 256 px; B: radius 3, "
        "f = 128 px; C: radius 3, f = 256 px, all spikes ± 3. The simplices begin at T = (2, 0, 0) without rotation; "
        f"the stereo-simplex rejects at {THRESHOLD_M}, the epipolar one at its own threshold "
        f"(first {len(fewer)} cases). The thesis's single run: {before:.2f} before rejection, {after:.2f} after.",
        (("", table(tuple(APPLE_READINGS), rows)),),
        tuple(bars),
        {name: {r: {"median": middle, "p95": p95} for r, (middle, p95) in of.items()} for name, of in found.items()},
    )


def _ratios(ours: np.ndarray, best: np.ndarray) -> list[tuple[str, float, float]]:
    """The ratios of median and 95th percentile, with their standard errors by resampling the cases."""
    again = np.random.default_rng(0).integers(len(ours), size=(_RESAMPLED, len(ours)))
    ratios = np.array([np.divide(median_and_p95(ours[k]), median_and_p95(best[k])) for k in (range(len(ours)), *again)])
    scatter = ratios[1:].std(axis=0, ddof=1)
    return list(zip(("median", "95th percentile"), ratios[0].tolist(), scatter.tolist(), strict=True))
