"""The thesis's results and ours on one page: python -m benchmarks.thesis [--seeds N] [--scene-seeds N] [--out DIR].

Table 3.1 in its three readings, Figures 3.2 to 3.5 on the apple, Figure 3.9 and Tables 3.2 to 3.5 on simulated scenes.
Writes `DIR/thesis-results.md` and its pictures in `DIR/thesis-results/`.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import plots
from benchmarks import thesis_printed as printed
from benchmarks.plots import ACCENT, BAD, DIM, INK, PINK, VIOLET, WARN, YELLOW, Bar, Plot, columns, field_width
from benchmarks.pose import (
    APPLE_READINGS,
    APPLE_TRUTH,
    THESIS_START,
    Case,
    apple_case,
    apple_error_percent,
    apple_points,
    default,
    known_inliers,
    poselib_peer,
    room_case,
)
from benchmarks.register import errors as scene_errors
from ladarreg_core.camera import Camera
from ladarreg_core.comparison import Column, Comparison, compare
from ladarreg_core.errors import LadarregError
from ladarreg_core.export.comparison_table import NOTHING, TITLES, Table, comparison_table, markdown_table
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters, rotation_about
from ladarreg_core.matches import Matches
from ladarreg_core.pose.diagnostics import stereo_depth_error
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.stereo import StereoPairs
from ladarreg_core.pose.stereo_simplex import DescentStep, Residual, SimplexFit, SimplexOptions, descend, fit_simplex
from ladarreg_core.simulate import SCENES, SimulatedCase, simulate_case
from ladarreg_core.smoothing import SmoothOptions, smooth_ranges

PARAMETERS = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
THRESHOLD_M = 0.5
"""Of the apple's depth errors; from .35 to .7 the results are the same."""
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


# --- Table 3.1 -------------------------------------------------------------------------------------------------------

BeforeAndAfter = tuple[Rigid | None, Rigid | None]


def _pose(found: tuple[Rigid, object] | None) -> Rigid | None:
    return found[0] if found else None


def by_linear(case: Case) -> BeforeAndAfter:
    """All points; then those that the default keeps, for it rejects nothing itself."""
    kept = solve_pose(case.matches, case.camera, _stated(case)).inliers
    return _pose(default(case, method="linear")), _pose(
        default(case, matches=case.matches.subset(kept), method="linear")
    )


def by_simplex(residual: Residual, threshold_m: float | None) -> Callable[[Case], BeforeAndAfter]:
    def solve(case: Case) -> BeforeAndAfter:
        fit = fit_simplex(
            case.matches, case.camera, _simplex(residual, threshold_m), initial=THESIS_START, sigma_px=case.sigma_px
        )
        return fit.before.camera_from_scanner, fit.after.camera_from_scanner

    return solve


def by_default(case: Case) -> BeforeAndAfter:
    """The same cost without its gate, and with it."""
    return _pose(default(case, gate_chi2=1e6)), _pose(default(case))


def _stated(case: Case) -> PoseOptions:
    return PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)


def _simplex(residual: Residual, threshold_m: float | None) -> SimplexOptions:
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
    best = solve_pose(case.matches, case.camera, _stated(case))
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


# --- Figures 3.2 and 3.9 ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Convergence:
    """Every step of a descent."""

    parameters: np.ndarray
    """(K, 6) of the best vertex: Tx, Ty, Tz (m), alpha, beta, gamma (deg)."""
    cost: np.ndarray
    """(K,)"""
    rejections: np.ndarray
    """The steps with which a round begins that has rejected anew."""
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


