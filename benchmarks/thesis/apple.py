"""The apple of Table 3.1 in one run, parameter by parameter, and helpers of the pages on the thesis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.thesis import printed as printed
from ladarreg_core.export.comparison.table import Table, markdown_table
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.thesis.estimators.stereo_simplex import Residual, SimplexFit, SimplexOptions
from testing.scenes.apple import APPLE_TRUTH
from testing.scenes.pose_case import Case

PARAMETERS = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
SHOWN_READING, SHOWN_SEED = "B", 0
"""The run that is shown in full: the reading that fits the thesis's text best."""
SMOOTHED_READING = "C"


def six(pose: Rigid) -> np.ndarray:
    """Return Tx, Ty, Tz (m) and alpha, beta, gamma (deg)."""
    p = ThesisParameters.from_pose(pose)
    return np.array([p.Tx, p.Ty, p.Tz, *np.degrees([p.alpha, p.beta, p.gamma])])


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return markdown_table(Table(heads=tuple(heads), rows=tuple(tuple(row) for row in rows)))


def stated(case: Case) -> PoseOptions:
    return PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)


def simplex_options(residual: Residual, threshold_m: float | None) -> SimplexOptions:
    return SimplexOptions(residual=residual, reject_depth_m=threshold_m)


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
