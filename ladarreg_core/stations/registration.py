"""`register_scans`: scans of several stations registered to each other by their ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations

import numpy as np
from threadpoolctl import threadpool_limits

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.stations.network import adjusted, connected, loops_of, pose_graph
from ladarreg_core.stations.pair import PairOptions, Prepared, prepare, register_pair
from ladarreg_core.stations.results import PlacedStation, StationNetwork, StationPair, StationState
from ladarreg_core.validation import LARGEST_INT, require_int, require_type

_SAME_M, _SAME_RAD = 1e-3, 1e-4
MOST_SCANS = 40
"""Most scans of one call: every pair is tried."""


def register_scans(
    scans: Sequence[Scan],
    *,
    fixed: int = 0,
    use_poses: bool = True,
    options: PairOptions | None = None,
    seed: int = 0,
    report: Report | None = None,
) -> StationNetwork:
    """Register scans of several stations to each other by their surfaces.

    The scanners stood upright, within a few degrees; nothing else need be known. Every pair gets a verdict of its own;
    verified ones are adjusted together. What no verified pair leads to stays out.

    Args:
        scans: two or more.
        fixed: index of the scan that keeps its pose: its `world_from_scanner`, or the world's origin without one.
        use_poses: begin with the poses in the files, where both scans of a pair have one and they differ; a pair that
            they do not lead to is searched for like any other.
        options: the thresholds of the verdict.
        seed: random seed.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        the stations with their poses and covariances, the pairs with their verdicts, and the errors of the loops.

    Raises:
        OptionError: if there are fewer than two scans or more than `MOST_SCANS`, or an argument is of a wrong type.
    """
    _check(scans, fixed, seed)
    count = len(scans)
    o = options or PairOptions()
    names = list(combinations(range(count), 2))
    total = 2 * count + 4 * len(names) + 4

    def told(done: int, label: str) -> None:
        if report is not None:
            report(Progress(done, total, label))

    with threadpool_limits(limits=1, user_api="blas"):
        prepared: list[Prepared] = []
        for k, scan in enumerate(scans):
            told(2 * k, f"finding the surfaces of {scan.name}")
            prepared.append(prepare(scan))
        pairs = []
        for k, (a, b) in enumerate(names):
            told(2 * count + 4 * k, f"registering {scans[b].name} to {scans[a].name}")
            pairs.append(_pair(prepared, scans, (a, b), o, seed, use_poses=use_poses))
        told(total - 4, "adjusting the stations")
        return _network(scans, prepared, pairs, fixed, o, seed, use_poses=use_poses)


def _check(scans: Sequence[Scan], fixed: int, seed: int) -> None:
    if not 2 <= len(scans) <= MOST_SCANS:
        raise OptionError(f"{len(scans)} scans are given; give 2 to {MOST_SCANS}")
    for scan in scans:
        require_type(scan, Scan, "each of the scans")
    require_int(fixed, "`fixed`", least=0, most=len(scans) - 1)
    require_int(seed, "the seed", least=0, most=LARGEST_INT)


def _pair(
    prepared: Sequence[Prepared], scans: Sequence[Scan], indices: tuple[int, int], options: PairOptions, seed: int,
    *, use_poses: bool,
) -> StationPair:  # fmt: skip
    a, b = indices
    poses = scans[a].world_from_scanner, scans[b].world_from_scanner
    if use_poses and poses[0] is not None and poses[1] is not None:
        between = poses[0].inverse @ poses[1]
        # Scans that were never registered often state one and the same pose, which says nothing.
        if np.linalg.norm(between.translation) > _SAME_M or between.angle_to(Rigid.identity()) > _SAME_RAD:
            found = register_pair(prepared[a], prepared[b], indices=indices, rough=between, options=options, seed=seed)
            if found.verified:
                return found
    return register_pair(prepared[a], prepared[b], indices=indices, options=options, seed=seed)


def _network(
    scans: Sequence[Scan], prepared: Sequence[Prepared], pairs: Sequence[StationPair], fixed: int,
    options: PairOptions, seed: int, *, use_poses: bool,
) -> StationNetwork:  # fmt: skip
    count = len(scans)
    verified = [pair for pair in pairs if pair.verified]
    world = scans[fixed].world_from_scanner or Rigid.identity()
    poses, outvoted = pose_graph(count, fixed, world, verified)
    lost = {(pair.first, pair.second): pair for pair in outvoted}
    pairs = [lost.get((pair.first, pair.second), pair) for pair in pairs]
    used = [pair for pair in pairs if pair.verified]
    poses = {name: pose for name, pose in poses.items() if name in connected(count, fixed, used)}
    placed = {fixed: (world, np.zeros((6, 6)))}
    if len(poses) > 1:
        placed = adjusted({name: prepared[name].view.surfels.returns for name in poses}, fixed, poses)
    stations = []
    for k, scan in enumerate(scans):
        pose, covariance = placed.get(k, (None, np.full((6, 6), np.nan)))
        state: StationState = "fixed" if k == fixed else "out" if pose is None else "registered"
        stations.append(PlacedStation(k, scan.name, state, pose, covariance))
    out = [one.name for one in stations if one.state == "out"]
    reasons = []
    if out:
        reasons.append(f"No verified pair leads to {', '.join(out)}: left out.")
    if outvoted:
        reasons.append(f"{len(outvoted)} of the verified pairs are contradicted by the others, and were not used.")
    asked = {"fixed": fixed, "use_poses": use_poses, **asdict(options)}
    loops = loops_of(count, fixed, used)
    return StationNetwork(tuple(stations), tuple(pairs), loops, tuple(reasons), seed=seed, options=asked)