# --- Figures 3.3 and 3.4 ---------------------------------------------------------------------------------------------


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
        for name, colour, mine in (("spikes", BAD, ~case.true), ("other vertices", ACCENT, case.true)):
            index = np.flatnonzero(mine & kept)
            plot.stems(index, errors[index], colour, name=name)
        blocks.append(columns([plot.block()]))
    note = (
        "Laser depth against both stereo depths, sqrt((Zl - Zxs)^2 + (Zl - Zys)^2) with the sign of laser minus "
        f"stereo, in the apple's units (reading {SHOWN_READING}, seed {SHOWN_SEED}). "
        f"{int(fit.after.inliers.sum())} of {len(case.true)} vertices are kept; values beyond the plot stand at its "
        "edge."
    )
    return plots.page("Figures 3.3 and 3.4: depth errors of the apple", note, blocks)


# --- Figure 3.5 ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Smoothing:
    """One apple before and after."""

    case: Case
    truth: np.ndarray
    """(M,) true ranges."""
    ranges: np.ndarray
    """(M,) smoothed."""
    by_mean: np.ndarray
    """(M,) as smoothed, but by the mean of the two stereo depths, as the thesis says."""
    replaced: np.ndarray


def mean_of_depths(case: Case, pose: Rigid) -> np.ndarray:
    """Return the ranges (M,) at the mean of Zxs and Zys."""
    pairs = StereoPairs.of(case.matches, case.camera)
    return np.asarray(pairs.depths(pairs.parameters(pose)).mean(axis=0) * case.ranges / pairs.depth)


def smoothing(reading: str, seed: int) -> Smoothing:
    case = apple_case(reading, seed)
    result = solve_pose(case.matches, case.camera, _stated(case))
    pose = result.camera_from_scanner
    smoothed = smooth_ranges(
        case.matches,
        case.camera,
        pose,
        threshold_m=THRESHOLD_M,
        covariance=result.covariance,
        options=SmoothOptions(sigma_px=case.sigma_px),
    )
    return Smoothing(
        case,
        np.linalg.norm(apple_points(reading), axis=1),
        smoothed.ranges,
        np.where(smoothed.replaced, mean_of_depths(case, pose), case.ranges),
        smoothed.replaced,
    )


def smoothing_text(seeds: int) -> str:
    rows = []
    for reading in APPLE_READINGS:
        runs = [smoothing(reading, seed) for seed in range(seeds)]

        def rms(ranges: Callable[[Smoothing], np.ndarray], runs: list[Smoothing] = runs) -> float:
            """Return the median over runs of the spiked vertices' root mean square error."""
            errors = [(ranges(run) - run.truth)[~run.case.true] for run in runs]
            return float(np.median([np.sqrt(np.mean(e**2)) for e in errors]))

        before, after, mean = rms(lambda r: r.case.ranges), rms(lambda r: r.ranges), rms(lambda r: r.by_mean)
        spikes = sum(int((~run.case.true).sum()) for run in runs)
        large = [(np.abs(run.case.ranges - run.truth) > THRESHOLD_M) & ~run.case.true for run in runs]
        found = sum(int((run.replaced & mine).sum()) for run, mine in zip(runs, large, strict=True))
        wrong = sum(int((run.replaced & run.case.true).sum()) for run in runs)
        others = sum(int(run.case.true.sum()) for run in runs)
        rows.append(
            [
                reading, f"{before:.3f}", f"{after:.3f}", f"{before / after:.0f} times", f"{mean:.3f}",
                f"{found} of {sum(int(m.sum()) for m in large)} ({spikes} spikes)", f"{wrong} of {others}",
            ]
        )  # fmt: skip
    heads = (
        "spiked vertices, rms error before", "after", "smaller", "by the mean of Zxs and Zys",
        f"spikes beyond {THRESHOLD_M:g} replaced", "other vertices changed",
    )  # fmt: skip
    return markdown(heads, rows)


_DIRECTIONS = {
    "a metre aside": (0.0, 1.0, 0.0),
    "a metre ahead, a little aside": (1.0, 0.3, 0.2),
    "a metre straight ahead, nearly": (1.0, 0.05, 0.05),
}


