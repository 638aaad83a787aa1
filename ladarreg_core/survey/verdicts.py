"""The adjustment with its verdicts: what contradicts the rest is taken out, and nothing else moves by it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, IntArray
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.frames import Rigid
from ladarreg_core.survey.build import Bodies
from ladarreg_core.survey.least_squares.problem import RIG, Lines, Problem, Ties, pose_difference
from ladarreg_core.survey.least_squares.solver import LOST, Adjusted, solve
from ladarreg_core.survey.ties.ties import spread

_MIN_FACTOR_WEIGHT = 0.25  # of what a scan's image says of a pose: beyond, it contradicts the adjustment
_MIN_JUDGED = 30  # ties by which a photograph is judged
_MIN_AGREEING = 0.3  # of them
MIN_TIES = 18
"""Ties that a photograph without a scan's evidence needs; photographs of other rooms reach 11."""
MIN_CELLS = 12
"""Cells of 40 px that these must lie in; photographs of other rooms reach 5."""
MIN_PARTNERS = 2
"""Verified photographs that they must be shared with."""
CELL_PX = 40.0
_MAX_ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class TakenOut:
    """A photograph that was taken out, and what it would have done."""

    reason: str
    moved_others_sigmas: float
    """The largest shift of another photograph's pose by it, in standard deviations."""


@dataclass(slots=True, eq=False)
class Solution:
    """An adjustment without what contradicts it."""

    adjusted: Adjusted
    bodies: Bodies
    taken_out: dict[int, TakenOut] = field(default_factory=dict)
    """By photograph."""


@dataclass(frozen=True, slots=True, eq=False)
class TieCount:
    """The ties of a photograph."""

    agree: int
    left_out: int
    cells: int
    """Cells of the photograph in which those that agree lie."""
    partners: tuple[int, ...]
    """Photographs that share some of them."""
    median_px: float

    def reason_against(self, verified: set[int]) -> str:
        """Return why they do not suffice as evidence, as a sentence; empty: they do."""
        known = [one for one in self.partners if one in verified]
        if self.agree >= MIN_TIES and self.cells >= MIN_CELLS and len(known) >= MIN_PARTNERS:
            return ""
        with_photos = f"{len(known)} verified photograph{'' if len(known) == 1 else 's'}"
        return (
            f"No scan's image verifies it, and {self.agree} ties in {self.cells} places of {CELL_PX:.0f} px with "
            f"{with_photos} are too few: {MIN_TIES} in {MIN_CELLS} with {MIN_PARTNERS} are needed."
        )


def solve_consistent(
    problem: Problem, bodies: Bodies, names: Mapping[int, str], tick: Callable[[], None] | None = None
) -> Solution:
    """Adjust a problem, and take out photographs whose parts contradict each other, the worst first.

    Args:
        problem: the problem with its ties.
        bodies: where scans and photographs stand in it.
        names: of the photographs, for the reasons.
        tick: called before every step; may raise to stop.
    """
    solution = Solution(solve(problem, tick=tick), bodies)
    for _ in range(_MAX_ROUNDS):
        worst = _worst(solution)
        if worst is None:
            return solution
        photo, reason = worst
        again, left = without_photo(solution.adjusted.problem, solution.bodies, photo)
        adjusted = solve(again, tick=tick)
        moved, where = largest_shift(solution.adjusted, solution.bodies, adjusted, left)
        if where is not None and moved >= 0.1:
            reason += f" It would have moved {names[where]} by {moved:.1f} standard deviations."
        taken = {**solution.taken_out, photo: TakenOut(reason, moved)}
        solution = Solution(adjusted, left, taken)
    return solution


def agrees_with_scan(solution: Solution, photo: int, scan: int) -> bool:
    """Return whether what a scan's image says of a photograph's pose agrees with the adjustment."""
    adjusted, bodies = solution.adjusted, solution.bodies
    return any(
        weight >= _MIN_FACTOR_WEIGHT
        for one, weight in zip(adjusted.problem.relative, adjusted.relative_weights, strict=True)
        if (one.body, one.base) == (bodies.photos[photo], bodies.scans[scan])
    )


def is_held_by_rig(adjusted: Adjusted, body: int) -> bool:
    """Return whether a verified photograph of the same frame holds a photograph, and agrees with all else."""
    return any(
        one.body == body and one.name == RIG and weight >= _MIN_FACTOR_WEIGHT
        for one, weight in zip(adjusted.problem.relative, adjusted.relative_weights, strict=True)
    )


def agreeing_ties(adjusted: Adjusted) -> BoolArray:
    """Return (N,) which observations of ties agree with another one of the same point."""
    point, kept = adjusted.problem.ties.point, adjusted.tie_inliers
    return np.asarray(kept & (np.bincount(point[kept], minlength=len(adjusted.problem.ties.points))[point] >= 2))


def count_ties(adjusted: Adjusted, bodies: Bodies, photo: int) -> TieCount:
    """Return the ties of a photograph that agree with an adjustment, and those that do not."""
    ties = adjusted.problem.ties
    own = ties.photo == bodies.photos[photo]
    kept = adjusted.tie_inliers
    on_surface = np.zeros(len(ties.points), np.bool_)
    on_surface[ties.on_point[adjusted.surface_weights > LOST]] = True
    good = own & agreeing_ties(adjusted)
    others = np.isin(ties.point, ties.point[good]) & kept & ~own
    photo_of = bodies.photo_of
    length = np.linalg.norm(adjusted.tie_residuals_px[good], axis=1)
    return TieCount(
        int(good.sum()), int((own & ~kept).sum()), spread(ties.uv, good, CELL_PX),
        tuple(sorted(photo_of[body] for body in np.unique(ties.photo[others]).tolist())),
        float(np.median(length)) if len(length) else float("nan"),
    )  # fmt: skip


