"""The straight edge under a roughly drawn line, to a fraction of a pixel across it.

Profiles are sampled across the line and averaged over short blocks of it. Each block votes for its steepest places; a
straight edge is a line on which most blocks agree. A vote saturates, since the strongest edge within reach is often not
the one that was meant: a faint edge under the line outweighs a strong one beside it. Around the best line the places
are then fitted robustly.

Nothing moves along the line: where an edge ends is for the operator to say.

Source: perpendicular profiles as in the tracking of moving edges (Bouthemy 1989); Tukey's biweight for the fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray

_PITCH_PX = 0.25  # of the profiles
_SMOOTHING_PX = 0.5  # of the profiles, before their slope
_BEYOND_PX = 3.0  # length of the profiles beyond the reach, for the filter
_BLOCK_PX = 4.0
_MIN_BLOCKS, _MAX_BLOCKS = 6, 64
_MAX_EACH = 16  # profiles of a block
_MIN_LENGTH_PX = 12.0
_MAX_REACH_PX = 100.0
_FINE_REACH_PX = 8.0  # a longer reach is searched at a coarser scale first
_PLACES = 6  # of a block and plane
_NOISE_FACTOR = 2.5  # a slope of so many times the typical variation has no vote
_MIN_SLOPE = 0.3  # gray levels per pixel; less is rounding
_GRID_PX = 0.5
_VOTE_SIGMA_PX = 0.6
_OTHER_SIGN = 0.5  # weight of votes for the opposite contrast
_NEAR_PX = 1.5  # a place this close to the line may belong to it
_MIN_SUPPORT, _MIN_END_SUPPORT = 0.3, 0.2  # mean votes on the whole line and on its outer thirds
_MIN_PRESENT = 0.5  # share of the blocks that show the edge
_ROUNDS = 4
_GATE_SIGMA = 4.0
_MIN_GATE_PX = 0.6

Sampler = Callable[[NDArray[np.float32]], FloatArray]
"""Returns the gray levels (C, N, J), 0 to 255, of C images at pixels (N, J, 2)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeOptions:
    """Search for the edge under a drawn line."""

    reach_px: float = 6.0
    """Largest distance of an end from the edge."""
    expected_px: float = 1.5
    """Distance at which an edge counts half as much as one right under the line."""


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """The steepest places of the profiles across a line, in K blocks with P places each."""

    s: FloatArray
    """(K,) position of the blocks along the line, 0 to 1."""
    offset: FloatArray
    """(K, P) distance from the line, px; far away where there are fewer."""
    vote: FloatArray
    """(K, P) steepness, saturating, 0 to 1."""
    rising: BoolArray
    """(K, P) sign of the slope."""


def edge_under(sample: Sampler, ends: ArrayLike, options: EdgeOptions | None = None) -> NDArray[np.float64] | None:
    """Return the ends (2, 2) of a drawn line, each moved to the nearest point of the straight edge under it.

    Args:
        sample: the image, or several that show the same edges.
        ends: (2, 2), (u, v), px.
        options: how far to search.

    Returns:
        The ends on the edge; None if there is no straight edge within reach of both, or the line is too short.
    """
    o = options or EdgeOptions()
    drawn = np.asarray(ends, dtype=np.float64)
    if not np.isfinite(drawn).all() or np.linalg.norm(drawn[1] - drawn[0]) < _MIN_LENGTH_PX:
        return None
    reach = min(o.reach_px, _MAX_REACH_PX)
    scale = max(1.0, reach / _FINE_REACH_PX)  # px per step of the search
    offsets = _best_line(_places(sample, drawn, reach, scale), reach, o.expected_px, scale)
    if offsets is None:
        return None
    line = _moved(drawn, offsets)
    rounds = [s for s in (scale / 2, scale / 4, scale / 8, scale / 16) if s > 1]
    for finer in (*rounds, 1.0, 1.0):  # the last time along the edge itself
        offsets = _fitted(_places(sample, line, 2 * _NEAR_PX * finer, finer), _NEAR_PX * finer)
        if offsets is None:
            return None
        line = _moved(line, offsets)
    along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    nearest = line[0] + ((drawn - line[0]) @ along)[:, None] * along
    if np.linalg.norm(nearest - drawn, axis=1).max() > reach:
        return None
    return np.asarray(nearest)


def _normal(line: FloatArray) -> NDArray[np.float64]:
    along = line[1] - line[0]
    return np.asarray(np.array([-along[1], along[0]]) / np.linalg.norm(along))


def _moved(line: FloatArray, offsets: FloatArray) -> NDArray[np.float64]:
    return np.asarray(line + offsets[:, None] * _normal(line))


