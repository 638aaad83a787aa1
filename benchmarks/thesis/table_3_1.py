"""Table 3.1 of the thesis: the apple in its three readings by every method, before and after rejection."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from benchmarks.pose.peers import PEERS, linear
from benchmarks.pose.report import Bar, Section, first_third, number, table
from benchmarks.shared import plots
from benchmarks.shared.plots import ACCENT, BAD, DIM, INK, PINK, VIOLET, YELLOW, columns, field_width
from benchmarks.thesis import printed as printed
from benchmarks.thesis.apple import markdown, stated
from ladarreg_core.export.comparison.table import NOTHING
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.estimate import solve_pose
from ladarreg_core.thesis.estimators.stereo_simplex import Residual
from testing.scenes.accuracy import Solver, default
from testing.scenes.apple import APPLE_READINGS, apple_case, apple_error_percent, median_and_p95, simplex_poses
from testing.scenes.pose_case import Case

THRESHOLD_M = 0.5
"""Rejection threshold of the stereo-simplex on depth errors; from .35 to .7 the results are the same."""
STEREO_MOST = {"A": 5.2, "B": 2.5, "C": 2.0}
"""Bar for the median error of the stereo-simplex after rejection, %."""
READING_WORDS = {
    "A": "A: radius 1, depth 4 to 6, f=256 px",
    "B": "B: radius 3, depth 2 to 8, f=128 px",
    "C": "C: radius 3, f=256 px, all spikes ± 3",
}
PRINTED = (printed.mean_percent(printed.APPLE_BEFORE_PERCENT), printed.mean_percent(printed.APPLE_AFTER_PERCENT))
"""Mean error printed in the thesis, %: all points, outliers rejected."""
_MAX_OVER_TRUE_INLIERS = 1.1
_RESAMPLED = 400
_UNTIL_PERCENT = (0.3, 300.0)

BeforeAndAfter = tuple[Rigid | None, Rigid | None]
Errors = dict[tuple[str, str], np.ndarray]
"""Mean |error|, %, by method and reading: (N, 2) before and after rejection; infinite where a method finds no pose, NaN
for a side that it does not have."""


def _pose(answer: tuple[Rigid, object] | None) -> Rigid | None:
    return answer[0] if answer else None


def by_linear(case: Case) -> BeforeAndAfter:
    """Solve from all points; then from the inliers of the default, since the linear method rejects nothing itself."""
    kept = solve_pose(case.matches, case.camera, stated(case)).inliers
    return _pose(linear(case)), _pose(default(case, matches=case.matches.subset(kept), method="linear"))


def by_simplex(residual: Residual, threshold_m: float | None) -> Callable[[Case], BeforeAndAfter]:
    return lambda case: simplex_poses(case, residual, threshold_m=threshold_m)


def by_default(case: Case) -> BeforeAndAfter:
    """Solve with the same cost without its rejection, and with it."""
    return _pose(default(case, gate_chi2=1e6)), _pose(default(case))


def _after_only(solver: Solver) -> Callable[[Case], BeforeAndAfter]:
    return lambda case: (None, _pose(solver(case)))


METHODS: dict[str, Callable[[Case], BeforeAndAfter]] = {
    "linear": by_linear,
    "stereo-simplex": by_simplex("stereo", THRESHOLD_M),
    "epipolar-simplex": by_simplex("epipolar", None),
    **{
        name: _after_only(peer)
        for name, peer in PEERS.items()
        if not name.startswith(("our RANSAC", "OpenCV EPnP", "default, OpenCV"))
    },
    "default": by_default,
}
_BOTH_SIDES = ("linear", "stereo-simplex", "epipolar-simplex", "default")
THESIS_METHODS = {
    "linear": ("linear", DIM),
    "stereo-simplex": ("stereo-simplex", YELLOW),
    "epipolar-simplex": ("epipolar-simplex", VIOLET),
    "poselib RANSAC + bundle": ("poselib", PINK),
    "default": ("default", ACCENT),
    "default, true inliers known": ("true inliers known", INK),
}
"""Methods of the table on the thesis, with label and colour."""


def table_3_1(seeds: Sequence[int], methods: Iterable[str] = METHODS) -> Errors:
    """Return the errors of these methods on the apple; one that is not installed is left out."""
    errors = {}
    for method in methods:
        if method not in METHODS:
            continue
        for reading in APPLE_READINGS:
            pairs = [METHODS[method](apple_case(reading, seed)) for seed in seeds]
            found = [[np.inf if pose is None else apple_error_percent(pose) for pose in pair] for pair in pairs]
            errors[method, reading] = np.array(found)
            if method not in _BOTH_SIDES:
                errors[method, reading][:, 0] = np.nan
        print(f"Table 3.1, {method}: done")
    return errors


def table_3_1_section(seeds: Sequence[int]) -> Section:
    """Every method from the thesis's start, or from none where it needs none."""
    fewer = first_third(seeds)
    slow = "epipolar-simplex"
    errors = table_3_1(seeds, [m for m in METHODS if m != slow]) | table_3_1(fewer, [slow])
    columns_of: dict[str, tuple[str, int]] = {}
    for method in METHODS:
        if method.endswith("simplex"):
            columns_of |= {f"{method}, all points": (method, 0), f"{method}, outliers rejected": (method, 1)}
        else:
            columns_of[method] = (method, 0 if method == "linear" else 1)
    found = {
        name: {reading: median_and_p95(errors[method, reading][:, side]) for reading in APPLE_READINGS}
        for name, (method, side) in columns_of.items()
    }
    rows = [
        (name, *(f"{number(middle)} / {number(p95, 1)}" for middle, p95 in of.values())) for name, of in found.items()
    ]
    bars = [
        Bar(
            f"Table 3.1 {reading}: default's {what} over that of the true inliers known",
            ratio,
            most=_MAX_OVER_TRUE_INLIERS,
            error=off,
        )
        for reading in APPLE_READINGS
        for what, ratio, off in _ratios(
            errors["default", reading][:, 1], errors["default, true inliers known", reading][:, 1]
        )
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
        "f = 128 px; C: radius 3, f = 256 px, all spikes ± 3. The simplices start at T = (2, 0, 0) without rotation; "
        f"the stereo-simplex rejects at {THRESHOLD_M}, the epipolar one at its own threshold "
        f"(first {len(fewer)} cases). The thesis's single run: {PRINTED[0]:.2f} before rejection, "
        f"{PRINTED[1]:.2f} after.",
        (("", table(tuple(APPLE_READINGS), rows)),),
        tuple(bars),
        {name: {r: {"median": middle, "p95": p95} for r, (middle, p95) in of.items()} for name, of in found.items()},
    )