def without_photo(problem: Problem, bodies: Bodies, photo: int) -> tuple[Problem, Bodies]:
    """Return the problem without a photograph, what is known of it, and its ties."""
    body = bodies.photos[photo]
    kept = np.delete(np.arange(len(problem.poses)), body)
    number = np.full(len(problem.poses) + 1, -1, np.int64)
    number[kept] = np.arange(len(kept))
    ties, seen = problem.ties, problem.ties.photo != body
    enough = np.bincount(ties.point[seen], minlength=len(ties.points)) >= 2
    seen &= enough[ties.point]
    on = enough[ties.on_point]
    points = np.cumsum(enough) - 1
    left = Ties(
        ties.points[enough], points[ties.point[seen]], number[ties.photo[seen]], ties.uv[seen],
        points[ties.on_point[on]], number[ties.scan[on]], ties.xyz[on], ties.normal[on], ties.sigma_m[on],
        ties.stated_px[seen], ties.drawn[enough],
    )  # fmt: skip
    relative = tuple(
        replace(one, body=int(number[one.body]), base=int(number[one.base]) if one.base >= 0 else one.base)
        for one in problem.relative if body not in (one.body, one.base)
    )  # fmt: skip
    again = replace(
        problem, poses=tuple(problem.poses[k] for k in kept), fixed=problem.fixed[kept],
        views=tuple(problem.views[k] for k in kept), relative=relative, ties=left,
        lines=_without_body(problem.lines, body, number),
    )  # fmt: skip
    photos = {one: int(number[at]) for one, at in bodies.photos.items() if one != photo}
    return again, Bodies([int(number[at]) if at >= 0 else -1 for at in bodies.scans], photos)


def _without_body(lines: Lines, body: int, number: IntArray) -> Lines:
    """Return the lines without a body; those that constrain no pose then are left out."""
    seen = lines.photo != body
    equations = 2 * np.bincount(lines.line[seen], minlength=len(lines.points))
    equations += np.bincount(lines.on_line, minlength=len(lines.points))
    enough = equations > 4  # the unknowns of a line
    seen &= enough[lines.line]
    on = enough[lines.on_line]
    left = np.cumsum(enough) - 1
    return Lines(
        lines.points[enough], left[lines.line[seen]], number[lines.photo[seen]], lines.uv[seen], lines.sigma_px[seen],
        left[lines.on_line[on]], lines.at[on], number[lines.scan[on]], lines.xyz[on], lines.normal[on],
        lines.sigma_m[on], lines.drawn[enough],
    )  # fmt: skip


def largest_shift(before: Adjusted, bodies: Bodies, after: Adjusted, left: Bodies) -> tuple[float, int | None]:
    """Return by how many standard deviations the photograph that differs most differs between two adjustments."""
    largest, which = 0.0, None
    for photo, body in left.photos.items():
        off = pose_difference(before.problem.poses[bodies.photos[photo]], after.problem.poses[body])
        covariance = after.covariance_of(body)
        squared = float(off @ np.linalg.pinv(covariance, hermitian=True) @ off)
        sigmas = float(np.sqrt(max(squared, 0.0) / 6))
        if sigmas > largest:
            largest, which = sigmas, photo
    return largest, which


def _worst(solution: Solution) -> tuple[int, str] | None:
    """Return the photograph whose parts contradict each other most, and why; None: none does."""
    adjusted, bodies = solution.adjusted, solution.bodies
    found: list[tuple[float, int, str]] = []
    for photo, body in bodies.photos.items():
        weights = [
            weight for one, weight in zip(adjusted.problem.relative, adjusted.relative_weights, strict=True)
            if one.body == body
        ]  # fmt: skip
        ties = count_ties(adjusted, bodies, photo)
        judged = ties.agree + ties.left_out
        if weights and max(weights) < _MIN_FACTOR_WEIGHT:
            what, off = _contradiction(adjusted, body)
            found.append((
                max(weights), photo,
                f"{what[:1].upper()}{what[1:]} puts it {format_length(off)} away from where {ties.agree} ties with "
                "other photographs put it: one of both is wrong.",
            ))  # fmt: skip
        elif weights and judged >= _MIN_JUDGED and ties.agree < _MIN_AGREEING * judged:
            found.append((
                0.5 + ties.agree / judged, photo,
                f"Only {ties.agree} of its {judged} ties with other photographs agree with where its image on the scan "
                "puts it.",
            ))  # fmt: skip
    if not found:
        return None
    _, photo, reason = min(found)
    return photo, reason


def _contradiction(adjusted: Adjusted, body: int) -> tuple[str, float]:
    """Return what the first relative pose of a body came from, and how far the adjusted pose lies from it, m."""
    problem = adjusted.problem
    known = next(one for one in problem.relative if one.body == body)
    base = problem.poses[known.base] if known.base >= 0 else Rigid.identity()
    return known.name, float(np.linalg.norm((problem.poses[body] @ base.inverse).centre - known.pose.centre))