def _places(sample: Sampler, line: FloatArray, reach_px: float, scale: float) -> _Places:
    """Return the steepest places of profiles across a line, `reach_px` to both sides, at a scale in px."""
    length = float(np.linalg.norm(line[1] - line[0]))
    blocks = int(np.clip(length / (_BLOCK_PX * scale), _MIN_BLOCKS, _MAX_BLOCKS))
    each = int(np.clip(np.ceil(length / scale / blocks), 2, _MAX_EACH))
    s = (np.arange(blocks * each) + 0.5) / (blocks * each)
    pitch = min(_PITCH_PX * scale, 1.0)
    half = int(np.ceil((reach_px + _BEYOND_PX * scale) / pitch))
    across = np.arange(-half, half + 1) * pitch
    at = (line[0] + s[:, None] * (line[1] - line[0]))[:, None] + across[:, None] * _normal(line)
    profiles = np.asarray(sample(at.astype(np.float32)), dtype=np.float32)
    profiles = profiles.reshape(-1, blocks, each, len(across)).mean(axis=2)
    sigma = _SMOOTHING_PX * scale / pitch
    width = 2 * int(np.ceil(3 * sigma)) + 1
    found = []
    for profile in profiles:
        smooth = cv2.GaussianBlur(profile, (width, 1), sigma, borderType=cv2.BORDER_REPLICATE)
        found.append(_steepest(np.gradient(np.asarray(smooth), pitch, axis=1), across, reach_px))
    offset, vote, rising = (np.concatenate([part[k] for part in found], axis=1) for k in range(3))
    return _Places(s.reshape(blocks, each).mean(axis=1), offset, vote, rising)


def _steepest(slope: FloatArray, across: FloatArray, reach_px: float) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return offsets, votes and signs (K, P) of the steepest places of profiles with slopes (K, J)."""
    steep = np.abs(slope)
    # noise differs from block to block; the slopes of an edge do not
    noise = _NOISE_FACTOR * float(np.median(np.abs(slope - np.median(slope, axis=0)))) + _MIN_SLOPE
    before, here, after = steep[:, :-2], steep[:, 1:-1], steep[:, 2:]
    peak = (here >= before) & (here > after) & (np.abs(across[1:-1]) <= reach_px + 0.5)
    order = np.argsort(-np.where(peak, here, 0), axis=1)[:, :_PLACES]
    a, b, c, is_peak = (np.take_along_axis(part, order, axis=1) for part in (before, here, after, peak))
    bend = np.where(is_peak, a - 2 * b + c, -1)  # negative at a peak
    offset = across[order + 1] + np.clip(0.5 * (a - c) / bend, -0.5, 0.5) * (across[1] - across[0])
    rising = np.take_along_axis(slope[:, 1:-1], order, axis=1) > 0
    return np.where(is_peak, offset, 1e6), np.where(is_peak, np.clip(1 - noise / np.maximum(b, 1e-9), 0, 1), 0), rising


def _best_line(places: _Places, reach_px: float, expected_px: float, scale: float) -> NDArray[np.float64] | None:
    """Return the offsets (2,) at both ends of the line for which most blocks vote; None if too few do."""
    steps = np.arange(-reach_px, reach_px + 1e-9, _GRID_PX * scale)
    at_ends = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    lines = at_ends[:, :1] * (1 - places.s) + at_ends[:, 1:] * places.s  # (C, K)
    falling, rising = (
        _votes(places.offset, np.where(places.rising == sign, places.vote, 0), lines, _VOTE_SIGMA_PX * scale)
        for sign in (False, True)
    )
    totals = np.sort([falling.mean(axis=1), rising.mean(axis=1)], axis=0)
    total = totals[1] + _OTHER_SIGN * totals[0]
    total = np.clip(total - np.median(total), 0, None)  # any line gets some votes
    moved = (at_ends**2).sum(axis=1)
    # heavy tails: whoever draws to half a pixel means the nearest edge, yet others miss theirs by four
    best = int(np.argmax(total**2 / (1 + moved / expected_px**2)))
    support = np.maximum(falling[best], rising[best])
    third = len(support) // 3
    if support.mean() < _MIN_SUPPORT or min(support[:third].mean(), support[-third:].mean()) < _MIN_END_SUPPORT:
        return None
    return np.asarray(at_ends[best])


def _votes(offset: FloatArray, vote: FloatArray, lines: FloatArray, sigma_px: float) -> NDArray[np.float64]:
    """Return the largest vote (C, K) of each block for lines with offsets (C, K)."""
    best = np.zeros(lines.shape)
    for k in range(offset.shape[1]):
        np.maximum(best, vote[:, k] * np.exp(-0.5 * ((offset[:, k] - lines) / sigma_px) ** 2), out=best)
    return best


def _fitted(places: _Places, near_px: float) -> NDArray[np.float64] | None:
    """Return the offsets (2,) at both ends of the robust line through the places near the present one."""
    inside = np.abs(places.offset) <= near_px
    falling, rising = (float(places.vote[inside & (places.rising == sign)].sum()) for sign in (False, True))
    weight = places.vote * np.where(places.rising == (rising > falling), 1.0, _OTHER_SIGN**2)
    s = np.broadcast_to(places.s[:, None], weight.shape)
    ends, gate = np.zeros(2), near_px
    for _ in range(_ROUNDS):
        error = places.offset - (ends[0] * (1 - s) + ends[1] * s)
        share = np.clip(1 - (error / gate) ** 2, 0, None) ** 2 * weight
        used = (share > 0) & (share >= share.max(axis=1, keepdims=True))  # one place of a block
        if np.count_nonzero(used) < max(_MIN_BLOCKS - 1, _MIN_PRESENT * len(places.s)) or np.ptp(s[used]) < 0.5:
            return None
        w, target = share[used], places.offset[used]
        design = np.stack([1 - s[used], s[used]], axis=1)
        ends = np.linalg.solve(design.T @ (w[:, None] * design), design.T @ (w * target))
        spread = float(np.sqrt((w * (target - design @ ends) ** 2).sum() / w.sum()))
        gate = float(np.clip(_GATE_SIGMA * spread, _MIN_GATE_PX, near_px))
    return np.asarray(ends)