def poles_text(seeds: int) -> str:
    """Return what both ways leave of ranges that are all too long by 40 %, in the room."""
    rows = []
    for name, way in _DIRECTIONS.items():
        by_pixels, by_mean = [], []
        for seed in range(seeds):
            case = room_case(seed, baseline_m=1.0, direction=way, sigma_range_m=1e-6)
            spiked = replace(case, ranges=1.4 * case.ranges)
            smoothed = smooth_ranges(spiked.matches, case.camera, case.pose, threshold_m=0.3)
            by_pixels.append((smoothed.ranges - case.ranges)[smoothed.replaced])
            by_mean.append((mean_of_depths(spiked, case.pose) - case.ranges)[smoothed.replaced])
        cells = []
        for errors in map(np.concatenate, (by_pixels, by_mean)):
            cells += [f"{np.sqrt(np.mean(errors**2)):.3f}", f"{np.percentile(np.abs(errors), 99):.3f}"]
        rows.append([f"camera {name}", *cells])
    heads = ("in pixels: rms, m", "99th percentile, m", "by the mean: rms, m", "99th percentile, m")
    return markdown(heads, rows)


_ERROR_SCALE = 1.0


def smoothing_picture(run: Smoothing) -> np.ndarray:
    """Draw the apple aside of the scanner's view, where spikes show as such."""
    size = (field_width(3, left=4) + plots.RIGHT, 420)
    turn = rotation_about("x", 0.25) @ rotation_about("y", 1.0) @ CAMERA_AXES_FROM_SCANNER
    rays = run.case.rays
    views = {
        "(a) the apple": run.truth,
        "(b) with noise and spikes": run.case.ranges,
        "(c) spikes replaced by stereo": run.ranges,
    }
    middle = (turn @ (rays * run.truth[:, None]).mean(axis=0))[:2]
    everywhere = np.concatenate([(rays * r[:, None]) @ turn[:2].T - middle for r in views.values()])
    zoom = 0.47 * min(size[0] / np.abs(everywhere[:, 0]).max() / 1, size[1] / np.abs(everywhere[:, 1]).max())
    blocks = []
    for title, ranges in views.items():
        uv = ((rays * ranges[:, None]) @ turn[:2].T - middle) * zoom + np.array(size) / 2
        errors = np.abs(ranges - run.truth)
        blocks.append(plots.wireframe(title, uv, errors, grid=(13, 16), size=size, scale=_ERROR_SCALE))
    count = len(run.truth)
    plot = Plot(
        field_width(1), 210, (0.0, count + 1.0), (0.003, 5.0), "Range errors in order of size", "vertices", log_y=True
    )
    plot.horizontal(THRESHOLD_M, WARN, dashed=True, name=f"threshold, {THRESHOLD_M:g}")
    for name, ranges, colour in (("before", run.case.ranges, BAD), ("after", run.ranges, ACCENT)):
        plot.curve(np.arange(1, count + 1), np.sort(np.abs(ranges - run.truth)), colour, name=name, thickness=3)
    note = (
        f"Reading {SMOOTHED_READING}, seed {SHOWN_SEED}, with the pose of the default: {int(run.replaced.sum())} of "
        f"{count} ranges are replaced, each by what its own match shows; the laser looks from the left."
    )
    rows = [
        columns(blocks),
        plots.colour_bar(plots.WIDTH - 2 * plots.MARGIN, _ERROR_SCALE, "range error"),
        columns([plot.block(number="{:g}".format)]),
    ]
    return plots.page("Figure 3.5: the apple, smoothed", note, rows)


# --- Tables 3.2 to 3.5 -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneRun:
    """One simulated scene by all stages."""

    case: SimulatedCase
    comparison: Comparison

    def errors(self, column: Column) -> tuple[float, float, float]:
        """Return the error against the truth: median px, deg, mm; NaN without a pose."""
        result = column.stage.result
        return (np.nan,) * 3 if result is None else scene_errors(self.case, result.camera_from_scanner)


def scene_run(scene: str, seed: int) -> SceneRun:
    case = simulate_case(scene, seed=seed)
    print(f"{scene} {seed}: simulated")
    return SceneRun(case, compare(case.scan, case.photo))


