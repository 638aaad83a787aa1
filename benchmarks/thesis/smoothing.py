"""Figure 3.5: ranges replaced by stereo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.shared import plots
from benchmarks.shared.plots import ACCENT, BAD, WARN, Plot, columns, field_width
from benchmarks.thesis.apple import SHOWN_SEED, SMOOTHED_READING, markdown, stated
from benchmarks.thesis.table_3_1 import THRESHOLD_M
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_about
from ladarreg_core.pose.estimate import solve_pose
from ladarreg_core.quality.smoothing import SmoothOptions, smooth_ranges
from ladarreg_core.thesis.estimators.stereo import StereoPairs
from testing.scenes.apple import APPLE_READINGS, apple_case, apple_points
from testing.scenes.pose_case import Case
from testing.scenes.room import room_case


@dataclass(frozen=True)
class Smoothing:
    """One apple before and after."""

    case: Case
    truth: np.ndarray
    """(M,) true ranges."""
    ranges: np.ndarray
    """(M,) smoothed."""
    by_mean: np.ndarray
    """(M,) smoothed by the mean of the two stereo depths, as in the thesis."""
    replaced: np.ndarray


def mean_of_depths(case: Case, pose: Rigid) -> np.ndarray:
    """Return the ranges (M,) at the mean of Zxs and Zys."""
    pairs = StereoPairs.of(case.matches, case.camera)
    return np.asarray(pairs.depths(pairs.parameters(pose)).mean(axis=0) * case.ranges / pairs.depth)


def smoothing(reading: str, seed: int) -> Smoothing:
    case = apple_case(reading, seed)
    result = solve_pose(case.matches, case.camera, stated(case))
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
    """Return the errors that both methods leave in ranges that are all too long by 40 %, in the room."""
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
    """Draw the apple from beside the scanner, so that spikes are visible."""
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
    for name, ranges, color in (("before", run.case.ranges, BAD), ("after", run.ranges, ACCENT)):
        plot.curve(np.arange(1, count + 1), np.sort(np.abs(ranges - run.truth)), color, name=name, thickness=3)
    note = (
        f"Reading {SMOOTHED_READING}, seed {SHOWN_SEED}, with the pose of the default: {int(run.replaced.sum())} of "
        f"{count} ranges are replaced, each by what its own match shows; the laser looks from the left."
    )
    rows = [
        columns(blocks),
        plots.color_bar(plots.WIDTH - 2 * plots.MARGIN, _ERROR_SCALE, "range error"),
        columns([plot.block(number="{:g}".format)]),
    ]
    return plots.page("Figure 3.5: the apple, smoothed", note, rows)
