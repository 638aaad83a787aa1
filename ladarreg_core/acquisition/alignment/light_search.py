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

from ladarreg_core.acquisition.alignment.intensity_links import (
    LINK_MISFIT_BLURS,
    MAD,
    MIN_CONTRAST,
    MIN_OF_PATCH,
    MIN_SIGMA,
    MISFIT_BLURS,
    Link,
    comparable,
    most_gap,
    residuals,
    sums_of,
)
from ladarreg_core.acquisition.alignment.intensity_view import IntensityView, lengths, lookup, lookup_at
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec

_STEP_CELLS = 0.5
_MAX_STEPS = 15  # to either side
_SAMPLES_A_PATCH = 8  # that count
_ALIKE = 3.0  # of them, those that a misfit shifts alike
_MAX_SQUARE = 9.0  # of a sample, in variances
_SHOWN_SIGMAS = 2.0  # of the noise, beyond which contrast is texture


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
    # In two directions at once there are many turns, and the adjustment that follows finds the rest of the way.
    cells = _STEP_CELLS * len(directions)
    step = cells * min(views[number].scan.geometry.step_rad)
    most = _MAX_STEPS // len(directions)
    counts = [int(np.clip(np.ceil(3 * sigma / step), 1, most)) for sigma in sigma_rad]
    axes = [step * np.arange(-count, count + 1) for count in counts]
    turns = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    nodes = np.stack(np.meshgrid(*(axis[[0, len(axis) // 2, -1]] for axis in axes), indexing="ij"), axis=-1)
    moved = [_with_turn(poses, number, turn @ directions) for turn in nodes.reshape(-1, len(axes))]
    mine = [_Comparison.of(link, level, views, poses, moved) for link in links if number in (link.first, link.second)]
    # Both directions of a pair are nearly the same comparison: each counts half.
    scores = np.array([-sum(one.disagreement(_shares(turn, axes)) for one in mine) / 4 for turn in turns])
    scores -= (np.square(turns / sigma_rad).sum(axis=-1)) / 2
    best = int(scores.argmax())
    here = int(np.abs(turns).sum(axis=-1).argmin())
    likely = np.exp(scores - scores[best])
    spread = np.sqrt((likely[:, None] * np.square(turns - turns[best])).sum(axis=0) / likely.sum())
    return SearchedTurn(turns[best], float(scores[best] - scores[here]), spread)


def turned(pose: Rigid, turn: FloatArray) -> Rigid:
    """Return a pose turned about the world's origin by a rotation vector (3,)."""
    return Rigid(rotation_from_rotvec(turn), np.zeros(3)) @ pose


def _with_turn(poses: Sequence[Rigid], number: int, turn: FloatArray) -> list[Rigid]:
    moved = list(poses)
    moved[number] = turned(poses[number], turn)
    return moved


def _shares(turn: FloatArray, axes: Sequence[FloatArray]) -> NDArray[np.float64]:
    """Return the weights of the nodes, the ends and the middle of each axis, at a turn: quadratic along each axis."""
    weights = np.ones(1)
    for value, axis in zip(turn, axes, strict=True):
        x = value / axis[-1]
        weights = np.outer(weights, [x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2]).ravel()
    return weights


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """The points of a link that both views see at every turn: what comes into view must not make a turn better."""

    view: IntensityView
    """The second of the link."""
    nodes: NDArray[np.float64]
    """(K, N, 3) cells of the second view, and the distance from it, at some turns. In between they are interpolated: a
    scan turns by a degree at most, over which cells follow a parabola to a thousandth of one, and to find the cells of
    rays in a table takes long."""
    most_gap: float
    light: FloatArray
    """(N,) of the first view."""
    steep: FloatArray
    """(N,) its slope, by a cell."""
    patch: IntArray
    """(N,)"""
    sigma: float
    """Standard deviation of the noise of a difference."""

    @staticmethod
    def of(
        link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid], moved: Sequence[Sequence[Rigid]]
    ) -> _Comparison:
        view, other = views[link.first], views[link.second]
        among, nodes = np.ones(len(link.points), np.bool_), []
        for at in moved:
            local = at[link.second].inverse @ (at[link.first] @ link.points)
            seen = lookup(other, local)
            among &= comparable(link, level, views, at, local, seen)
            nodes.append(np.concatenate([seen.cells, lengths(local)[:, None]], axis=-1))
        cell = lengths(link.points[among]) * float(np.mean(view.scan.geometry.step_rad))
        return _Comparison(
            other, np.stack(nodes)[:, among], most_gap(view, other, poses[link.first], poses[link.second]),
            link.light[level][among], lengths(link.slopes[level][among]) * cell, link.patch[level][among],
            _noise_of(link, level, views, poses),
        )  # fmt: skip

    def disagreement(self, shares: FloatArray) -> float:
        """Return how badly both views agree where the first shows texture, at a turn by its shares of the nodes.

        It is a sum of squares in units of what noise and `MISFIT_BLURS` explain, each limited, and of each patch no
        more than a few: one long edge, which says little along itself, must not outweigh the end of another.
        """
        at = np.tensordot(shares, self.nodes, axes=1)
        seen = lookup_at(self.view, at[:, :2])
        use = seen.good(at[:, 2], self.most_gap)
        if not use.any():
            return 0.0
        sigma, light, steep = self.sigma, self.light[use], self.steep[use]
        _, patch, count = np.unique(self.patch[use], return_inverse=True, return_counts=True)
        contrast = sums_of(np.square(light)[:, None], patch, len(count))[:, 0] / count
        contrast -= np.square(sums_of(light[:, None], patch, len(count))[:, 0] / count)
        textured = (contrast > max(MIN_CONTRAST, _SHOWN_SIGMAS * sigma) ** 2) & (count >= MIN_OF_PATCH)
        steep_there = np.hypot(*seen.slopes[use].T)
        residual = seen.light[use] - light
        residual -= float(np.median(residual))
        # Noise is each sample's own; a misfit is common to those of a patch, and some of it to all patches of a link.
        common = MISFIT_BLURS**2 + LINK_MISFIT_BLURS**2 * float(textured.sum())
        misfit = _ALIKE * common * self.view.blur_cells**2
        squares = np.square(residual) / (sigma**2 + misfit * (np.square(steep) + np.square(steep_there)) / 2)
        # A sample that is no longer seen counts as one that fits.
        excess = np.minimum(squares, _MAX_SQUARE) - 1
        sums = sums_of(excess[:, None], patch, len(count))[:, 0]
        return float((sums * np.minimum(1.0, _SAMPLES_A_PATCH / count))[textured].sum())


def _noise_of(link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid]) -> float:
    """Return the standard deviation of what differs between the views of a link."""
    residual = residuals(link, level, views, poses, None, 1).residual
    return max(MAD * float(np.median(np.abs(residual))), MIN_SIGMA) if len(residual) else MIN_SIGMA
