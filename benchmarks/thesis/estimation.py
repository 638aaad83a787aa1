"""The thesis's estimators in the room: convergence, accuracy, and distance from the default."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.pose.accuracy import BASELINES
from benchmarks.pose.report import Section, number, percent, table
from benchmarks.pose.starts import HOME_M
from benchmarks.thesis.table_3_1 import THRESHOLD_M
from ladarreg_core.errors import LadarregError
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from testing.scenes.accuracy import default
from testing.scenes.apple import APPLE_READINGS, THESIS_START, median_and_p95, simplex_apple_figures, simplex_poses
from testing.scenes.pose_case import Case, difference, picture_difference_px, start_near
from testing.scenes.room import room_case

METHODS = ("linear", "stereo_simplex", "epipolar_simplex")
_STARTS: dict[str, tuple[float, float] | None] = {
    "5 deg, .25 m": (5.0, 0.25),
    "10 deg, .5 m": (10.0, 0.5),
    "2 m left": None,
}
_MEDIAN_OVER_MEAN = 0.891  # of chi-squared with 6 degrees of freedom: median 5.35


def thresholds_section(seeds: Sequence[int]) -> Section:
    """Compare rejection thresholds on Table 3.1."""
    rows, figures = [], {}
    for residual, threshold in (("stereo", THRESHOLD_M), ("stereo", None), ("epipolar", None)):
        name = f"{residual}-simplex, {f'threshold {threshold}' if threshold else 'own threshold'}"
        found = {
            reading: median_and_p95(simplex_apple_figures(residual, reading, seeds, threshold)[:, 1])  # type: ignore[arg-type]
            for reading in APPLE_READINGS
        }
        figures[name] = {reading: {"median": middle, "p95": p95} for reading, (middle, p95) in found.items()}
        rows.append((name, *(f"{number(middle)} / {number(p95, 1)}" for middle, p95 in found.values())))
    return Section(
        "thesis_thresholds",
        "Table 3.1 by the rejection's threshold",
        "Mean |error| % after rejection, median / 95th percentile; from T = (2, 0, 0) without rotation.",
        (("", table(tuple(APPLE_READINGS), rows)),),
        (),
        figures,
    )


def descents_section(seeds: Sequence[int]) -> Section:
    """Compare one descent with restarts and rejection."""
    rows, figures = [], {}
    for name, far in _STARTS.items():
        for residual in ("stereo", "epipolar"):
            reached = np.zeros(2)
            for seed in seeds:
                case = room_case(seed)
                start = start_near(case, seed, *far) if far else THESIS_START
                for k, restarts in enumerate((0, 2)):
                    pose = simplex_poses(case, residual, start=start, restarts=restarts)[k]  # type: ignore[arg-type]
                    reached[k] += pose.distance_to(case.pose) < HOME_M
            shares = (reached / len(seeds)).tolist()
            rows.append((f"{residual}-simplex from {name}", *map(percent, shares)))
            figures[rows[-1][0]] = {"one_descent": shares[0], "restarts_and_rejection": shares[1]}
    return Section(
        "thesis_descents",
        "The simplices' starts (room, n = 200, no mismatches)",
        f"Share that ends within {100 * HOME_M:g} cm of the truth.",
        (("", table(("one descent", "restarts and rejection"), rows)),),
        (),
        figures,
    )


def own_start_section(seeds: Sequence[int]) -> Section:
    """Run without an initial pose, by share of outliers and by baseline."""
    heads = ("median mm", "accepted", "consistency")
    tables, figures = [], {}
    among = {
        f"{percent(outliers, 0)} mismatches, {method}": ([room_case(seed, outliers=outliers) for seed in seeds], method)
        for outliers in (0.0, 0.1, 0.3)
        for method in METHODS
    }
    apart = {
        f"{name}, {method}": ([room_case(s, count=150, baseline_m=metres, direction=way) for s in seeds], method)
        for name, (metres, way) in BASELINES.items()
        for method in METHODS[1:]
    }
    for caption, settings in (("n = 200", among), ("n = 150, no mismatches, by the baseline", apart)):
        rows = []
        for name, (cases, method) in settings.items():
            millimetres, accepted, consistency = _reached(cases, method)
            rows.append((name, number(millimetres), percent(accepted), number(consistency)))
            figures[name] = {"position_mm": millimetres, "accepted": accepted, "consistency": consistency}
        tables.append((caption, table(heads, rows)))
    return Section(
        "thesis_own_start",
        "The thesis's estimators from their own start (room)",
        "Consistency: root of the median squared Mahalanobis distance over what chance gives.",
        tuple(tables),
        (),
        figures,
    )


def _reached(cases: Sequence[Case], method: str) -> tuple[float, float, float]:
    position, accepted, distance = [], 0, []
    for case in cases:
        options = PoseOptions(method=method, sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)  # type: ignore[arg-type]
        try:
            result = solve_pose(case.matches, case.camera, options)
        except LadarregError:
            position.append(np.inf)
            continue
        step = difference(case.pose, result.camera_from_scanner)
        position.append(float(np.linalg.norm(step[3:])))
        accepted += result.accepted
        distance.append(step @ np.linalg.solve(result.covariance, step) / 6)
    consistency = float(np.sqrt(np.median(distance) / _MEDIAN_OVER_MEAN)) if distance else np.nan
    return 1000 * float(np.median(position)), accepted / len(cases), consistency


def near_default_section(seeds: Sequence[int]) -> Section:
    """Measure the distance of the thesis's poses from the default's, from good matches."""
    gaps: dict[str, list[tuple[float, float]]] = {}
    for seed in seeds:
        baseline = float(np.random.default_rng([seed, 9]).uniform(0.3, 1.0))
        case = room_case(seed, count=150, sigma_px=0.3, sigma_range_m=0.005, baseline_m=baseline, direction=(0, 1, 0.1))
        best = default(case)
        if best is None:
            continue
        for method in METHODS:
            found = default(case, method=method)
            if found:
                gap = picture_difference_px(case, found[0], best[0]), 1000 * found[0].distance_to(best[0])
                gaps.setdefault(method, []).append(gap)
    rows, figures = [], {}
    for method, of in gaps.items():
        (px, mm), worst = np.median(of, axis=0).tolist(), float(np.max(of, axis=0)[0])
        rows.append((method, number(px, 3), number(worst), number(mm)))
        figures[method] = {"median_px": px, "worst_px": worst, "median_mm": mm}
    return Section(
        "thesis_near_default",
        "From good matches, beside the default (n = 150, .3 px, 5 mm, baseline .3 to 1 m)",
        "How far the points lie apart in the photo, and the cameras in the room.",
        (("", table(("median px", "worst px", "median mm"), rows)),),
        (),
        figures,
    )


THESIS_SECTIONS = (thresholds_section, descents_section, own_start_section, near_default_section)
