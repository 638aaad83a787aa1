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
from ladarreg_core.range_alignment.intensity_links import (
    LEAST_CONTRAST,
    LEAST_OF_PATCH,
    LEAST_SIGMA,
    LINK_MISFIT_BLURS,
    MAD,
    MISFIT_BLURS,
    Link,
    comparable,
    residuals,
    sums_of,
)
from ladarreg_core.range_alignment.intensity_view import IntensityView, lookup

_STEP_CELLS = 0.5
_MOST_STEPS = 15
_SAMPLES_A_PATCH = 8
_ALIKE = 3.0  # of them, those that a misfit shifts alike
_MOST_SQUARE = 9.0
_SHOWN_SIGMAS = 2.0


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


def seen_points(link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid]) -> BoolArray:
    """Return which points (N,) of a link can be compared at some poses."""
    local = poses[link.second].inverse @ (poses[link.first] @ link.points)
    return comparable(link, level, views, poses, local, lookup(views[link.second], local))


def disagreement(
    link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid], sigma: float, among: BoolArray
) -> float:
    """Return how badly both views of a link agree where the first shows texture, at some poses, however far off.

    It is a sum of squares in units of what noise and `MISFIT_BLURS` explain, each limited, and of each patch no more
    than a few: one long edge, which says little along itself, must not outweigh the end of another.

    Args:
        link: the link.
        level: its level to compare.
        views: the views, of that level.
        poses: `world_from_scan` of each.
        sigma: standard deviation of the noise of a difference.
        among: (N,) the points to compare. Between poses whose disagreements are compared, they should be seen at all of
            them: a pose is not better for what comes into view.
    """
    view, other = views[link.first], views[link.second]
    local = poses[link.second].inverse @ (poses[link.first] @ link.points)
    light, own = link.light[level], link.slopes[level]
    cell = np.linalg.norm(link.points, axis=-1) * float(np.mean(view.scan.geometry.step_rad))
    steep = np.linalg.norm(own, axis=-1) * cell
    seen = lookup(other, local)
    use = comparable(link, level, views, poses, local, seen) & among
    if not use.any():
        return 0.0
    _, patch, count = np.unique(link.patch[level][use], return_inverse=True, return_counts=True)
    light, steep = light[use], steep[use]
    contrast = sums_of(np.square(light)[:, None], patch, len(count))[:, 0] / count
    contrast -= np.square(sums_of(light[:, None], patch, len(count))[:, 0] / count)
    textured = (contrast > max(LEAST_CONTRAST, _SHOWN_SIGMAS * sigma) ** 2) & (count >= LEAST_OF_PATCH)
    steep_there = np.linalg.norm(seen.slopes[use], axis=-1)
    residual = seen.light[use] - light
    residual -= float(np.median(residual))
    # Noise is each sample's own; a misfit is common to those of a patch, and some of it to all patches of a link.
    common = MISFIT_BLURS**2 + LINK_MISFIT_BLURS**2 * float(textured.sum())
    misfit = _ALIKE * common * view.blur_cells**2
    squares = np.square(residual) / (sigma**2 + misfit * (np.square(steep) + np.square(steep_there)) / 2)
    # What is seen no more counts as what fits.
    excess = np.minimum(squares, _MOST_SQUARE) - 1
    sums = sums_of(excess[:, None], patch, len(count))[:, 0]
    return float((sums * np.minimum(1.0, _SAMPLES_A_PATCH / count))[textured].sum())


def noise_of(link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid]) -> float:
    """Return the standard deviation of what differs between the views of a link."""
    residual = residuals(link, level, views, poses, None, 1).residual
    return max(MAD * float(np.median(np.abs(residual))), LEAST_SIGMA) if len(residual) else LEAST_SIGMA
