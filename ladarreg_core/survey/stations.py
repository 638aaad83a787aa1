"""Where the scanners of a survey stood: stated, or found by their surfaces or by survey targets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError, LadarregError, OptionError
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid, skew
from ladarreg_core.registration.stations.registration import register_scans
from ladarreg_core.registration.stations.results import StationPair
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_matching import LEAST
from ladarreg_core.registration.stations.target_names import locate_targets
from ladarreg_core.registration.stations.target_pose import TargetNetwork, TargetRegistration, register_targets
from ladarreg_core.scan import Scan
from ladarreg_core.survey.least_squares.problem import (
    WORLD,
    Matrix,
    RelativePose,
    pose_difference,
    relative_residual,
)
from ladarreg_core.survey.parts import SurveyScan

_DIFFERS = 27.9  # squared Mahalanobis distance with 6 degrees of freedom, exceeded once in 10,000
_FLOOR = np.diag([float(np.radians(0.002)) ** 2] * 3 + [2e-4**2] * 3)  # pairs share surfaces, and none is quite flat


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """Where a scanner stood before the adjustment."""

    world_from_scanner: Rigid | None
    """None: not known; photographs are registered on it only by itself."""
    fixed: bool
    """Whether it does not move."""
    reasons: tuple[str, ...] = ()
    """Sentences that say where this comes from."""
    by_targets: TargetRegistration | None = None
    """What its survey targets say of its pose, which holds it with their covariance."""

    @property
    def placed(self) -> bool:
        """Whether it is part of the adjustment."""
        return self.world_from_scanner is not None


@dataclass(frozen=True, slots=True, eq=False)
class TargetPair:
    """A scan that is joined to another by the targets that both, or others between them, see."""

    first: int
    second: int
    first_from_second: Rigid
    covariance: Matrix
    """(6, 6), as of `StationPair`."""
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """All of a survey, and what verified pairs of them say."""

    each: tuple[Station, ...]
    pairs: tuple[StationPair, ...] = ()
    joined: tuple[TargetPair, ...] = ()
    """Scans whose own targets do not place them, each joined to one by shared targets."""

    def relative(self, bodies: Sequence[int]) -> list[RelativePose]:
        """Return what the poses of the stations rest on, by their bodies (-1: not in the problem)."""
        found = [
            RelativePose(
                body, WORLD, held.world_from_scanner.inverse,
                _of_inverse(held.world_from_scanner, held.covariance), name="its survey targets",
            )
            for one, body in zip(self.each, bodies, strict=True)
            if (held := one.by_targets) is not None and body >= 0
        ]  # fmt: skip
        for pair in self.pairs:
            first, second = bodies[pair.first], bodies[pair.second]
            if not pair.verified or first < 0 or second < 0:
                continue
            found.append(
                RelativePose(
                    second, first, pair.first_from_second.inverse,
                    _of_inverse(pair.first_from_second, pair.covariance + _FLOOR),
                    name=f"the surfaces of scans {pair.first + 1} and {pair.second + 1}",
                )
            )  # fmt: skip
        found += [
            RelativePose(
                bodies[one.second], bodies[one.first], one.first_from_second.inverse,
                _of_inverse(one.first_from_second, one.covariance),
                name=f"the survey targets of scans {one.first + 1} and {one.second + 1}",
            )
            for one in self.joined if min(bodies[one.first], bodies[one.second]) >= 0
        ]  # fmt: skip
        return found


def place_stations(
    given: Sequence[SurveyScan], scans: Sequence[Scan], *, origin: Matrix | None = None, seed: int = 0,
    report: Report | None = None,
) -> Stations:  # fmt: skip
    """Return where the scanners of a survey stood.

    Survey targets define the world, or else a scan that is fixed, or the first. Where others state where they stood,
    that is refined by the surfaces; where they do not, it is searched for. What a file states of its scan is of another
    world than that of targets, and is not used beside them. Scans with targets of which fewer than three are surveyed
    are joined to the others by the targets that they share.

    Args:
        given: the survey's scans.
        scans: the scans themselves.
        origin: (3,) where the origin of the scans' world is in that of the targets' coordinates, m; None: the same.
        seed: random seed.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        OptionError: if a scan besides the first fixed one is fixed and its pose is not stated, there are too many, or
            the radius of a target is not known.
        DegenerateGeometryError: if the targets of a scan do not determine its pose, or the surfaces that two scans
            share contradict where targets put them.
    """
    begins = np.zeros(3) if origin is None else origin
    seen = {k: _seen(one, scan, begins) for k, (one, scan) in enumerate(zip(given, scans, strict=True))
            if one.targets is not None}  # fmt: skip
    by_targets, joined = _by_targets(given, seen)
    near = {k: found.world_from_scanner for k, found in by_targets.items()}
    root = next(iter(by_targets), next((k for k, one in enumerate(given) if one.fixed), 0))
    if joined and not by_targets and root == joined[0].first:
        near[root] = given[root].world_from_scanner or scans[root].world_from_scanner or Rigid.identity()
    near |= {one.second: near[one.first] @ one.first_from_second for one in joined if one.first in near}
    placed = [
        replace(scan, world_from_scanner=near[k]) if k in near
        else replace(scan, world_from_scanner=one.world_from_scanner) if one.world_from_scanner or by_targets
        else scan
        for k, (one, scan) in enumerate(zip(given, scans, strict=True))
    ]  # fmt: skip
    if len(scans) == 1:
        if by_targets:
            return Stations((_held(by_targets[0]),))
        pose = placed[0].world_from_scanner or Rigid.identity()
        return Stations((Station(pose, True, ("The only scan: its frame is that of all poses.",)),))
    stated = [scan.world_from_scanner for scan in placed]
    unknown = [one.id for k, one in enumerate(given) if one.fixed and stated[k] is None and k != root]
    if unknown:
        raise OptionError(
            f"the scans {', '.join(unknown)} are fixed, but neither the survey nor their files state where they stood; "
            "state their world_from_scanner, or let them be registered"
        )
    if all(one.fixed for one in given):
        return Stations(tuple(Station(pose or Rigid.identity(), True, ("Fixed by the survey.",)) for pose in stated))
    network = register_scans(placed, fixed=root, poses="refine", seed=seed, report=report)
    each = []
    leads = {one.second: one for one in joined}
    for one, found, before in zip(given, network.stations, stated, strict=True):
        fixed = one.fixed or found.index == root
        if found.index in by_targets:
            each.append(_held(by_targets[found.index]))
        elif one.fixed and before is not None:
            each.append(Station(before, True, ("Fixed by the survey.",)))
        elif found.index == root:
            each.append(Station(found.world_from_scanner, fixed, ("It defines the world.",)))
        elif found.state == "registered":
            each.append(Station(found.world_from_scanner, False, ("Registered by its surfaces.",)))
        elif found.index in leads:
            by_joint = near.get(found.index) if found.state == "stated" else None
            each.append(Station(by_joint, False, (leads[found.index].reason,)))
        elif found.state == "stated":
            each.append(Station(found.world_from_scanner, True, ("Where its file states; no surfaces verify that.",)))
        else:
            each.append(Station(None, False, ("No verified pair of scans leads to it: left out.",)))
    _check_targets(given, each, network.pairs)
    _check_joined(given, joined, network.pairs)
    led = _led_to(each, network.pairs, joined) if by_targets or joined else each
    return Stations(tuple(led), network.pairs, joined)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The targets in a scan, and what was surveyed of them."""

    targets: Mapping[str, SurveyTarget]
    coordinates: Mapping[str, Matrix]
    sigma_m: float


