"""Which of the targets found in several scans are the same, by the distances between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_matching import (
    FLOOR_M,
    SIGMAS,
    Array,
    Assignment,
    fits_by_chance,
    is_line,
    ranked_assignments,
    rigid_motion,
)

MAX_ASSIGNMENTS = 6000
"""Of a target to another, compared each with each: 36 MB an array of truths."""
MOVED_M = 0.05
"""Up to which a target that is not where it should be is still taken for it: it was moved."""
_BY_CHANCE = 1e-3  # expected number of other assignments of as many targets
_AS_GOOD = 0.5  # share of the targets from which on another assignment may be right
_HARDLY_BY_CHANCE = 4  # three of thirty often fit somewhere
_CLOSE = 5.0  # tolerances within which two placements are one


@dataclass(frozen=True, slots=True, eq=False)
class _Thing:
    """What looks like a target, as one scan sees it or several that were joined."""

    place: Array
    variance: float
    size: tuple[float | None, float | None] | None
    """Radius and side; None: not known."""
    name: str | None
    seen: tuple[tuple[str, int], ...]
    """Scans, and which of their targets it is; empty for surveyed coordinates."""

    def may_be(self, other: _Thing) -> bool:
        if self.name is not None and other.name is not None:
            return self.name == other.name
        return self.size is None or other.size is None or self.size == other.size


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    scans: tuple[str, ...]
    """Their names for users."""
    things: tuple[_Thing, ...]


def named_across(
    scans: Mapping[str, Sequence[SurveyTarget] | Mapping[str, SurveyTarget]],
    known: Mapping[str, tuple[Array, Array]],
) -> dict[str, dict[str, SurveyTarget]]:
    """Return the targets of scans under names that are the same in all of them.

    Args:
        scans: the targets of each, by name or not.
        known: (3,) surveyed coordinates, m, and their covariance (3, 3), by name; three or more, or none.

    Raises:
        DegenerateGeometryError: if not all of them have three targets in common with the others that cannot be taken
            for different ones.
    """
    listed = {scan: list(own.values()) if isinstance(own, Mapping) else list(own) for scan, own in scans.items()}
    clusters = {
        k: _Cluster((f"scan {scan}",), tuple(
            _Thing(one.center, float(np.trace(one.covariance)) / 3, (one.radius_m, one.side_m), name, ((scan, n),))
            for n, (name, one) in enumerate(_with_names(own))
        ))
        for k, (scan, own) in enumerate(scans.items())
    }  # fmt: skip
    if known:
        clusters[-1] = _Cluster(("the coordinates",), tuple(
            _Thing(place, float(np.trace(covariance)) / 3, None, name, ())
            for name, (place, covariance) in known.items()
        ))  # fmt: skip
    things = _taken_up(_joined_all(clusters).things)
    out: dict[str, dict[str, SurveyTarget]] = {scan: {} for scan in scans}
    taken = {thing.name for thing in things} | set(known)
    number = 0
    for thing in things:
        name = thing.name
        if name is None and len(thing.seen) > 1:
            number += 1
            while (name := f"T{number}") in taken:
                number += 1
        if name is not None:
            for scan, n in thing.seen:
                out[scan][name] = listed[scan][n]
    return out


def _with_names(own: Sequence[SurveyTarget] | Mapping[str, SurveyTarget]) -> list[tuple[str | None, SurveyTarget]]:
    return list(own.items()) if isinstance(own, Mapping) else [(None, one) for one in own]


def _joined_all(clusters: dict[int, _Cluster]) -> _Cluster:
    tried: dict[tuple[int, int], tuple[Assignment, Rigid] | str] = {}
    while len(clusters) > 1:
        both = list(combinations(clusters, 2))
        for i, j in both:
            if (i, j) not in tried:
                tried[i, j] = _matched(clusters[i], clusters[j])
        options = [(-len(found[0]), i, j) for i, j in both if isinstance(found := tried[i, j], tuple)]
        if not options:
            first, *others = sorted(clusters.values(), key=lambda one: -len(one.scans))
            (_, why) = max(((len(clusters[i].things) + len(clusters[j].things), tried[i, j]) for i, j in both),
                           key=lambda one: one[0])  # fmt: skip
            outside = [name for cluster in others for name in cluster.scans]
            raise DegenerateGeometryError(
                f"the targets of {_listed(outside)} cannot be matched with those of {_listed(first.scans)}: {why}; "
                "name them by picks, or put up more, at uneven distances, that both see"
            )
        _, i, j = min(options)
        found = tried[i, j]
        assert isinstance(found, tuple)
        clusters[len(tried) + len(clusters)] = _fused(clusters.pop(i), clusters.pop(j), *found)
    (only,) = clusters.values()
    return only


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _matched(first: _Cluster, second: _Cluster) -> tuple[Assignment, Rigid] | str:
    """Return which things of the second are which of the first, and `first_from_second`; or why that is open."""
    nodes = np.array(
        [(a, i) for a, one in enumerate(second.things) for i, other in enumerate(first.things) if one.may_be(other)],
        np.intp,
    ).reshape(-1, 2)  # fmt: skip
    both = f"{len(first.things)} and {len(second.things)} things in {_listed(first.scans)} and {_listed(second.scans)}"
    if len(nodes) > MAX_ASSIGNMENTS:
        return f"{both} look like targets, too many to be matched"
    own, world = (np.array([one.place for one in each.things]).reshape(-1, 3) for each in (second, first))
    variances = [np.array([one.variance for one in each.things]) for each in (second, first)]
    tolerance = FLOOR_M + SIGMAS * np.sqrt(variances[0][nodes[:, 0]] + variances[1][nodes[:, 1]])
    ranked = [one for one in ranked_assignments(nodes, own, world, tolerance) if not is_line(own[[a for a, _ in one]])]
    if not ranked:
        return f"{both} look like targets, and no three, not on a line, are as far from each other in both"
    best = ranked[0]
    motions = [rigid_motion(own[[a for a, _ in one]], world[[i for _, i in one]]) for one in ranked]
    reach = own[[a for a, _ in best]]
    middle = float(np.median(tolerance))
    for one, motion in zip(ranked[1:], motions[1:], strict=True):
        elsewhere = float(np.abs(motion @ reach - motions[0] @ reach).max()) > _CLOSE * middle
        if elsewhere and len(one) >= max(_AS_GOOD * len(best), min(_HARDLY_BY_CHANCE, len(best) - 1)):
            return f"of {both} {len(best)} fit each other, but {len(one)} would fit in another way as well"
    if fits_by_chance(len(own), len(world), len(best), own, middle) > _BY_CHANCE:
        return f"of {both} {len(best)} fit each other, so few that they may fit by chance"
    return best, motions[0]


def _fused(first: _Cluster, second: _Cluster, same: Assignment, first_from_second: Rigid) -> _Cluster:
    of_second = {i: second.things[a] for a, i in same}
    things = []
    for i, thing in enumerate(first.things):
        if (other := of_second.get(i)) is None:
            things.append(thing)
            continue
        share = other.variance / max(thing.variance + other.variance, 1e-30)
        things.append(_Thing(
            share * thing.place + (1 - share) * (first_from_second @ other.place),
            thing.variance * share, thing.size or other.size, thing.name or other.name, (*thing.seen, *other.seen),
        ))  # fmt: skip
    matched = {a for a, _ in same}
    things += [replace(one, place=np.asarray(first_from_second @ one.place, np.float64))
               for a, one in enumerate(second.things) if a not in matched]  # fmt: skip
    return _Cluster((*first.scans, *second.scans), tuple(things))


def _taken_up(things: Sequence[_Thing]) -> list[_Thing]:
    """Return the things with those taken up that were moved a little, or misnamed: an adjustment leaves them out."""
    kept = [one for one in things if len(one.seen) != 1 or one.name is not None]
    for one in (one for one in things if len(one.seen) == 1 and one.name is None):
        near = [
            (float(np.linalg.norm(one.place - other.place)), k)
            for k, other in enumerate(kept)
            if one.may_be(other) and all(scan != one.seen[0][0] for scan, _ in other.seen)
        ]
        away, k = min(near, default=(np.inf, 0))
        if away < MOVED_M:
            kept[k] = replace(kept[k], seen=(*kept[k].seen, *one.seen))
    return kept
