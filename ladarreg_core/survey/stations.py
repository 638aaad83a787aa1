"""Where the scanners of a survey stood: stated, or found by their surfaces or by survey targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError, LadarregError, OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.progress import Report
from ladarreg_core.registration.stations.registration import register_scans
from ladarreg_core.registration.stations.results import StationPair
from ladarreg_core.registration.stations.target_names import locate_targets
from ladarreg_core.registration.stations.target_pose import TargetRegistration, register_targets
from ladarreg_core.scan import Scan
from ladarreg_core.survey.least_squares.problem import WORLD, Matrix, RelativePose, relative_residual
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
class Stations:
    """All of a survey, and what verified pairs of them say."""

    each: tuple[Station, ...]
    pairs: tuple[StationPair, ...] = ()

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
        return found


def place_stations(
    given: Sequence[SurveyScan], scans: Sequence[Scan], *, origin: Matrix | None = None, seed: int = 0,
    report: Report | None = None,
) -> Stations:  # fmt: skip
    """Return where the scanners of a survey stood.

    Survey targets define the world, or else a scan that is fixed, or the first. Where others state where they stood,
    that is refined by the surfaces; where they do not, it is searched for. What a file states of its scan is of another
    world than that of targets, and is not used beside them.

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
    by_targets = {k: _by_targets(one, scan, begins) for k, (one, scan) in enumerate(zip(given, scans, strict=True))
                  if one.targets is not None}  # fmt: skip
    placed = [
        replace(scan, world_from_scanner=by_targets[k].world_from_scanner) if k in by_targets
        else replace(scan, world_from_scanner=one.world_from_scanner) if one.world_from_scanner or by_targets
        else scan
        for k, (one, scan) in enumerate(zip(given, scans, strict=True))
    ]  # fmt: skip
    root = next(iter(by_targets), next((k for k, one in enumerate(given) if one.fixed), 0))
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
        elif found.state == "stated":
            each.append(Station(found.world_from_scanner, True, ("Where its file states; no surfaces verify that.",)))
        else:
            each.append(Station(None, False, ("No verified pair of scans leads to it: left out.",)))
    _check_targets(given, each, network.pairs)
    return Stations(tuple(_led_to(each, network.pairs) if by_targets else each), network.pairs)


def _by_targets(one: SurveyScan, scan: Scan, origin: Matrix) -> TargetRegistration:
    """Return where a scanner stood by the targets in its scan, from an origin (3,) in their coordinates, m."""
    from ladarreg_core.formats.documents.targets_file import read_targets

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
    coordinates = {entry.name: np.asarray(entry.coordinates) - origin for entry in entries}
    try:
        targets = locate_targets(scan, picks, sizes, coordinates, sigma_m=sigma_m)
        return register_targets(targets, coordinates, sigma_m=sigma_m)
    except LadarregError as error:
        raise type(error)(f"scan {one.id}: {error}") from None


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


def _led_to(each: Sequence[Station], pairs: Sequence[StationPair]) -> list[Station]:
    """Return the stations, with those that a verified pair joins to any that is placed: each target station is one."""
    found = list(each)
    for _ in found:
        for pair in pairs:
            first, second = found[pair.first].world_from_scanner, found[pair.second].world_from_scanner
            if not pair.verified or (first is None) == (second is None):
                continue
            if first is not None:
                new, pose = pair.second, first @ pair.first_from_second
            else:
                assert second is not None
                new, pose = pair.first, second @ pair.first_from_second.inverse
            found[new] = Station(pose, False, ("Registered by its surfaces.",))
    return found


def _of_inverse(pose: Rigid, covariance: Matrix) -> Matrix:
    """Return the covariance (6, 6) of a scanner's own (w, c): w about its axes, c in the frame that its pose leads to.

    That of the pose is of R_true = exp([w]x) R, w in that frame; for the inverse rotation
    R^T exp(-[w]x) = exp(-[R^T w]x) R^T.
    """
    turn = np.eye(6)
    turn[:3, :3] = -pose.rotation.T
    return np.asarray(turn @ covariance @ turn.T)