def _seen(one: SurveyScan, scan: Scan, origin: Matrix) -> _Seen:
    """Return the targets in a scan, with coordinates from an origin (3,) in theirs, m."""
    from ladarreg_core.formats.documents.targets_file import read_targets, surveyed_coordinates

    assert one.targets is not None
    entries = read_targets(one.targets.source)
    sizes = {entry.name: entry.size_or(radius_m=one.targets.radius_m) for entry in entries}
    unknown = [name for name, size in sizes.items() if not size]
    if unknown:
        raise OptionError(
            f"scan {one.id}: the radius of the targets {', '.join(unknown[:5])} is not known; give it as 'radius_m' of "
            "the scan, or in a column radius_m, that of flat ones in a column side_m"
        )
    picks, sigma_m = {entry.name: entry.pick for entry in entries}, one.targets.sigma_m
    coordinates = {name: np.asarray(place) - origin for name, place in surveyed_coordinates(entries).items()}
    try:
        return _Seen(locate_targets(scan, picks, sizes, coordinates, sigma_m=sigma_m), coordinates, sigma_m)
    except LadarregError as error:
        raise type(error)(f"scan {one.id}: {error}") from None


def _by_targets(
    given: Sequence[SurveyScan], seen: Mapping[int, _Seen]
) -> tuple[dict[int, TargetRegistration], tuple[TargetPair, ...]]:
    """Return where the scanners stood whose own targets say so, and how the other scans with targets are joined."""
    held: dict[int, TargetRegistration] = {}
    for k, one in seen.items():
        if len(one.coordinates) < LEAST and len(seen) > 1:
            continue
        try:
            held[k] = register_targets(one.targets, one.coordinates, sigma_m=one.sigma_m)
        except LadarregError as error:
            raise type(error)(f"scan {given[k].id}: {error}") from None
    if len(held) == len(seen):
        return held, ()
    surveyed = {name: place for one in seen.values() for name, place in one.coordinates.items()}
    sigma_m = max(one.sigma_m for one in seen.values())
    network = register_targets({given[k].id: one.targets for k, one in seen.items()}, surveyed, sigma_m=sigma_m)
    if not held and network.in_coordinates:
        first = next(iter(seen))
        name = given[first].id
        held[first] = TargetRegistration(
            network.world_from_scanner[name], network.covariance_of(name), network.residuals_m[name],
            tuple(target for scan, target in network.left_out if scan == name), network.chi2, network.dof,
        )  # fmt: skip
    bases = list(held) or list(seen)[:1]
    joined = []
    for k in (k for k in seen if k not in bases):
        base = max(bases, key=lambda other: len(_shared(network, given[other].id, given[k].id)))
        pose, covariance = network.between(given[base].id, given[k].id)
        count = len(_used(network, given[k].id))
        reason = f"Joined to scan {given[base].id} by {count} survey targets that other scans show as well."
        joined.append(TargetPair(base, k, pose, covariance, reason))
    return held, tuple(joined)


