"""`name_targets`: which of the targets found in a scan are which, by the distances between them; and picked ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError, LadarregError, OptionError
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_pose import known_place, rigid_motion
from ladarreg_core.registration.stations.target_search import find_targets
from ladarreg_core.registration.stations.targets import fit_target
from ladarreg_core.scan import Scan

Array = NDArray[np.float64]
_Assignment = tuple[tuple[int, int], ...]

_SIGMAS, _FLOOR_M = 4.0, 0.002  # up to which a distance is the same; targets are not put up to the millimetre
_LEAST_APART_M = 0.2
_MOVED_M = 0.05
_LEAST = 3
_BY_CHANCE = 0.01  # expected number of other assignments of as many targets
_MOST_TRIED = 200
_MOST_ASSIGNMENTS = 6000  # of a target to coordinates, compared each with each: 36 MB an array of truths
_ROUNDS = 5


def name_targets(
    found: Sequence[SurveyTarget],
    coordinates: Mapping[str, SurveyTarget | ArrayLike],
    *,
    sigma_m: float = 0.001,
) -> dict[str, SurveyTarget]:
    """Name targets that were found in a scan by where targets are known to be, and leave out what is none.

    The largest set of targets whose distances from each other are those of the coordinates, and not their mirror image,
    is named, and with it what lies within 50 mm of where another one should: it may have been moved, which
    `register_targets` then says. Spheres are not taken for flat targets, nor for spheres of another radius.

    Args:
        found: the targets in the scan, and what else looks like them, see `find_targets`.
        coordinates: where the targets are, by name: (3,) surveyed coordinates, m, or the `SurveyTarget` of another
            scan.
        sigma_m: standard deviation of each surveyed coordinate, m.

    Returns:
        the targets by name, for `register_targets`.

    Raises:
        OptionError: if coordinates are not three finite numbers, or `sigma_m` is negative.
        DegenerateGeometryError: if fewer than three fit, so few that they may fit by chance, or two assignments fit
            alike.
    """
    return _named(found, coordinates, lambda one, name: _alike(one, coordinates[name]), sigma_m)


def locate_targets(
    scan: Scan,
    picks: Mapping[str, tuple[int, int] | None],
    sizes: Mapping[str, Mapping[str, float]],
    coordinates: Mapping[str, ArrayLike],
    *,
    sigma_m: float = 0.001,
) -> dict[str, SurveyTarget]:
    """Return the targets of a list in a scan: fitted where they were picked, or found and named.

    Args:
        scan: the scan.
        picks: row and column of a cell on each, by name; None for all of them: they are looked for.
        sizes: of each, by name: `radius_m` or `side_m`, as of `fit_target`.
        coordinates: (3,) surveyed coordinates, m, by name.
        sigma_m: standard deviation of each surveyed coordinate, m.

    Returns:
        the targets by name; those that are looked for and not found are not among them.

    Raises:
        OptionError: if some are picked and others are not, or a pick is outside of the scan.
        DegenerateGeometryError: if one is not where it was picked, or too few are found, see `name_targets`.
    """
    unpicked = [name for name, pick in picks.items() if pick is None]
    if not unpicked:
        return {name: _picked(scan, name, pick, sizes[name]) for name, pick in picks.items() if pick is not None}
    if len(unpicked) < len(picks):
        raise OptionError(
            f"{', '.join(unpicked[:5])} {'has' if len(unpicked) == 1 else 'have'} no row and column, and others have; "
            "pick all targets, or none and they are looked for"
        )
    each = {tuple(size.items()): size for size in sizes.values()}
    found = [target for size in each.values() for target in find_targets(scan, **size)]

    def is_alike(target: SurveyTarget, name: str) -> bool:
        size = sizes[name]
        return (target.radius_m, target.side_m) == (size.get("radius_m"), size.get("side_m"))

    return _named(found, coordinates, is_alike, sigma_m)


def _picked(scan: Scan, name: str, pick: tuple[int, int], size: Mapping[str, float]) -> SurveyTarget:
    try:
        return fit_target(scan, pick, **size)
    except LadarregError as error:
        raise type(error)(f"target {name}: {error}") from None


def _named(
    found: Sequence[SurveyTarget], coordinates: Mapping[str, SurveyTarget | ArrayLike],
    is_alike: Callable[[SurveyTarget, str], bool], sigma_m: float,
) -> dict[str, SurveyTarget]:  # fmt: skip
    require_number(sigma_m, "sigma_m", least=0.0)
    names = list(coordinates)
    known = [known_place(name, coordinates[name], sigma_m) for name in names]
    own = np.array([one.center for one in found]).reshape(-1, 3)
    world = np.array([place for place, _ in known]).reshape(-1, 3)
    spread = np.array([np.trace(one.covariance) for one in found]) / 3
    spread_of_known = np.array([np.trace(covariance) for _, covariance in known]) / 3
    nodes = np.array(
        [(a, i) for a, one in enumerate(found) for i, name in enumerate(names) if is_alike(one, name)]
    ).reshape(-1, 2)
    if len(nodes) > _MOST_ASSIGNMENTS:
        raise DegenerateGeometryError(
            f"{len(found)} things in the scan look like targets, and there are {len(names)} coordinates: too many to "
            "be told apart; pick the targets, or give the coordinates of those near the scanner"
        )
    tolerance = _FLOOR_M + _SIGMAS * np.sqrt(spread[nodes[:, 0]] + spread_of_known[nodes[:, 1]])
    agrees = _agreement(nodes, own, world, tolerance)
    assignments: dict[_Assignment, float] = {}
    for chosen in _cliques(nodes, agrees):
        chosen, off = _rigid(nodes, chosen, own, world, tolerance)
        if len(chosen) >= _LEAST:
            assignments[tuple(sorted((int(a), int(i)) for a, i in nodes[chosen]))] = off
    ranked = sorted(assignments, key=lambda one: (-len(one), assignments[one]))
    if not ranked:
        raise DegenerateGeometryError(
            f"{len(found)} things in the scan look like targets, and no three of them are as far from each other as "
            f"three of the {len(names)} coordinates; check size and coordinates, or pick the targets"
        )
    best = ranked[0]
    others = [one for one in ranked[1:] if len(one) == len(best)]
    if others or _by_chance(len(found), len(names), len(best), own, float(np.median(tolerance))) > _BY_CHANCE:
        listed = ", ".join(names[i] for _, i in best)
        raise DegenerateGeometryError(
            f"{len(best)} of {len(found)} things in the scan that look like targets fit the coordinates of {listed}, "
            "but others would fit as well; pick the targets, or add some at uneven distances"
        )
    named = {i: a for a, i in best}
    pose = rigid_motion(own[list(named.values())], world[list(named)])
    for i in (k for k in range(len(names)) if k not in named):
        away = np.linalg.norm(pose @ own - world[i], axis=1)
        away[list(named.values())] = np.inf
        a = int(np.argmin(away))
        if away[a] < _MOVED_M and is_alike(found[a], names[i]):
            named[i] = a
    return {names[i]: found[named[i]] for i in sorted(named)}


def _alike(target: SurveyTarget, known: SurveyTarget | ArrayLike) -> bool:
    if not isinstance(known, SurveyTarget):
        return True
    return (target.radius_m, target.side_m) == (known.radius_m, known.side_m)


def _agreement(nodes: NDArray[np.intp], own: Array, world: Array, tolerance: Array) -> NDArray[np.bool_]:
    """Return which two of the assignments (N, 2) of a target to coordinates may both be right, (N, N)."""
    one, other = nodes[:, 0], nodes[:, 1]
    apart = np.linalg.norm(own[:, None] - own, axis=-1)[np.ix_(one, one)]
    known = np.linalg.norm(world[:, None] - world, axis=-1)[np.ix_(other, other)]
    allowed = np.hypot(tolerance[:, None], tolerance)
    agrees = (np.abs(apart - known) < allowed) & (known > _LEAST_APART_M)
    agrees &= (one[:, None] != one) & (other[:, None] != other)
    return np.asarray(agrees)


def _cliques(nodes: NDArray[np.intp], agrees: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """Yield sets of assignments that agree with each other, from the pairs that most others agree with."""
    counts = (agrees.astype(np.float32) @ agrees.astype(np.float32)) * agrees
    first, second = np.nonzero(np.triu(counts >= _LEAST - 2))
    for k in np.argsort(-counts[first, second], kind="stable")[:_MOST_TRIED]:
        chosen = [int(first[k]), int(second[k])]
        left = agrees[chosen[0]] & agrees[chosen[1]]
        while left.any():
            inside = np.flatnonzero(left)
            chosen.append(int(inside[np.argmax(agrees[np.ix_(inside, inside)].sum(axis=1))]))
            left &= agrees[chosen[-1]]
        if len(chosen) >= _LEAST:
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
        if len(now) < _LEAST or np.array_equal(now, np.sort(chosen)):
            chosen = now
            break
        chosen = now
    return chosen, float(np.sqrt(np.mean(away[chosen] ** 2))) if len(chosen) else np.inf


def _by_chance(found: int, names: int, matched: int, own: Array, tolerance_m: float) -> float:
    """Return how many sets of so many targets are expected to fit where nothing is a target.

    Three targets fit if three distances do; each one more, if it falls into a ball of the tolerance.
    """
    extent = max(float(np.linalg.norm(own - own.mean(0), axis=1).max()), _LEAST_APART_M)
    triples = np.prod(np.arange(found, found - _LEAST, -1.0)) * np.prod(np.arange(names, names - _LEAST, -1.0)) / 6
    expected = float(triples) * (2 * tolerance_m / extent) ** 3
    for k in range(_LEAST, matched):
        expected *= (found - k) * (names - k) * (tolerance_m / extent) ** 3
    return expected
