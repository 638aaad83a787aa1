"""`register_scans`: scans of several stations registered to each other by their ranges."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import asdict, replace
from itertools import combinations
from typing import Literal, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import LARGEST_INT, require_choice, require_int, require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.stations.network import adjusted, connected, loops_of, pose_graph
from ladarreg_core.registration.stations.pair import (
    PairOptions,
    Prepared,
    check_pair,
    prepare,
    register_pair,
    stated_pose,
    voxels_of,
)
from ladarreg_core.registration.stations.results import Loop, PlacedStation, StationNetwork, StationPair, StationState
from ladarreg_core.scan import Scan

PoseUse = Literal["keep", "refine", "search"]
"""What is done with the poses that the files state: `keep`: they are kept to the last digit, and judged; `refine`:
refined within a metre; `search`: ignored, and searched for."""
POSE_USES: tuple[PoseUse, ...] = get_args(PoseUse)
_SAME_M, _SAME_RAD = 1e-3, 1e-4  # up to which poses are one and the same
_UNKNOWN = np.full((6, 6), np.nan)
MAX_SCANS = 40
"""Most scans of one call: every pair is tried."""


def register_scans(
    scans: Sequence[Scan],
    *,
    fixed: int = 0,
    poses: PoseUse = "refine",
    options: PairOptions | None = None,
    seed: int = 0,
    report: Report | None = None,
) -> StationNetwork:
    """Register scans of several stations to each other by their surfaces.

    The scanners stood upright, within a few degrees; nothing else need be known. Every pair gets a verdict of its own;
    verified ones are adjusted together. A station that no verified pair leads to is left out, unless its file states
    where it stands and nothing contradicts that: then it stays there, unverified.

    Args:
        scans: two or more.
        fixed: index of the scan that keeps its pose: its `world_from_scanner`, or the world's origin without one.
        poses: what the poses in the files are used for, where both scans of a pair have one and they differ; `keep`:
            they are judged as they are; `refine`: only what is within a metre of them is compared; `search`: they are
            ignored. How well the scans agree at these poses is stated in any case.
        options: the thresholds of the verdict.
        seed: random seed.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        the stations with their poses and covariances, the pairs with their verdicts, and the errors of the loops.

    Raises:
        OptionError: if there are fewer than two scans or more than `MAX_SCANS`, an argument is of a wrong type, or
            poses are to be kept but a file states none.
    """
    _check(scans, fixed, poses, seed)
    count = len(scans)
    o = options or PairOptions()
    names = list(combinations(range(count), 2))
    total = 2 * count + 4 * len(names) + 4

    def reported(done: int, label: str) -> None:
        if report is not None:
            report(Progress(done, total, label))

    with threadpool_limits(limits=1, user_api="blas"):
        prepared: list[Prepared] = []
        for k, scan in enumerate(scans):
            reported(2 * k, f"finding the surfaces of {scan.name}")
            prepared.append(prepare(scan))
        pairs = []
        for k, (a, b) in enumerate(names):
            reported(2 * count + 4 * k, f"registering {scans[b].name} to {scans[a].name}")
            pairs.append(_pair(prepared, scans, (a, b), poses, o, seed))
        reported(total - 4, "adjusting the stations")
        return _network(scans, prepared, pairs, fixed, poses, o, seed)


def _check(scans: Sequence[Scan], fixed: int, poses: PoseUse, seed: int) -> None:
    if not 2 <= len(scans) <= MAX_SCANS:
        raise OptionError(f"{len(scans)} scans are given; give 2 to {MAX_SCANS}")
    for scan in scans:
        require_type(scan, Scan, "each of the scans")
    require_int(fixed, "`fixed`", least=0, most=len(scans) - 1)
    require_int(seed, "the seed", least=0, most=LARGEST_INT)
    require_choice(poses, POSE_USES, "`poses`")
    without = [scan.name for scan in scans if scan.world_from_scanner is None]
    if poses == "keep" and without:
        raise OptionError(
            f"the file of {', '.join(without)} states no pose that could be kept; leave it out, or use `poses='refine'`"
        )


def _stated_between(first: Scan, second: Scan) -> Rigid | None:
    """Return `first_from_second` by the poses in the files; None if they say nothing."""
    if first.world_from_scanner is None or second.world_from_scanner is None:
        return None
    between = first.world_from_scanner.inverse @ second.world_from_scanner
    # Scans that were never registered often state one and the same pose.
    same = np.linalg.norm(between.translation) <= _SAME_M and between.angle_to(Rigid.identity()) <= _SAME_RAD
    return None if same else between


def _pair(
    prepared: Sequence[Prepared], scans: Sequence[Scan], indices: tuple[int, int], poses: PoseUse,
    options: PairOptions, seed: int,
) -> StationPair:  # fmt: skip
    first, second = (prepared[index] for index in indices)
    between = _stated_between(*(scans[index] for index in indices))
    if poses == "keep":
        found = check_pair(first, second, between or Rigid.identity(), indices=indices, options=options)
    else:
        rough = between if poses == "refine" else None
        found = register_pair(first, second, indices=indices, rough=rough, options=options, seed=seed)
    if between is None:
        return found
    stated, pose = stated_pose(first, second, between), found.first_from_second
    said = (
        f"At the poses in the files, {stated.overlap:.1%} of the surfaces agree and {stated.contradicted:.1%} of those "
        "in plain view are contradicted"
    )
    if poses != "keep":
        said += (
            f"; {'the pose found' if found.verified else 'the best guess'} is {format_length(stated.away_m(pose))} and "
            f"{format_angle(stated.away_rad(pose))} away from them"
        )
    reasons = [*found.reasons, f"{said}."]
    if poses == "refine" and not found.verified:
        reasons.append("Only what is within a metre of them was compared; `poses='search'` looks everywhere.")
    return replace(found, reasons=tuple(reasons), stated=stated)


def _network(
    scans: Sequence[Scan], prepared: Sequence[Prepared], pairs: Sequence[StationPair], fixed: int, poses: PoseUse,
    options: PairOptions, seed: int,
) -> StationNetwork:  # fmt: skip
    count = len(scans)
    used = [pair for pair in pairs if pair.verified]
    lost: dict[tuple[int, int], StationPair] = {}
    loops: list[Loop] = []
    stations: dict[int, PlacedStation] = {}
    number = 0  # of a component, which verified pairs connect: first that of the fixed station, then the others
    while left := [k for k in range(count) if k not in stations]:
        stated = [k for k in left if poses != "search" and _stated_between(scans[fixed], scans[k]) is not None]
        root = fixed if number == 0 else (stated or left)[0]
        world = scans[root].world_from_scanner if root in (fixed, *stated) else None
        base = world or Rigid.identity()
        if poses == "keep":
            members = sorted(connected(count, root, used))
            placed = {k: (scans[k].world_from_scanner or base, _UNKNOWN) for k in members}
        else:
            graph, outvoted = pose_graph(count, root, base, used)
            lost |= {(pair.first, pair.second): pair for pair in outvoted}
            used = [pair for pair in used if (pair.first, pair.second) not in lost]
            members = sorted(connected(count, root, used))
            placed = {root: (base, np.zeros((6, 6)))}
            if len(members) > 1:
                placed = adjusted(
                    {k: prepared[k].view.surfels.returns for k in members},
                    root,
                    {k: graph[k] for k in members},
                    voxels_of([prepared[k] for k in members]),
                )
        loops += loops_of(count, root, used)
        stands = (
            number == 0
            or poses == "keep"
            or (world is not None and not _contradicted(pairs, members, stations, options))
        )
        for k in members:
            pose, covariance = placed[k]
            state: StationState = "kept" if poses == "keep" else "registered"
            if number > 0:
                state, covariance = "stated" if stands else "out", _UNKNOWN
            if k == fixed:
                state, covariance = "fixed", np.zeros((6, 6))
            within = placed[root][0].inverse @ pose if number > 0 and len(members) > 1 else None
            stations[k] = PlacedStation(k, scans[k].name, state, pose if stands else None, covariance, number, within)
        number += 1
    listed = [stations[k] for k in range(count)]
    pairs = [lost.get((pair.first, pair.second), pair) for pair in pairs]
    asked = {"fixed": fixed, "poses": poses, **asdict(options)}
    reasons = _reasons(listed, len(lost))
    return StationNetwork(tuple(listed), tuple(pairs), tuple(loops), reasons, seed=seed, options=asked)


def _contradicted(
    pairs: Sequence[StationPair], members: Sequence[int], placed: Container[int], options: PairOptions
) -> bool:
    """Return whether the stated poses of a component's members are contradicted by stations that have a place."""
    return any(
        pair.stated is not None and pair.stated.contradicted > options.most_contradicted
        for pair in pairs
        if (pair.first in members and pair.second in placed) or (pair.second in members and pair.first in placed)
    )


def _reasons(stations: Sequence[PlacedStation], outvoted: int) -> tuple[str, ...]:
    """Return remarks on the network as a whole."""
    reasons = []
    for state, what in (("out", "left out"), ("stated", "placed as the files state, not verified")):
        if names := [one.name for one in stations if one.state == state]:
            reasons.append(f"No verified pair leads to {', '.join(names)}: {what}.")
    components: dict[int, list[str]] = {}
    for one in stations:
        if one.component_from_scanner is not None:
            components.setdefault(one.component, []).append(one.name)
    reasons += [f"Verified pairs connect {', '.join(names)} to each other." for names in components.values()]
    if outvoted:
        reasons.append(f"{outvoted} of the verified pairs are contradicted by the others, and were not used.")
    return tuple(reasons)