def _used(network: TargetNetwork, scan: str) -> set[str]:
    return {name for name in network.residuals_m[scan] if (scan, name) not in network.left_out}


def _shared(network: TargetNetwork, first: str, second: str) -> set[str]:
    return _used(network, first) & _used(network, second)


def _held(found: TargetRegistration) -> Station:
    used = [name for name in found.residuals_m if name not in found.left_out]
    most = max(float(np.linalg.norm(found.residuals_m[name])) for name in used)
    reasons = [f"Held by {len(used)} survey targets, whose residuals are up to {1000 * most:.1f} mm."]
    if found.left_out:
        reasons.append(f"Targets that contradict the others were left out: {', '.join(found.left_out)}.")
    return Station(found.world_from_scanner, False, tuple(reasons), found)


def _check_targets(given: Sequence[SurveyScan], each: Sequence[Station], pairs: Sequence[StationPair]) -> None:
    """Raise an error if surfaces contradict where targets, or targets and a fixed scan, put two scanners."""
    known = [one.by_targets is not None or (scan.fixed and one.fixed) for one, scan in zip(each, given, strict=True)]
    for pair in pairs:
        both = (pair.first, pair.second)
        if not (pair.verified and all(known[k] for k in both) and any(each[k].by_targets for k in both)):
            continue
        poses, covariances = [], []
        for k in both:
            world_from_scanner, held = each[k].world_from_scanner, each[k].by_targets
            assert world_from_scanner is not None
            poses.append(world_from_scanner.inverse)
            covariances.append(
                np.zeros((6, 6)) if held is None else _of_inverse(world_from_scanner, held.covariance)
            )  # fmt: skip
        seen = RelativePose(
            1, 0, pair.first_from_second.inverse, _of_inverse(pair.first_from_second, pair.covariance + _FLOOR)
        )  # fmt: skip
        off, by_second, by_first = relative_residual(seen, poses, None)
        of_all = seen.covariance + by_first @ covariances[0] @ by_first.T + by_second @ covariances[1] @ by_second.T
        if float(off @ np.linalg.solve(of_all, off)) > _DIFFERS:
            first, second = (given[k].id for k in both)
            raise DegenerateGeometryError(
                f"the targets put the scans {first} and {second} {1000 * np.linalg.norm(off[3:]):.0f} mm and "
                f"{np.degrees(np.linalg.norm(off[:3])):.2f} deg from where the surfaces that both show do; check "
                "names, coordinates and picks of the targets, and that they are of one datum"
            )


