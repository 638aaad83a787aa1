"""The time by which the clock of a camera is ahead of the scanner's, from the agreement of shifted pairings.

Where a rig moves, a photograph that was taken earlier or later than a scan shows another view. Each scan is therefore
paired with the photographs before and after its own, shifted alike for all pairs, and the pose is refined for each
shift: the correlation of the images has its maximum where both were taken at one moment. A rig that stands shows the
same at every shift, and nothing can be determined. Nor can an offset be distinguished from a displacement of the camera
where all pairs move alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.rig.joint import JointPairs, PairViews
from ladarreg_core.registration.rig.options import MIN_PAIRS
from ladarreg_core.registration.rig.results import RigPair, TimeOffset

_MIN_SHIFTS = 3
_MIN_SIGMAS = 3.0  # by which the maximum exceeds the mean of the shifts beyond its neighbours, over the pairs
_MIN_LEAD = 0.25  # the same, relative to the maximum: a rig that stands differs by noise
_MIN_GAIN = 0.06  # of correlation at the maximum: that of wrong poses is below .05
_OF_PERIOD = 0.1  # standard deviation of the interpolated maximum, in periods, that no scatter undercuts


def estimate_time_offset(pairs: Sequence[RigPair], starts: Sequence[Rigid], *, seed: int = 0) -> TimeOffset:
    """Estimate the time offset of a rig's camera.

    Args:
        pairs: those of one camera, with the photographs before and after each (`RigPair.taken`).
        starts: poses `camera_from_scanner`, one of which is about right.
        seed: random seed of the points that are compared.
    """
    period = _period(pairs)
    if period is None:
        return _unknown("there are no photographs before and after those of the pairs")
    shifts = _shifts(pairs, period)
    if len(shifts) < _MIN_SHIFTS:
        return _unknown("too few photographs were taken before and after those of the pairs")
    scores = np.stack([_score(pairs, shift * period, period, starts, seed) for shift in shifts])
    return _maximum(shifts * period, scores, period)


def paired_at(pair: RigPair, offset_s: float) -> RigPair:
    """Return a pair with the photograph that was taken nearest to an offset from its scan, s."""
    if not pair.taken:
        return pair
    nearest = min(pair.taken, key=lambda one: abs(one.after_s - offset_s))
    return replace(pair, photo=nearest.photo)


def _period(pairs: Sequence[RigPair]) -> float | None:
    """Return the time between photographs, s; None if there are no two of any pair."""
    steps = [np.diff([one.after_s for one in pair.taken]) for pair in pairs if len(pair.taken) > 1]
    period = float(np.median(np.concatenate(steps))) if steps else 0.0
    return period if period > 0 else None


def _shifts(pairs: Sequence[RigPair], period: float) -> FloatArray:
    """Return the shifts, in periods, at which most pairs have a photograph."""
    before = -np.median([pair.taken[0].after_s for pair in pairs if pair.taken]) / period
    after = np.median([pair.taken[-1].after_s for pair in pairs if pair.taken]) / period
    return np.arange(-round(float(before)), round(float(after)) + 1).astype(np.float64)


def _score(pairs: Sequence[RigPair], offset_s: float, period: float, starts: Sequence[Rigid], seed: int) -> FloatArray:
    """Return the mean gain of correlation (P,) of each pair at the pose that fits best at an offset; NaN without."""
    found = np.full(len(pairs), np.nan)
    there = [
        index for index, pair in enumerate(pairs)
        if pair.taken and min(abs(one.after_s - offset_s) for one in pair.taken) < 0.6 * period
    ]  # fmt: skip
    if len(there) < MIN_PAIRS:
        return found
    views = [PairViews(paired_at(pairs[index], offset_s), seed) for index in there]
    for start in starts:
        joint = JointPairs(views, start)
        refined = joint.refine(start, range(len(there)))
        if refined is None:
            continue
        gains = np.full(len(pairs), np.nan)
        for place, index in enumerate(there):
            maps = joint.agreement_at(refined, place, 1)
            if maps is not None and len(maps.block_maps):
                gains[index] = float(maps.gains().mean())
        if np.nansum(gains) > np.nansum(found) or not np.isfinite(found).any():
            found = gains
    return found


def _maximum(offsets: FloatArray, scores: FloatArray, period: float) -> TimeOffset:
    """Return the offset of the highest mean score (S, P), with the scatter of leaving out pairs."""
    usable = scores[:, np.isfinite(scores).mean(axis=0) > 0.5]
    if usable.shape[1] < MIN_PAIRS:
        return _unknown("too few pairs have photographs before and after their own")
    mean = np.nanmean(usable, axis=1)
    best = int(np.nanargmax(mean))
    far = [k for k in range(len(offsets)) if abs(k - best) > 1]
    lead = usable[best] - np.nanmean(usable[far], axis=0)
    lead = lead[np.isfinite(lead)]
    error = float(lead.std(ddof=1) / np.sqrt(len(lead))) if len(lead) > 1 else np.inf
    without = [np.nanmean(np.delete(usable, k, axis=1), axis=1) for k in range(usable.shape[1])]
    alike = all(abs(int(np.nanargmax(each)) - best) <= 1 for each in without)
    if not (alike and mean[best] > _MIN_GAIN and lead.mean() > max(_MIN_LEAD * mean[best], _MIN_SIGMAS * error)):
        return _unknown(
            "the images agree about as well at other offsets: the rig stands, or moves alike in all pairs; take pairs "
            "where it turns"
        )
    if best in (0, len(offsets) - 1):
        return _unknown(
            f"the images agree best at {offsets[best]:+.3f} s, the last of the photographs that were read: the clocks "
            "differ by more; correct the time stamps first"
        )
    seconds = _vertex(offsets, mean)
    maxima = np.array([_vertex(offsets, each) for each in without])
    count = len(maxima)
    scatter = float(np.sqrt((count - 1) / count * ((maxima - maxima.mean()) ** 2).sum()))
    sigma = float(np.hypot(scatter, _OF_PERIOD * period))
    return TimeOffset(
        seconds,
        sigma,
        f"photographs are stamped {seconds:+.3f} s after the scans of the same moment (sigma {sigma:.3f} s)",
    )


def _vertex(offsets: FloatArray, mean: FloatArray) -> float:
    """Return the maximum of the parabola through the highest value and its neighbours."""
    best = int(np.clip(np.nanargmax(mean), 1, len(mean) - 2))
    before, at, after = mean[best - 1 : best + 2]
    bend = before - 2 * at + after
    part = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(offsets[best] + np.clip(part, -0.5, 0.5) * (offsets[1] - offsets[0]))


def _unknown(why: str) -> TimeOffset:
    return TimeOffset(0.0, float("inf"), f"the time offset cannot be told: {why}")
