"""Uses of drawn lines compared: which of their samples an estimator should use, on the lines of
`testing.scenes.room_lines`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from benchmarks.pose.report import Bar, Section, first_third, number, percent, table
from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.results.registration import PoseResult
from testing.scenes.pose_case import difference
from testing.scenes.room_lines import LineCase, line_case


def _solved(case: LineCase, matches: Matches, initial: Rigid | None = None) -> PoseResult | None:
    options = PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)
    try:
        return solve_pose(matches, case.camera, options, initial=initial)
    except LadarregError:
        return None


def by_ends(case: LineCase) -> PoseResult | None:
    """Use the two ends with the ranges of the whole line, as `register` does."""
    return _solved(case, matches_from_picks(case.scan, case.picks, camera=case.camera)[0])


def by_ends_as_points(case: LineCase) -> PoseResult | None:
    """Use the two ends, each with the range of its own cell."""
    points = [
        Pick(f"{pick.id}{k}", "point", pick.scan[k : k + 1], pick.photo[k : k + 1])
        for pick in case.picks
        for k in (0, 1)
    ]
    return _solved(case, matches_from_picks(case.scan, points, camera=case.camera)[0])


def by_equal_intervals(case: LineCase) -> PoseResult | None:
    """Use samples at constant intervals in both images, as in the thesis."""
    return _solved(case, matches_from_picks(case.scan, case.picks, camera=case.camera, lines="equal")[0])


def by_kappa(case: LineCase) -> PoseResult | None:
    """Use samples placed in the photo by the pose, iterated."""
    result = by_equal_intervals(case)
    for _ in range(2):
        if result is None:
            return None
        pose = result.camera_from_scanner
        matches, _ = matches_from_picks(case.scan, case.picks, camera=case.camera, lines="kappa", pose=pose)
        result = _solved(case, matches, pose)
    return result


def by_distances(case: LineCase, *, ends: bool) -> PoseResult | None:
    """Use distances of samples to the line in the photo, weighted by 1 / sqrt of their number, with or without the
    ends."""
    start = by_equal_intervals(case)
    if start is None:
        return None
    sampled, _ = matches_from_picks(
        case.scan, case.picks, camera=case.camera, lines="kappa", pose=start.camera_from_scanner
    )
    full = np.isin(sampled.fractions, (0.0, 1.0)) if ends else np.zeros(len(sampled), np.bool_)
    matches = Matches(
        sampled.rays, sampled.ranges, sampled.uv, sampled.pick_ids, sampled.fractions,
        np.where(full, 1.0, sampled.weights), sampled.range_weights, sampled.directions, ~full,
    )  # fmt: skip
    options = PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m, ransac_iterations=0)
    try:
        return solve_pose(matches, case.camera, options, initial=start.camera_from_scanner)
    except LadarregError:
        return None


USES = {
    "equal intervals (thesis)": by_equal_intervals,
    "placed by kappa, iterated": by_kappa,
    "distances to the line alone": lambda case: by_distances(case, ends=False),
    "distances, and the ends": lambda case: by_distances(case, ends=True),
    "ends as points": by_ends_as_points,
    "ends, ranges of the line (default)": by_ends,
}


@dataclass(frozen=True)
class LineFigures:
    """Accuracy of a use of lines over many seeds."""

    position_mm: float
    """Median."""
    p95_mm: float
    consistency: float
    """RMS Mahalanobis distance / sqrt 6 of the reported covariance, without the worst 2 %."""
    accepted: float


def line_figures(use: str, cases: list[LineCase]) -> LineFigures:
    """Compute the figures of a use of lines."""
    position, distance, accepted = [], [], 0
    for case in cases:
        result = USES[use](case)
        if result is None:
            position.append(np.inf)
            continue
        step = difference(case.pose, result.camera_from_scanner)
        position.append(1000 * float(np.linalg.norm(step[3:])))
        distance.append(float(step @ np.linalg.solve(result.covariance, step)))
        accepted += result.accepted
    kept = np.sort(distance)[: max(1, int(0.98 * len(distance)))]
    return LineFigures(
        float(np.median(position)),
        float(np.percentile(position, 95)),
        float(np.sqrt(np.mean(kept) / 6)) if len(kept) else np.nan,
        accepted / len(cases),
    )


SETTINGS: dict[str, dict[str, float]] = {
    "baseline .5 m": {"baseline_m": 0.5},
    "baseline .94 m": {"baseline_m": 0.94},
    "baseline .5 m, three of them slid along themselves": {"baseline_m": 0.5, "slid": 3},
    "baseline .5 m, two of them the other way round": {"baseline_m": 0.5, "swapped": 2},
}
MAX_MM = 10.0
_WITH_BARS = 2  # settings that have bars
DEFAULT_USE = "ends, ranges of the line (default)"


def lines_section(seeds: Sequence[int]) -> Section:
    """Compare the uses of lines."""
    tables, figures = [], {}
    for k, (name, setting) in enumerate(SETTINGS.items()):
        those = seeds if k < _WITH_BARS else first_third(seeds)
        cases = [line_case(seed, **setting) for seed in those]  # type: ignore[arg-type]
        found = {use: line_figures(use, cases) for use in USES}
        figures[name] = {use: asdict(f) for use, f in found.items()}
        rows = [
            (use, number(f.position_mm, 1), number(f.p95_mm, 1), number(f.consistency), percent(f.accepted))
            for use, f in found.items()
        ]
        tables.append(
            (
                f"{name[0].upper()}{name[1:]} ({len(cases)} cases)",
                table(("median mm", "95th percentile mm", "consistency", "accepted"), rows),
            )
        )
    bars = [
        Bar(f"eight lines, {name}: median mm", figures[name][DEFAULT_USE]["position_mm"], most=MAX_MM)
        for name in list(SETTINGS)[:_WITH_BARS]
    ]
    return Section(
        "lines",
        "Eight drawn lines",
        "Which samples of drawn lines to use: all uses get the same lines, some 400 px long, with 1 px of noise at "
        "every end, on a scan of 15 mm noise. A slid line lies on the right edge, between other points; one drawn the "
        "other way round has its ends exchanged. Consistency is without the worst 2 %.",
        tuple(tables),
        tuple(bars),
        figures,
    )