def _check_joined(given: Sequence[SurveyScan], joined: Sequence[TargetPair], pairs: Sequence[StationPair]) -> None:
    """Raise an error if the surfaces of two scans contradict how shared targets join them."""
    verified = {(pair.first, pair.second): pair for pair in pairs if pair.verified}
    for one in joined:
        pair = verified.get((min(one.first, one.second), max(one.first, one.second)))
        if pair is None:
            continue
        between = one.first_from_second if pair.first == one.first else one.first_from_second.inverse
        covariance = one.covariance if pair.first == one.first else _inverse_covariance(one)
        off = pose_difference(pair.first_from_second.inverse, between.inverse)
        both = _of_inverse(between, covariance) + _of_inverse(pair.first_from_second, pair.covariance + _FLOOR)
        if float(off @ np.linalg.solve(both, off)) > _DIFFERS:
            raise DegenerateGeometryError(
                f"the targets that the scans {given[one.first].id} and {given[one.second].id} share put them "
                f"{1000 * np.linalg.norm(off[3:]):.0f} mm and {np.degrees(np.linalg.norm(off[:3])):.2f} deg from where "
                "the surfaces that both show do; check names and picks of the targets, and that none was moved"
            )


def _inverse_covariance(one: TargetPair) -> Matrix:
    """Return the covariance (6, 6) of `second_from_first`, of (w, c) in the frame of the second."""
    pose = one.first_from_second
    step = np.zeros((6, 6))
    step[:3, :3] = step[3:, 3:] = -pose.rotation.T
    step[3:, :3] = -pose.rotation.T @ skew(pose.translation)
    return np.asarray(step @ one.covariance @ step.T)


def _led_to(
    each: Sequence[Station], pairs: Sequence[StationPair], joined: Sequence[TargetPair]
) -> list[Station]:  # fmt: skip
    """Return the stations, with those that a verified pair or shared targets join to any that is placed."""
    found = list(each)
    links: list[StationPair | TargetPair] = [pair for pair in pairs if pair.verified]
    for _ in found:
        for pair in (*joined, *links):
            first, second = found[pair.first].world_from_scanner, found[pair.second].world_from_scanner
            if (first is None) == (second is None):
                continue
            if first is not None:
                new, pose = pair.second, first @ pair.first_from_second
            else:
                assert second is not None
                new, pose = pair.first, second @ pair.first_from_second.inverse
            reason = pair.reason if isinstance(pair, TargetPair) else "Registered by its surfaces."
            found[new] = Station(pose, False, (reason,))
    return found


def _of_inverse(pose: Rigid, covariance: Matrix) -> Matrix:
    """Return the covariance (6, 6) of a scanner's own (w, c): w about its axes, c in the frame that its pose leads to.

    That of the pose is of R_true = exp([w]x) R, w in that frame; for the inverse rotation
    R^T exp(-[w]x) = exp(-[R^T w]x) R^T.
    """
    turn = np.eye(6)
    turn[:3, :3] = -pose.rotation.T
    return np.asarray(turn @ covariance @ turn.T)
