"""`name_targets`: which of the targets found in a scan are which, by the distances between them; and picked ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError, LadarregError, OptionError
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_correspondence import MAX_ASSIGNMENTS, MOVED_M, named_across
from ladarreg_core.registration.stations.target_matching import (
    FLOOR_M,
    LEAST,
    SIGMAS,
    fits_by_chance,
    ranked_assignments,
    rigid_motion,
)
from ladarreg_core.registration.stations.target_pose import known_place
from ladarreg_core.registration.stations.target_search import find_targets
from ladarreg_core.registration.stations.targets import fit_target
from ladarreg_core.scan import Scan

Array = NDArray[np.float64]
_BY_CHANCE = 0.01  # expected number of other assignments of as many targets
_NO_COORDINATES: Mapping[str, Any] = MappingProxyType({})


@overload
def name_targets(
    found: Sequence[SurveyTarget], coordinates: Mapping[str, SurveyTarget | ArrayLike], *, sigma_m: float = ...
) -> dict[str, SurveyTarget]: ...
@overload
def name_targets(
    found: Mapping[str, Sequence[SurveyTarget] | Mapping[str, SurveyTarget]],
    coordinates: Mapping[str, ArrayLike] = ..., *, sigma_m: float = ...,
) -> dict[str, dict[str, SurveyTarget]]: ...  # fmt: skip
def name_targets(
    found: Sequence[SurveyTarget] | Mapping[str, Sequence[SurveyTarget] | Mapping[str, SurveyTarget]],
    coordinates: Mapping[str, Any] = _NO_COORDINATES,
    *,
    sigma_m: float = 0.001,
) -> dict[str, SurveyTarget] | dict[str, dict[str, SurveyTarget]]:
    """Name targets that were found in scans by where targets are known to be, and leave out what is none.

    The largest set of targets whose distances from each other are those of the coordinates, and not their mirror image,
    is named, and with it what lies within 50 mm of where another one should: it may have been moved, which
    `register_targets` then says. Spheres are not taken for flat targets, nor for spheres of another radius. Targets of
    several scans are named by each other, and those that no coordinates name T1, T2 and so on.

    Args:
        found: the targets in the scan, and what else looks like them, see `find_targets`; or of several scans, by the
            names of these. Those of some scans may have names already.
        coordinates: where the targets are, by name: (3,) surveyed coordinates, m, or, for a single scan, the
            `SurveyTarget` of another one. Several scans need none.
        sigma_m: standard deviation of each surveyed coordinate, m.

    Returns:
        the targets by name, for `register_targets`; of several scans, by the names of these.

    Raises:
        OptionError: if coordinates are not three finite numbers, or `sigma_m` is negative.
        DegenerateGeometryError: if fewer than three fit, so few that they may fit by chance, or others would fit as
            well: for several scans, half as many.
    """
    if isinstance(found, Mapping):
        require_number(sigma_m, "sigma_m", least=0.0)
        named = {scan: dict(own) for scan, own in found.items() if isinstance(own, Mapping)}
        if len(named) == len(found):
            return named
        if 0 < len(coordinates) < LEAST:
            raise DegenerateGeometryError(
                f"surveyed coordinates of {len(coordinates)} targets are given, and at least {LEAST} are needed to "
                "identify the targets; give more, or none, or pick the targets"
            )
        known = {name: known_place(name, value, sigma_m) for name, value in coordinates.items()}
        return named_across(found, known)
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


def locate_in_scans(
    scans: Mapping[str, Scan],
    picks: Mapping[str, Mapping[str, tuple[int, int]]],
    sizes: Mapping[str, Mapping[str, float]],
    coordinates: Mapping[str, ArrayLike],
    *,
    looked_for: Sequence[Mapping[str, float]] = (),
    sigma_m: float = 0.001,
    report: Report | None = None,
) -> dict[str, dict[str, SurveyTarget]]:
    """Return the targets of several scans: fitted where they were picked, found and named in scans without picks.

    Args:
        scans: the scans, by name.
        picks: of some of them: row and column of a cell on each target, by its name.
        sizes: of each of these: `radius_m` or `side_m`, as of `fit_target`.
        coordinates: (3,) surveyed coordinates, m, by name, as far as they are known.
        looked_for: the sizes that are looked for in scans without picks.
        sigma_m: standard deviation of each surveyed coordinate, m.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        the targets of each scan by name, for `register_targets`.

    Raises:
        OptionError: if a pick is outside of its scan.
        DegenerateGeometryError: if a target is not where it was picked, or those found cannot be named, see
            `name_targets`.
    """
    found: dict[str, list[SurveyTarget] | dict[str, SurveyTarget]] = {}
    for number, (name, scan) in enumerate(scans.items()):
        if report is not None:
            report(Progress(number, len(scans), f"finding the targets of {name}"))
        try:
            if picks.get(name):
                found[name] = {target: _picked(scan, target, at, sizes[target]) for target, at in picks[name].items()}
            else:
                found[name] = [target for size in looked_for for target in find_targets(scan, **size)]
        except LadarregError as error:
            raise type(error)(f"scan {name}: {error}") from None
    return name_targets(found, coordinates, sigma_m=sigma_m)


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
    if len(nodes) > MAX_ASSIGNMENTS:
        raise DegenerateGeometryError(
            f"{len(found)} things in the scan look like targets, and there are {len(names)} coordinates: too many to "
            "be matched; pick the targets, or give the coordinates of those near the scanner"
        )
    tolerance = FLOOR_M + SIGMAS * np.sqrt(spread[nodes[:, 0]] + spread_of_known[nodes[:, 1]])
    ranked = list(ranked_assignments(nodes, own, world, tolerance))
    if not ranked:
        raise DegenerateGeometryError(
            f"{len(found)} things in the scan look like targets, and no three of them are as far from each other as "
            f"three of the {len(names)} coordinates; check size and coordinates, or pick the targets"
        )
    best = ranked[0]
    others = [one for one in ranked[1:] if len(one) == len(best)]
    if others or fits_by_chance(len(found), len(names), len(best), own, float(np.median(tolerance))) > _BY_CHANCE:
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
        if away[a] < MOVED_M and is_alike(found[a], names[i]):
            named[i] = a
    return {names[i]: found[named[i]] for i in sorted(named)}


def _alike(target: SurveyTarget, known: SurveyTarget | ArrayLike) -> bool:
    if not isinstance(known, SurveyTarget):
        return True
    return (target.radius_m, target.side_m) == (known.radius_m, known.side_m)
