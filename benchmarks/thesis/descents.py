"""Figures 3.2 to 3.4 and 3.9: convergence of the simplex, and the remaining depth errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.shared import plots
from benchmarks.shared.plots import ACCENT, BAD, WARN, Plot, columns, field_width
from benchmarks.thesis.apple import PARAMETERS, SHOWN_READING, SHOWN_SEED, six
from benchmarks.thesis.table_3_1 import THRESHOLD_M
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.diagnostics import stereo_depth_error
from ladarreg_core.thesis.estimators.stereo import StereoPairs
from ladarreg_core.thesis.estimators.stereo_simplex import DescentStep, SimplexFit, SimplexOptions, descend
from testing.scenes.pose_case import Case


@dataclass(frozen=True)
class Convergence:
    """All iterations of a descent."""

    parameters: np.ndarray
    """(K, 6) of the best vertex: Tx, Ty, Tz (m), alpha, beta, gamma (deg)."""
    cost: np.ndarray
    """(K,)"""
    rejections: np.ndarray
    """First iterations of the rounds after a rejection."""
    last: DescentStep

    @property
    def kept(self) -> str:
        return f"{int(self.last.inliers.sum())} of {len(self.last.inliers)}"


def convergence(
    matches: Matches, camera: Camera, options: SimplexOptions, start: Rigid | None, sigma: float
) -> Convergence:
    steps = list(descend(matches, camera, options, initial=start, sigma_px=sigma))
    rounds = np.array([(step.restart, step.round) for step in steps])
    begins = 1 + np.flatnonzero((np.diff(rounds, axis=0) != 0).any(axis=1))
    return Convergence(
        np.array([six(step.camera_from_scanner) for step in steps]),
        np.array([step.simplex.cost for step in steps]),
        begins,
        steps[-1],
    )


def convergence_picture(found: Convergence, truth: np.ndarray, title: str, note: str, unit: str) -> np.ndarray:
    steps = np.arange(1, len(found.cost) + 1)
    span = (1.0, float(len(steps)))
    blocks = []
    for k, name in enumerate(PARAMETERS):
        values = found.parameters[:, k]
        y = plots.spread_of(values, truth[k : k + 1])
        plot = Plot(field_width(3), 190, span, y, f"{name}, {unit if k < 3 else 'deg'}")
        for step in found.rejections:
            plot.vertical(step + 1, plots.FAINT, 1)
        plot.horizontal(truth[k], WARN, dashed=True, name="truth")
        plot.curve(steps, values, ACCENT)
        blocks.append(plot.block())
    wide = bool(found.cost.max() > 10 * found.cost.min())
    y = (float(found.cost.min()) * 0.7, float(found.cost.max()) * 1.4) if wide else (0.0, float(found.cost.max()) * 1.1)
    cost = Plot(field_width(1), 220, span, y, f"Cost, {unit} squared", "iteration", log_y=wide)
    for step in found.rejections:
        cost.vertical(step + 1, plots.FAINT, 1, name="matches rejected, and on from there")
    cost.curve(steps, found.cost, ACCENT)
    return plots.page(
        title, note, [columns(blocks[:3]), columns(blocks[3:]), columns([cost.block(number="{:g}".format)])]
    )


def depth_errors(case: Case, pose: Rigid) -> np.ndarray:
    """Return the error (M,) by which the thesis rejects, with the sign of laser minus stereo."""
    pairs = StereoPairs.of(case.matches, case.camera)
    signed = stereo_depth_error(pose, case.matches, case.camera, sigma_px=case.sigma_px)
    return np.copysign(pairs.depth_errors(pairs.parameters(pose)), np.where(np.isfinite(signed), signed, 1.0))


def depth_error_picture(case: Case, fit: SimplexFit) -> np.ndarray:
    everything = np.ones(len(case.true), bool)
    blocks = []
    for title, end, kept in (
        ("Figure 3.3: all points", fit.before, everything),
        ("Figure 3.4: outliers rejected, and solved again", fit.after, fit.after.inliers),
    ):
        errors = depth_errors(case, end.camera_from_scanner)
        plot = Plot(field_width(1), 230, (-2.0, len(errors) + 1.0), (-4.2, 4.2), title, "vertex")
        for sign in (1, -1):
            plot.horizontal(sign * THRESHOLD_M, WARN, dashed=True, name=f"threshold, {THRESHOLD_M:g}")
        for name, color, mine in (("spikes", BAD, ~case.true), ("other vertices", ACCENT, case.true)):
            index = np.flatnonzero(mine & kept)
            plot.stems(index, errors[index], color, name=name)
        blocks.append(columns([plot.block()]))
    note = (
        "Laser depth against both stereo depths, sqrt((Zl - Zxs)^2 + (Zl - Zys)^2) with the sign of laser minus "
        f"stereo, in the apple's units (reading {SHOWN_READING}, seed {SHOWN_SEED}). "
        f"{int(fit.after.inliers.sum())} of {len(case.true)} vertices are kept; values beyond the plot stand at its "
        "edge."
    )
    return plots.page("Figures 3.3 and 3.4: depth errors of the apple", note, blocks)
