"""Several stations in one world: a robust graph of the verified pairs, its loops, and all surfaces at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.adjustment import RangeView
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.registration.stations.pair import about_centre
from ladarreg_core.registration.stations.results import Loop, StationPair
from ladarreg_core.registration.stations.uncertainty import polish

_FLOOR = np.array([*[float(np.radians(0.002))] * 3, *[2e-4] * 3]) ** 2
"""What a pair's covariance is at least in the graph: pairs share scans, and no surface is quite still."""
_OUTVOTED_MM, _OUTVOTED_DEG = 20.0, 0.2
_OUTVOTED_SIGMAS = 6.0
_MAX_POINTS = 900_000


def connected(count: int, fixed: int, pairs: Sequence[StationPair]) -> dict[int, list[int]]:
    """Return the stations that pairs lead to, each with its way from the fixed one, the shortest."""
    ways = {fixed: [fixed]}
    waiting = deque([fixed])
    while waiting:
        at = waiting.popleft()
        for other in range(count):
            if other not in ways and any({at, other} == {pair.first, pair.second} for pair in pairs):
                ways[other] = [*ways[at], other]
                waiting.append(other)
    return ways


def pose_graph(
    count: int, fixed: int, world_from_fixed: Rigid, pairs: Sequence[StationPair]
) -> tuple[dict[int, Rigid], list[StationPair]]:
    """Return the poses of all stations that verified pairs lead to, and the pairs that the others outvote.

    Args:
        count: number of stations.
        fixed: index of the one that keeps its pose.
        world_from_fixed: that pose.
        pairs: verified pairs.

    Source: Grisetti et al. 2010, on SciPy's trust region with Cauchy's loss.
    """
    used = list(pairs)
    outvoted: list[StationPair] = []
    while True:
        poses = _solved(count, fixed, world_from_fixed, used)
        worst = max(used, key=lambda pair: _misfit(pair, poses)[0], default=None)
        if worst is None or worst.first not in poses:
            return poses, outvoted
        sigmas, apart_mm, apart_deg = _misfit(worst, poses)
        if sigmas < _OUTVOTED_SIGMAS or (apart_mm < _OUTVOTED_MM and apart_deg < _OUTVOTED_DEG):
            return poses, outvoted
        used.remove(worst)
        outvoted.append(
            replace(
                worst, verdict="ambiguous",
                reasons=(
                    f"The other pairs contradict it by {apart_mm:.0f} mm and {apart_deg:.2f} deg.", *worst.reasons
                ),
            )
        )  # fmt: skip


def loops_of(count: int, fixed: int, pairs: Sequence[StationPair]) -> tuple[Loop, ...]:
    """Return a loop for each pair beyond those that connect the stations, with the error of its closing."""
    ways = connected(count, fixed, pairs)
    steps = {(way[-2], way[-1]) for way in ways.values() if len(way) > 1}
    between = {(pair.first, pair.second): pair.first_from_second for pair in pairs}
    between |= {(b, a): pose.inverse for (a, b), pose in between.items()}
    loops = []
    for pair in pairs:
        a, b = pair.first, pair.second
        if (a, b) in steps or (b, a) in steps or a not in ways:
            continue
        one, other = ways[a], ways[b]
        shared = 0
        while shared < min(len(one), len(other)) and one[shared] == other[shared]:
            shared += 1
        around = [*one[shared - 1 :], *reversed(other[shared:])]
        closing = Rigid.identity()
        for here, there in zip(around, [*around[1:], around[0]], strict=True):
            closing = closing @ between[here, there]
        loops.append(
            Loop(
                tuple(around), 1000 * float(np.linalg.norm(closing.translation)),
                float(np.degrees(np.linalg.norm(rotvec_from_rotation(closing.rotation)))),
            )
        )  # fmt: skip
    return tuple(loops)


def adjusted(
    returns: dict[int, NDArray[np.float64]], fixed: int, poses: dict[int, Rigid], voxels_m: Sequence[float]
) -> dict[int, tuple[Rigid, NDArray[np.float64]]]:
    """Return poses and covariances (6, 6) of (w, c) by the surfaces that all stations share.

    Args:
        returns: single returns (M, 3) of each station, m.
        fixed: the station that keeps its pose.
        poses: `world_from_scanner` of each, to a few millimetres.
        voxels_m: sides of the voxels that planes are looked for in.
    """
    names = sorted(poses)
    stride = max(1, -(-sum(len(returns[name]) for name in names) // _MAX_POINTS))
    # About the fixed station, so that large coordinates of the world cost no digits.
    origin = poses[fixed]
    local = [origin.inverse @ poses[name] for name in names]
    views = [
        RangeView(returns[name][::stride], pose, np.zeros((6, 6))) for name, pose in zip(names, local, strict=True)
    ]
    done = polish(views, local, fixed=names.index(fixed), voxels_m=voxels_m)
    out = {}
    turn = np.kron(np.eye(2), origin.rotation)
    for k, name in enumerate(names):
        block = done.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        out[name] = (origin @ done.poses[k], turn @ about_centre(block, done.poses[k]) @ turn.T)
    return out


def _solved(count: int, fixed: int, world_from_fixed: Rigid, pairs: Sequence[StationPair]) -> dict[int, Rigid]:
    from scipy.optimize import least_squares

    ways = connected(count, fixed, pairs)
    between = {(pair.first, pair.second): pair.first_from_second for pair in pairs}
    between |= {(b, a): pose.inverse for (a, b), pose in between.items()}
    start = {fixed: world_from_fixed}
    for name, way in sorted(ways.items(), key=lambda one: len(one[1])):
        if len(way) > 1:
            start[name] = start[way[-2]] @ between[way[-2], name]
    free = [name for name in start if name != fixed]
    inside = [pair for pair in pairs if pair.first in start]
    if len(inside) <= len(free):  # a tree: nothing to adjust
        return start
    roots = [np.linalg.cholesky(np.linalg.inv(pair.covariance + np.diag(_FLOOR))).T for pair in inside]

    def moved(x: FloatArray) -> dict[int, Rigid]:
        steps = x.reshape(-1, 6)
        at = {
            name: Rigid(Rigid.from_rotvec(step[:3]).rotation @ start[name].rotation, start[name].translation + step[3:])
            for name, step in zip(free, steps, strict=True)
        }
        return {fixed: start[fixed], **at}

    def residuals(x: FloatArray) -> NDArray[np.float64]:
        at = moved(x)
        return np.concatenate([root @ _error(pair, at) for pair, root in zip(inside, roots, strict=True)])

    return moved(least_squares(residuals, np.zeros(6 * len(free)), loss="cauchy", x_scale="jac").x)


def _error(pair: StationPair, poses: dict[int, Rigid]) -> NDArray[np.float64]:
    """Return the (w, c) by which poses differ from a pair's."""
    between = poses[pair.first].inverse @ poses[pair.second]
    turn = rotvec_from_rotation(between.rotation @ pair.first_from_second.rotation.T)
    return np.concatenate([turn, between.translation - pair.first_from_second.translation])


def _misfit(pair: StationPair, poses: dict[int, Rigid]) -> tuple[float, float, float]:
    """Return by how many sigmas, mm and deg poses differ from a pair's."""
    if pair.first not in poses or pair.second not in poses:
        return 0.0, 0.0, 0.0
    error = _error(pair, poses)
    sigmas = float(np.sqrt(error @ np.linalg.solve(pair.covariance + np.diag(_FLOOR), error) / 6))
    return sigmas, 1000 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(error[:3])))