def scene_text(run: SceneRun, scene: str) -> str:
    """Return the thesis's table of a scene, with the truth and the errors against it."""
    table = comparison_table(run.comparison, run.case.scan)
    truth = dict(zip(PARAMETERS, six(run.case.camera_from_scanner), strict=True))
    rows = []
    for name, *cells in table.rows:
        if name.split(",")[0] in (*PARAMETERS, "points", "verdict"):
            known = truth.get(name.split(",")[0])
            rows.append([name, "" if known is None else f"{known:.4f}", *cells])
    off = [run.errors(column) for column in run.comparison.columns]
    for k, (name, digits) in enumerate((("error, px (median)", 2), ("error, deg", 3), ("error, mm", 1))):
        cells = [f"{e[k]:.{digits}f}" if np.isfinite(e[k]) else NOTHING for e in off]
        rows.insert(len(rows) - 1, [name, "", *cells])
    rows.append(["points in the thesis's own scene", "", *map(str, printed.SCENES[scene].points), NOTHING])
    return markdown(("truth", *table.heads), rows)


def scenes_text(runs: dict[str, list[SceneRun]]) -> str:
    """Return the errors over all seeds: median and worst, px."""
    rows = []
    for scene, mine in runs.items():
        cells = []
        for k in range(len(mine[0].comparison.columns)):
            px = [run.errors(run.comparison.columns[k])[0] for run in mine]
            known = [v for v in px if np.isfinite(v)]
            missing = f", {len(px) - len(known)} without a pose" if len(known) < len(px) else ""
            cells.append(f"{np.median(known):.2f} / {max(known):.2f}{missing}" if known else "no pose")
        rows.append([scene, *cells])
    heads = [TITLES[column.stage.name] for column in next(iter(runs.values()))[0].comparison.columns]
    return markdown(heads, rows)


_STAGE_COLOURS = (DIM, PINK, YELLOW, VIOLET, ACCENT)
_STAGE_NAMES = ("unconstrained", "constrained", "simplex", "outliers removed", "default")


def scenes_picture(runs: dict[str, list[SceneRun]]) -> np.ndarray:
    everything = [r.errors(c)[0] for mine in runs.values() for r in mine for c in r.comparison.columns]
    known = [v for v in everything if np.isfinite(v)]
    x = (10 ** np.floor(np.log10(min(known))), 10 ** np.ceil(np.log10(max(known))))
    blocks = []
    for scene, mine in runs.items():
        bars = []
        for k, (name, colour) in enumerate(zip(_STAGE_NAMES, _STAGE_COLOURS, strict=True)):
            px = [run.errors(run.comparison.columns[k])[0] for run in mine]
            finite = [v for v in px if np.isfinite(v)]
            middle, worst = (float(np.median(finite)), max(finite)) if finite else (np.nan, np.nan)
            bars.append(Bar(name, middle, worst, colour))
        blocks.append(
            plots.strips(
                f"Table {printed.SCENES[scene].table}: {scene}", bars, x=x, marks=[(1.0, plots.FAINT, "one pixel")],
                width=field_width(2, left=168), left=168, label="median displacement from the truth, px",
            )
        )  # fmt: skip
    count = len(next(iter(runs.values())))
    note = f"Median (dot) and worst (end of the line) over {count} simulated cases of each scene, against the truth."
    return plots.page("Tables 3.2 to 3.5: stage by stage", note, [columns(blocks[:2]), columns(blocks[2:])])


def simplex_of_scene(run: SceneRun) -> Convergence | None:
    """Return the walk of the simplex stage again, from the constrained pose over the same matches."""
    by_name = {column.stage.name: column.stage.result for column in run.comparison.columns}
    start, simplex = by_name["constrained_linear"], by_name["simplex"]
    if start is None or simplex is None:
        return None
    return convergence(
        simplex.matches, run.case.photo.camera, _simplex("stereo", None), start.camera_from_scanner, simplex.sigma_px
    )