def _ratios(ours: np.ndarray, best: np.ndarray) -> list[tuple[str, float, float]]:
    """Return the ratios of median and 95th percentile, with their standard errors by resampling the cases."""
    again = np.random.default_rng(0).integers(len(ours), size=(_RESAMPLED, len(ours)))
    ratios = np.array([np.divide(median_and_p95(ours[k]), median_and_p95(best[k])) for k in (range(len(ours)), *again)])
    scatter = ratios[1:].std(axis=0, ddof=1)
    return list(zip(("median", "95th percentile"), ratios[0].tolist(), scatter.tolist(), strict=True))


def table_3_1_text(errors: Errors) -> str:
    """Return the table of the thesis's methods as Markdown."""

    def cell(values: np.ndarray) -> str:
        if np.isnan(values).any():
            return NOTHING
        middle, p95 = median_and_p95(values)
        return f"{middle:.2f} / {p95:.1f}"

    rows = [
        [
            THESIS_METHODS[method][0],
            *(cell(errors[method, reading][:, k]) for reading in APPLE_READINGS for k in (0, 1)),
        ]
        for method in dict.fromkeys(method for method, _ in errors)
    ]
    rows.append(["thesis, printed (one run)", *(f"{PRINTED[k]:.2f}" for _ in APPLE_READINGS for k in (0, 1))])
    for method in ("stereo-simplex", "default"):
        shares = [np.mean(errors[method, r][:, k] <= PRINTED[k]) for r in APPLE_READINGS for k in (0, 1)]
        rows.append([f"runs of the {method} as good as the printed one", *(f"{100 * s:.1f} %" for s in shares)])
    heads = [f"{reading}, {when}" for reading in APPLE_READINGS for when in ("all points", "rejected")]
    return markdown(heads, rows)


def table_3_1_picture(errors: Errors, seeds: int) -> np.ndarray:
    """Return the table of the thesis's methods as a picture."""
    rows = []
    for k, when in enumerate(("all points", "outliers rejected")):
        blocks = []
        for reading in APPLE_READINGS:
            bars = []
            for (method, of), values in errors.items():
                if of == reading and not np.isnan(values[:, k]).any():
                    label, color = THESIS_METHODS[method]
                    bars.append(plots.Bar(label, *median_and_p95(values[:, k]), color))
            blocks.append(
                plots.strips(
                    f"{reading}, {when}",
                    bars,
                    x=_UNTIL_PERCENT,
                    marks=[(PRINTED[k], BAD, f"printed: {PRINTED[k]:.2f} %")],
                    width=field_width(3, left=168),
                    left=168,
                    label="mean |error| of the six parameters, %",
                )
            )
        rows.append(columns(blocks))
    note = (
        f"Median (dot) and 95th percentile (end of the line) over {seeds} seeds, in the three readings of what the "
        "text says of the apple. " + ".  ".join(READING_WORDS.values()) + "."
    )
    return plots.page("Table 3.1: the apple", note, rows)
