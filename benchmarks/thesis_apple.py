"""Table 3.1: the apple by every method, before and after rejection."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks import plots
from benchmarks import thesis_printed as printed
from benchmarks.apple import APPLE_READINGS, APPLE_TRUTH, THESIS_START, apple_case, apple_error_percent
from benchmarks.case import Case
from benchmarks.peers import default, known_inliers, poselib_peer
from benchmarks.plots import ACCENT, BAD, DIM, INK, PINK, VIOLET, YELLOW, Bar, columns, field_width
from benchmarks.table_3_1 import THRESHOLD_M
from ladarreg_core.export.comparison_table import NOTHING, Table, markdown_table
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.thesis.stereo_simplex import Residual, SimplexFit, SimplexOptions, fit_simplex

PARAMETERS = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
SHOWN_READING, SHOWN_SEED = "B", 0
"""The run that is shown in full: the reading that fits the thesis's text best."""
SMOOTHED_READING = "C"
READING_WORDS = {
    "A": "A: radius 1, depth 4 to 6, f=256 px",
    "B": "B: radius 3, depth 2 to 8, f=128 px",
    "C": "C: radius 3, f=256 px, all spikes ± 3",
}
PRINTED = (printed.mean_percent(printed.APPLE_BEFORE_PERCENT), printed.mean_percent(printed.APPLE_AFTER_PERCENT))


def six(pose: Rigid) -> np.ndarray:
    """Return Tx, Ty, Tz (m) and alpha, beta, gamma (deg)."""
    p = ThesisParameters.from_pose(pose)
    return np.array([p.Tx, p.Ty, p.Tz, *np.degrees([p.alpha, p.beta, p.gamma])])


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return markdown_table(Table(heads=tuple(heads), rows=tuple(tuple(row) for row in rows)))


BeforeAndAfter = tuple[Rigid | None, Rigid | None]


def _pose(found: tuple[Rigid, object] | None) -> Rigid | None:
    return found[0] if found else None


def by_linear(case: Case) -> BeforeAndAfter:
    """All points; then those that the default keeps, for it rejects nothing itself."""
    kept = solve_pose(case.matches, case.camera, stated(case)).inliers
    return _pose(default(case, method="linear")), _pose(
        default(case, matches=case.matches.subset(kept), method="linear")
    )


def by_simplex(residual: Residual, threshold_m: float | None) -> Callable[[Case], BeforeAndAfter]:
    def solve(case: Case) -> BeforeAndAfter:
        fit = fit_simplex(
            case.matches,
            case.camera,
            simplex_options(residual, threshold_m),
            initial=THESIS_START,
            sigma_px=case.sigma_px,
        )
        return fit.before.camera_from_scanner, fit.after.camera_from_scanner

    return solve


def by_default(case: Case) -> BeforeAndAfter:
    """The same cost without its gate, and with it."""
    return _pose(default(case, gate_chi2=1e6)), _pose(default(case))


def stated(case: Case) -> PoseOptions:
    return PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)


def simplex_options(residual: Residual, threshold_m: float | None) -> SimplexOptions:
    return SimplexOptions(residual=residual, reject_depth_m=threshold_m)


METHODS: dict[str, Callable[[Case], BeforeAndAfter]] = {
    "linear": by_linear,
    "stereo-simplex": by_simplex("stereo", THRESHOLD_M),
    "epipolar-simplex": by_simplex("epipolar", None),
    "poselib": lambda case: (None, _pose(poselib_peer(case))),
    "default": by_default,
    "true inliers known": lambda case: (None, _pose(known_inliers(case))),
}
COLOURS = {
    "linear": DIM,
    "stereo-simplex": YELLOW,
    "epipolar-simplex": VIOLET,
    "poselib": PINK,
    "default": ACCENT,
    "true inliers known": INK,
}
_UNTIL_PERCENT = (0.3, 300.0)


def table_3_1(seeds: int) -> dict[tuple[str, str], np.ndarray]:
    """Return the mean |error| % of every seed before and after rejection, (N, 2), by method and reading."""
    figures = {}
    for method, solve in METHODS.items():
        if method == "poselib" and importlib.util.find_spec("poselib") is None:
            continue
        for reading in APPLE_READINGS:
            found = [solve(apple_case(reading, seed)) for seed in range(seeds)]
            figures[method, reading] = np.array(
                [[np.nan if pose is None else apple_error_percent(pose) for pose in pair] for pair in found]
            )
        print(f"Table 3.1, {method}: done")
    return figures


def _medians(errors: np.ndarray) -> tuple[float, float]:
    """Return median and 95th percentile; NaN where the method has no such answer."""
    known = errors[np.isfinite(errors)]
    return (float(np.median(known)), float(np.percentile(known, 95))) if len(known) else (np.nan, np.nan)


def table_3_1_text(figures: dict[tuple[str, str], np.ndarray]) -> str:
    def cell(errors: np.ndarray) -> str:
        middle, p95 = _medians(errors)
        return f"{middle:.2f} / {p95:.1f}" if np.isfinite(middle) else NOTHING

    methods = list(dict.fromkeys(method for method, _ in figures))
    rows = [
        [method, *(cell(figures[method, reading][:, k]) for reading in APPLE_READINGS for k in (0, 1))]
        for method in methods
    ]
    rows.append(["thesis, printed (one run)", *(f"{PRINTED[k]:.2f}" for _ in APPLE_READINGS for k in (0, 1))])
    for method in ("stereo-simplex", "default"):
        shares = [np.mean(figures[method, r][:, k] <= PRINTED[k]) for r in APPLE_READINGS for k in (0, 1)]
        rows.append([f"runs of the {method} as good as the printed one", *(f"{100 * s:.1f} %" for s in shares)])
    heads = [f"{reading}, {when}" for reading in APPLE_READINGS for when in ("all points", "rejected")]
    return markdown(heads, rows)


def table_3_1_picture(figures: dict[tuple[str, str], np.ndarray], seeds: int) -> np.ndarray:
    rows = []
    for k, when in enumerate(("all points", "outliers rejected")):
        blocks = []
        for reading in APPLE_READINGS:
            bars = []
            for (method, of), errors in figures.items():
                middle, p95 = _medians(errors[:, k])
                if of == reading and np.isfinite(middle):
                    bars.append(Bar(method, middle, p95, COLOURS[method]))
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


def single_run_text(case: Case, fit: SimplexFit) -> str:
    best = solve_pose(case.matches, case.camera, stated(case))
    truth = six(APPLE_TRUTH.pose)
    ours = [six(pose) for pose in (fit.before.camera_from_scanner, fit.after.camera_from_scanner)]
    answers = [printed.APPLE_BEFORE, printed.APPLE_AFTER, *ours, six(best.camera_from_scanner)]
    rows = []
    for k, name in enumerate(PARAMETERS):
        cells = [f"{a[k]:.4f} ({100 * (a[k] / truth[k] - 1):+.2f} %)" for a in answers]
        rows.append([name + (", deg" if k > 2 else ""), f"{truth[k]:.4f}", *cells])
    percent = [100 * np.mean(np.abs(np.array(a) / truth - 1)) for a in answers]
    rows.append(["mean error", "", *(f"{p:.2f} %" for p in percent)])
    kept = [
        *printed.APPLE_POINTS,
        *(int(end.inliers.sum()) for end in (fit.before, fit.after)),
        int(best.inliers.sum()),
    ]
    rows.append(["points", "", *map(str, kept)])
    heads = ("actual", "thesis, all points", "thesis, rejected", "ours, all points", "ours, rejected", "default")
    return markdown(heads, rows)
