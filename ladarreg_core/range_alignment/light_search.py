"""Search for the turn of a scan at which what is printed on surfaces agrees with its neighbours.

Adjustment by gradients finds the nearest optimum. Where the ranges hold a scan, that is the right one; where they leave
a direction open, as on a blank ceiling, it may be any at which a few lamps or joints happen to lie on others. Such a
direction is searched as far as the scan may be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.range_alignment.intensity_links import IntensityView, Link, disagreement, noise_of, seen_points

_STEP_CELLS = 0.5
_MOST_STEPS = 15


@dataclass(frozen=True, slots=True)
class SearchedTurn:
    """The best turn of a scan in its open directions, and how sharp it is."""

    turn: NDArray[np.float64]
    """(D,) rad along the directions."""
    gain: float
    """How much larger its log-likelihood is than where the scan was."""
    spread: NDArray[np.float64]
    """(D,) rad: standard deviation of the turn about the best one, by the likelihood of all turns."""


def search_turn(
    number: int,
    links: Sequence[Link],
    views: Sequence[IntensityView],
    level: int,
    poses: Sequence[Rigid],
    directions: FloatArray,
    sigma_rad: FloatArray,
) -> SearchedTurn:
    """Return the turn at which the intensities of a scan agree best with those of the scans it is linked to.

    Args:
        number: the scan.
        links: links between the scans; only those of this one count.
        views: the scans.
        level: the level of the links that the views are of.
        poses: `world_from_scan` of each.
        directions: (D, 3) unit rotation vectors about the world's origin, in which it may be off; D is 1 or 2.
        sigma_rad: (D,) standard deviation of its turn about each, by all that is known without intensities.
    """
    step = _STEP_CELLS * min(views[number].scan.geometry.step_rad)
    counts = [int(np.clip(np.ceil(3 * sigma / step), 1, _MOST_STEPS)) for sigma in sigma_rad]
    axes = [step * np.arange(-count, count + 1) for count in counts]
    turns = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    outermost = np.stack(np.meshgrid(*(axis[[0, len(axis) // 2, -1]] for axis in axes), indexing="ij"), axis=-1)
    mine = []
    for link in links:
        if number in (link.first, link.second):
            among = np.ones(len(link.points), np.bool_)
            for turn in outermost.reshape(-1, len(axes)):
                among &= seen_points(link, level, views, _with_turn(poses, number, turn @ directions))
            mine.append((link, noise_of(link, level, views, poses), among))
    scores = np.array([_agreement(number, mine, views, level, poses, turn @ directions) for turn in turns])
    scores -= (np.square(turns / sigma_rad).sum(axis=-1)) / 2
    best = int(scores.argmax())
    here = int(np.abs(turns).sum(axis=-1).argmin())
    likely = np.exp(scores - scores[best])
    spread = np.sqrt((likely[:, None] * np.square(turns - turns[best])).sum(axis=0) / likely.sum())
    return SearchedTurn(turns[best], float(scores[best] - scores[here]), spread)


def turned(pose: Rigid, turn: FloatArray) -> Rigid:
    """Return a pose turned about the world's origin by a rotation vector (3,)."""
    return Rigid(rotation_from_rotvec(turn), np.zeros(3)) @ pose


def _agreement(
    number: int,
    links: Sequence[tuple[Link, float, BoolArray]],
    views: Sequence[IntensityView],
    level: int,
    poses: Sequence[Rigid],
    turn: FloatArray,
) -> float:
    """Return the logarithm of how likely a turn is."""
    moved = _with_turn(poses, number, turn)
    # Both directions of a pair are nearly the same comparison: each counts half.
    return -sum(disagreement(link, level, views, moved, sigma, among) for link, sigma, among in links) / 4


def _with_turn(poses: Sequence[Rigid], number: int, turn: FloatArray) -> list[Rigid]:
    moved = list(poses)
    moved[number] = turned(poses[number], turn)
    return moved
