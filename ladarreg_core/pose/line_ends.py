"""Repair of the ends of drawn lines, once a pose is known.

A line drawn along the same edge in both images may have its ends at different points of the edge, or in reverse order.
Such ends are not outliers: as long as they lie on the photo's line, they constrain the pose across it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.bundle import States, adjust_ranges
from ladarreg_core.pose.estimators.measurements import Measurements


@dataclass(frozen=True, slots=True, eq=False)
class RepairedEnds:
    """Matches with repaired line ends."""

    matches: Matches
    """The matches, as many as before and in the same order."""
    swapped: tuple[str, ...] = ()
    """Picks whose line was drawn in the opposite direction in the photo."""
    slid: tuple[str, ...] = ()
    """Picks with an end that is known only across the line."""

    def describe(self) -> tuple[str, ...]:
        """Return one sentence for each kind of repair."""
        sentences = []
        if self.swapped:
            sentences.append(
                f"{_named(self.swapped)} drawn in the opposite direction in the photo; the ends were swapped."
            )
        if self.slid:
            sentences.append(
                f"{_named(self.slid)} not drawn between the same points in both images; these ends are used only "
                "across the line."
            )
        return tuple(sentences)


def repair_ends(
    matches: Matches,
    inliers: BoolArray,
    state: States,
    camera: CameraModel,
    *,
    gate: float,
    sigma_px: float,
    sigma_range_m: float,
) -> RepairedEnds:
    """Find lines drawn in the opposite direction, and ends that lie elsewhere along their line.

    Args:
        matches: M matches; the two ends of a line are adjacent.
        inliers: (M,) bool, before any repair.
        state: the pose (B = 1).
        camera: the photo's camera.
        gate: largest cost s of an inlier.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
    """
    first = _lines(matches)
    first = first[~(inliers[first] & inliers[first + 1])]
    if not len(first):
        return RepairedEnds(matches)

    def costs(trial: Matches) -> FloatArray:
        measured = Measurements.of(trial, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        return np.asarray(adjust_ranges(measured, States.of([state.pose()], measured))[1].s[0])

    swapped = matches.uv.copy(), matches.directions.copy()
    for values, sign in zip(swapped, (1, -1), strict=True):
        values[first], values[first + 1] = sign * values[first + 1], sign * values[first]
    reversed_lines = replace(matches, uv=swapped[0], directions=swapped[1])
    s = costs(reversed_lines)
    swap = first[(s[first] <= gate) & (s[first + 1] <= gate)]
    left = first[~np.isin(first, swap)]
    across = matches.across.copy()
    across[left] = across[left + 1] = True
    s = costs(replace(matches, across=across))
    slide = left[(s[left] <= gate) & (s[left + 1] <= gate)]
    ends = np.concatenate([slide, slide + 1])
    ends = ends[~inliers[ends]]  # the other end may be correct
    if not len(swap) and not len(ends):
        return RepairedEnds(matches)
    uv, directions, across = matches.uv.copy(), matches.directions.copy(), matches.across.copy()
    for k in (swap, swap + 1):
        uv[k], directions[k] = reversed_lines.uv[k], swapped[1][k]
    across[ends] = True
    return RepairedEnds(
        replace(matches, uv=uv, directions=directions, across=across),
        tuple(matches.pick_ids[k] for k in swap.tolist()),
        tuple(dict.fromkeys(matches.pick_ids[k] for k in np.sort(ends).tolist())),
    )


def _lines(matches: Matches) -> IntArray:
    """Return the index of the first end of every line that has both ends."""
    drawn = (matches.directions != 0).any(axis=1)
    if len(matches) < 2 or not drawn.any():
        return np.zeros(0, dtype=np.intp)
    same = np.array([a == b for a, b in zip(matches.pick_ids, matches.pick_ids[1:], strict=False)])
    ends = (matches.fractions[:-1] == 0) & (matches.fractions[1:] == 1)
    return np.flatnonzero(same & ends & drawn[:-1] & drawn[1:])


def _named(picks: tuple[str, ...]) -> str:
    names = ", ".join(picks[:5]) + (f" and {len(picks) - 5} more" if len(picks) > 5 else "")
    return f"Line {names} was" if len(picks) == 1 else f"Lines {names} were"
