"""Which points of two sets are the same, by the distances between them; the rigid motion between these; and tests."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.frames import Rigid

Array = NDArray[np.float64]
Assignment = tuple[tuple[int, int], ...]
"""Pairs of indices of a point of one set and of the other, in order."""

SIGMAS, FLOOR_M = 4.0, 0.002
"""Up to which a distance is the same; targets are not put up to the millimetre."""
LEAST = 3
"""Points that an assignment needs."""
MIN_APART_M = 0.2
"""Distance below which two points say nothing of a direction."""
_MIN_BREADTH = 0.02  # of points across their longest extent, as a share of it
_MAX_TRIED = 200
_ROUNDS = 5
_MIN_REDUNDANCY = 1e-6  # share of an observation that the others see of it, below which nothing does
_LEVEL = 1e-3  # chance at which one of all observations that fit is taken for one that does not


def ranked_assignments(
    nodes: NDArray[np.intp], own: Array, world: Array, tolerance_m: Array, *, least_apart_m: float = MIN_APART_M
) -> dict[Assignment, float]:
    """Return sets of assignments that a rigid motion fits, with their RMS, m; the largest first, then the best.

    Args:
        nodes: (N, 2) which assignments are possible: indices of a point of one set and of the other.
        own: (A, 3) points of one set, m.
        world: (B, 3) those of the other.
        tolerance_m: (N,) how far apart both points of each may be.
        least_apart_m: distance below which two points are not compared.

    Returns:
        sets of at least three.
    """
    agrees = _agreement(nodes, own, world, tolerance_m, least_apart_m)
    found: dict[Assignment, float] = {}
    for chosen in _cliques(agrees):
        chosen, off = _rigid(nodes, chosen, own, world, tolerance_m)
        if len(chosen) >= LEAST:
            found[tuple(sorted((int(a), int(i)) for a, i in nodes[chosen]))] = off
    return {one: found[one] for one in sorted(found, key=lambda one: (-len(one), found[one]))}


def is_line(points: Array) -> bool:
    """Return whether points (N, 3) are on a line, about which a body could be turned."""
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(extents[1] <= _MIN_BREADTH * extents[0])


def rigid_motion(own: NDArray[np.float64], world: NDArray[np.float64]) -> Rigid:
    """Return the rigid motion of points (N, 3) onto others by least squares; N is 3 or more.

    Source: Kabsch 1976; Umeyama 1991 for the sign.
    """
    u, _, vt = np.linalg.svd((world - world.mean(0)).T @ (own - own.mean(0)))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Rigid(rotation, world.mean(0) - rotation @ own.mean(0))


def _agreement(
    nodes: NDArray[np.intp], own: Array, world: Array, tolerance: Array, least_apart_m: float
) -> NDArray[np.bool_]:
    """Return which two of the assignments (N, 2) of a target to coordinates may both be right, (N, N)."""
    one, other = nodes[:, 0], nodes[:, 1]
    apart = np.linalg.norm(own[:, None] - own, axis=-1)[np.ix_(one, one)]
    known = np.linalg.norm(world[:, None] - world, axis=-1)[np.ix_(other, other)]
    allowed = np.hypot(tolerance[:, None], tolerance)
    agrees = (np.abs(apart - known) < allowed) & (known >= least_apart_m)
    agrees &= (one[:, None] != one) & (other[:, None] != other)
    return np.asarray(agrees)


def _cliques(agrees: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """Yield sets of assignments that agree with each other, from the pairs that most others agree with."""
    counts = (agrees.astype(np.float32) @ agrees.astype(np.float32)) * agrees
    first, second = np.nonzero(np.triu(counts >= LEAST - 2))
    for k in np.argsort(-counts[first, second], kind="stable")[:_MAX_TRIED]:
        chosen = [int(first[k]), int(second[k])]
        left = agrees[chosen[0]] & agrees[chosen[1]]
        while left.any():
            inside = np.flatnonzero(left)
            chosen.append(int(inside[np.argmax(agrees[np.ix_(inside, inside)].sum(axis=1))]))
            left &= agrees[chosen[-1]]
        if len(chosen) >= LEAST:
            yield np.array(chosen)


def _rigid(
    nodes: NDArray[np.intp], chosen: NDArray[np.intp], own: Array, world: Array, tolerance: Array
) -> tuple[NDArray[np.intp], float]:
    """Return the assignments that one rigid motion fits, begun with those chosen, and their RMS, m."""
    away = np.zeros(len(nodes))
    for _ in range(_ROUNDS):
        pose = rigid_motion(own[nodes[chosen, 0]], world[nodes[chosen, 1]])
        away = np.linalg.norm(pose @ own[nodes[:, 0]] - world[nodes[:, 1]], axis=1)
        fits = np.flatnonzero(away < tolerance)
        order = fits[np.argsort(away[fits], kind="stable")]
        kept: list[int] = []
        for k in order:
            if all(nodes[k, 0] != nodes[other, 0] and nodes[k, 1] != nodes[other, 1] for other in kept):
                kept.append(int(k))
        now = np.sort(np.array(kept, np.intp))
        if len(now) < LEAST or np.array_equal(now, np.sort(chosen)):
            chosen = now
            break
        chosen = now
    return chosen, float(np.sqrt(np.mean(away[chosen] ** 2))) if len(chosen) else np.inf


def fits_by_chance(found: int, names: int, matched: int, own: Array, tolerance_m: float) -> float:
    """Return how many sets of so many targets are expected to fit where nothing is a target.

    Three targets fit if three distances do; each one more, if it falls into a ball of the tolerance.
    """
    extent = max(float(np.linalg.norm(own - own.mean(0), axis=1).max()), MIN_APART_M)
    triples = np.prod(np.arange(found, found - LEAST, -1.0)) * np.prod(np.arange(names, names - LEAST, -1.0)) / 6
    expected = float(triples) * (2 * tolerance_m / extent) ** 3
    for k in range(LEAST, matched):
        expected *= (found - k) * (names - k) * (tolerance_m / extent) ** 3
    return expected


def removal_statistics(jacobians: Array, offs: Array, inverse: Array) -> Array:
    """Return by how much the sum of squares falls without each observation, given derivatives (n, D, P) and residuals
    (n, D)."""
    tests = np.zeros(len(offs))
    for n, (jacobian, off) in enumerate(zip(jacobians, offs, strict=True)):
        values, vectors = np.linalg.eigh(np.eye(len(off)) - jacobian @ inverse @ jacobian.T)
        along = vectors.T @ off
        known = values > _MIN_REDUNDANCY
        tests[n] = float((along[known] ** 2 / values[known]).sum())
    return tests


def largest_by_chance(count: int, degrees: int = 3) -> float:
    """Return what the largest of so many statistics, each of some degrees of freedom, exceeds once in 1000 times."""
    from scipy.special import chdtri

    return float(chdtri(degrees, _LEVEL / max(1, count)))


def chance(chi2: float, dof: int) -> float:
    """Return the probability of a sum of squares as large as this or larger."""
    from scipy.special import chdtrc

    return float(chdtrc(dof, chi2)) if dof > 0 else 1.0