def printed_text() -> str:
    rows = []
    for scene, table in printed.SCENES.items():
        for name, points, values in zip(_STAGE_NAMES, table.points, table.stages, strict=False):
            rows.append([f"{scene} (Table {table.table}), {name}", *(f"{v:.4f}" for v in values), str(points)])
    heads = [name + (", m" if k < 3 else ", deg") for k, name in enumerate(PARAMETERS)]
    return markdown([*heads, "points"], rows)


# --- the page --------------------------------------------------------------------------------------------------------


def write_page(out: Path, seeds: int, scene_seeds: int) -> None:
    """Measure everything and write the page with its pictures."""
    pictures = out / "thesis-results"
    pictures.mkdir(parents=True, exist_ok=True)

    def picture(name: str, image: np.ndarray, words: str) -> str:
        plots.save(pictures / name, image)
        return f"![{words}](thesis-results/{name})"

    case = apple_case(SHOWN_READING, SHOWN_SEED)
    options = _simplex("stereo", THRESHOLD_M)
    fit = fit_simplex(case.matches, case.camera, options, initial=THESIS_START, sigma_px=case.sigma_px)
    walk = convergence(case.matches, case.camera, options, THESIS_START, case.sigma_px)
    apple_note = (
        f"Reading {SHOWN_READING}, seed {SHOWN_SEED}, from T=(2, 0, 0) without rotation: the best vertex at every "
        f"iteration of the simplex on Eq 2.21; {walk.kept} points are kept in the end."
    )
    parts = [
        _HEAD.format(seeds=seeds, scene_seeds=scene_seeds),
        "## Table 3.1: the apple",
        _APPLE.format(seeds=seeds, before=PRINTED[0], after=PRINTED[1], threshold=THRESHOLD_M)
        + "\n".join(f"- {words}" for words in READING_WORDS.values()),
    ]
    figures = table_3_1(seeds)
    parts += [
        picture("table-3-1.png", table_3_1_picture(figures, seeds), "errors of every method on the apple"),
        table_3_1_text(figures).rstrip(),
        _APPLE_READ,
        f"### The printed run beside one of ours (reading {SHOWN_READING}, seed {SHOWN_SEED})",
        single_run_text(case, fit).rstrip(),
        "## Figure 3.2: convergence",
        picture(
            "figure-3-2.png",
            convergence_picture(
                walk, six(APPLE_TRUTH.pose), "Figure 3.2: convergence on the apple", apple_note, "units"
            ),
            "the six parameters and the cost over the iterations",
        ),
        "## Figures 3.3 and 3.4: depth errors",
        picture("figures-3-3-and-3-4.png", depth_error_picture(case, fit), "depth errors per vertex"),
        "## Figure 3.5: smoothing by stereo",
        _SMOOTHING,
        picture(
            "figure-3-5.png",
            smoothing_picture(smoothing(SMOOTHED_READING, SHOWN_SEED)),
            "the apple, with spikes, and without",
        ),
        smoothing_text(seeds).rstrip(),
        _SMOOTHING_READ,
        poles_text(min(seeds, 40)).rstrip(),
    ]
    print("Figures 3.2 to 3.5: done")
    runs = {scene: [scene_run(scene, seed) for seed in range(scene_seeds)] for scene in SCENES}
    boxes = simplex_of_scene(runs["boxes"][0])
    parts += ["## Tables 3.2 to 3.5: simulated scenes", _SCENES_WORDS.format(count=scene_seeds)]
    parts += [
        picture("tables-3-2-to-3-5.png", scenes_picture(runs), "errors of every stage on the four scenes"),
        scenes_text(runs).rstrip(),
    ]
    for scene, mine in runs.items():
        parts += [f"### Table {printed.SCENES[scene].table}: {scene}, seed 0", scene_text(mine[0], scene).rstrip()]
    if boxes is not None:
        note = (
            "Seed 0, from the constrained least-squares pose over the matches of the simplex stage, by Eq 2.21; "
            f"{boxes.kept} points are kept in the end."
        )
        truth = six(runs["boxes"][0].case.camera_from_scanner)
        parts += [
            "### Figure 3.9: convergence on boxes",
            picture(
                "figure-3-9.png",
                convergence_picture(boxes, truth, "Figure 3.9: convergence on the boxes", note, "m"),
                "the six parameters and the cost over the iterations",
            ),
        ]
    parts += ["### What the thesis printed for its own scenes", _PRINTED_WORDS, printed_text().rstrip()]
    (out / "thesis-results.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


_HEAD = """\
# The thesis's results, and ours

M. D. Elstrom, *A Stereo-Based Technique for the Registration of Color and LADAR Images* (1998), chapter 3, done
again and set beside what replaced it. `python -m benchmarks.thesis --seeds {seeds} --scene-seeds {scene_seeds}`
writes this page and its pictures, always the same. What each equation is and where it stands:
[thesis.md](thesis.md)."""

_APPLE = """\
208 vertices of an apple; ranges get uniform noise of ± 0.25 and a tenth of them a spike, pixels ± 3 and rounding;
the simplex starts at T = (2, 0, 0) without rotation. The truth is T = (5, 2, 2) and (25°, 10°, 5°). Figures are the
mean error over the six parameters in per cent, median / 95th percentile over {seeds} seeds. The thesis prints one
run: {before:.2f} before rejection, {after:.2f} after. The threshold of the stereo-simplex is {threshold:g}. "Radius
one" contradicts "ranges from two to eight", hence three readings:

"""

_APPLE_READ = """\
Before rejection, the default is its own least squares without the gate; linear rejects nothing, so that its second
figure stands on the points that the default keeps. `true inliers known` is the default told which vertices have no
spike: the mark to reach. The epipolar residual has the laser's depth in its denominator, so that a spike towards the
scanner outweighs all else; and without any spike it still errs by a fifth here, where the baseline is as long as the
depth and ranges are the noisier side. It is meant for rooms and short baselines; here Eq 2.21 is the better."""

_SMOOTHING = """\
A match shows a range of its own: where the ray's point projects nearest to the pixel. Where the laser's range lies
far from that, it was a spike, and gives way (`ladarreg_core.smoothing`). It stays where the disparity does not
determine a range, where the pixels' noise explains the difference, and where the match lies off its epipolar line.
Each vertex is replaced by itself alone, so that edges stay. Pose: the default's."""

_SMOOTHING_READ = """\
Spikes within the threshold stay, as in the thesis: they are most of what is left in A and B. The thesis says
"estimates based on their stereo depth" and has two of them; the column by their mean is for the same vertices. On
the apple both ways serve alike. With the camera ahead of the scanner one of the two disparities vanishes along lines
through the epipole, and the mean with it; least squares in pixels weighs both by what they tell. In the room of
`benchmarks/pose.py` (1 px), every range too long by 40 %, what is left of those that were replaced:"""

_SCENES_WORDS = """\
The thesis's own scenes are not public; these are rooms of the same kind, simulated, and their truth is known. The
stages are those of the thesis, the default beside them; each finds its own matches, and the simplex walks the
repaired residual, as the method `thesis` does. The error is the median displacement in the photograph of what is
seen, px: median / worst over {count} cases of each scene. In the tables below, points are the matches that hold, of
those used."""

_PRINTED_WORDS = """\
Other rooms, other poses, and no truth: only how far the stages lie apart can be compared."""


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200, help="apples of each reading")
    parser.add_argument("--scene-seeds", type=int, default=5, help="cases of each scene")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page")
    arguments = parser.parse_args()
    if min(arguments.seeds, arguments.scene_seeds) < 1:
        parser.error("at least one seed is needed")
    try:
        write_page(arguments.out, arguments.seeds, arguments.scene_seeds)
    except LadarregError as error:
        parser.exit(2, f"{error}\n")
    print(f"written: {arguments.out / 'thesis-results.md'}")


if __name__ == "__main__":
    main()
