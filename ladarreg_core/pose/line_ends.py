"""The ends of drawn lines, repaired once a pose is known.

People draw the same edge in both pictures, but not always from the same point to the same point, and sometimes the
other way round. Such an end is no mismatch: where both ends lie on the photo's line, they are known across it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.camera import Camera
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import Measurements, States, settle


@dataclass(frozen=True, slots=True, eq=False)
class RepairedEnds:
    """Matches with their lines' ends as a pose says that they were meant."""

    matches: Matches
    """The matches, as many as before and in the same order."""
    swapped: tuple[str, ...] = ()
    """Picks whose line was drawn the other way round in the photo."""
    slid: tuple[str, ...] = ()
    """Picks with an end that is known across its line only."""

    def in_words(self) -> tuple[str, ...]:
        """Return a sentence for every kind of repair."""
        sentences = []
        if self.swapped:
            sentences.append(f"{_named(self.swapped)} drawn the other way round in the photo; the ends were exchanged.")
        if self.slid:
            sentences.append(
                f"{_named(self.slid)} not drawn between the same points in both pictures; such ends count across the "
                "line only."
            )
        return tuple(sentences)


def repair_ends(
    matches: Matches,
    inliers: BoolArray,
    state: States,
    camera: Camera,
    *,
    gate: float,
    sigma_px: float,
    sigma_range_m: float,
) -> RepairedEnds:
    """Look for lines drawn the other way round, and for ends that lie elsewhere on their line.

    Args:
        matches: M matches; of a line the two ends, one after the other.
        inliers: (M,) those that agree with the pose as they are.
        state: the pose (B = 1).
        camera: the photo's camera.
        gate: largest s of an inlier.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
    """
    first = _lines(matches)
    first = first[~(inliers[first] & inliers[first + 1])]
    if not len(first):
        return RepairedEnds(matches)

    def costs(trial: Matches) -> FloatArray:
        measured = Measurements.of(trial, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        return np.asarray(settle(measured, States.of([state.pose()], measured))[1].s[0])

    assert matches.directions is not None
    assert matches.across is not None
    exchanged = matches.uv.copy(), matches.directions.copy()
    for values, sign in zip(exchanged, (1, -1), strict=True):
        values[first], values[first + 1] = sign * values[first + 1], sign * values[first]
    other_way = replace(matches, uv=exchanged[0], directions=exchanged[1])
    s = costs(other_way)
    swap = first[(s[first] <= gate) & (s[first + 1] <= gate)]
    left = first[~np.isin(first, swap)]
    across = matches.across.copy()
    across[left] = across[left + 1] = True
    s = costs(replace(matches, across=across))
    slide = left[(s[left] <= gate) & (s[left + 1] <= gate)]
    ends = np.concatenate([slide, slide + 1])
    ends = ends[~inliers[ends]]  # the other end may be where it was meant
    if not len(swap) and not len(ends):
        return RepairedEnds(matches)
    uv, directions, across = matches.uv.copy(), matches.directions.copy(), matches.across.copy()
    for k in (swap, swap + 1):
        uv[k], directions[k] = other_way.uv[k], exchanged[1][k]
    across[ends] = True
    return RepairedEnds(
        replace(matches, uv=uv, directions=directions, across=across),
        tuple(matches.pick_ids[k] for k in swap.tolist()),
        tuple(dict.fromkeys(matches.pick_ids[k] for k in np.sort(ends).tolist())),
    )


def _lines(matches: Matches) -> IntArray:
    """Return the index of the first end of every line that has both."""
    assert matches.directions is not None
    assert matches.fractions is not None
    drawn = (matches.directions != 0).any(axis=1)
    if len(matches) < 2 or not drawn.any():
        return np.zeros(0, dtype=np.intp)
    same = np.array([a == b for a, b in zip(matches.pick_ids, matches.pick_ids[1:], strict=False)])
    ends = (matches.fractions[:-1] == 0) & (matches.fractions[1:] == 1)
    return np.flatnonzero(same & ends & drawn[:-1] & drawn[1:])


def _named(picks: tuple[str, ...]) -> str:
    names = ", ".join(picks[:5]) + (f" and {len(picks) - 5} more" if len(picks) > 5 else "")
    return f"Line {names} was" if len(picks) == 1 else f"Lines {names} were"
