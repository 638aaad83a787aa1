"""Where the scanners of a survey stood: stated, or found by their surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.progress import Report
from ladarreg_core.registration.stations.registration import register_scans
from ladarreg_core.registration.stations.results import StationPair
from ladarreg_core.scan import Scan
from ladarreg_core.survey.parts import SurveyScan
from ladarreg_core.survey.problem import Matrix, RelativePose

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
        """Return the pairs that the poses rest on, between the bodies of the stations (-1: not in the problem)."""
        found = []
        for pair in self.pairs:
            first, second = bodies[pair.first], bodies[pair.second]
            if not pair.verified or first < 0 or second < 0:
                continue
            found.append(
                RelativePose(
                    second, first, pair.first_from_second.inverse, _of_second(pair),
                    name=f"the surfaces of scans {pair.first + 1} and {pair.second + 1}",
                )
            )  # fmt: skip
        return found


def place_stations(
    given: Sequence[SurveyScan], scans: Sequence[Scan], *, seed: int = 0, report: Report | None = None
) -> Stations:
    """Return where the scanners of a survey stood.

    One that is fixed, or else the first, defines the world. Where others state where they stood, that is refined by the
    surfaces; where they do not, it is searched for.

    Args:
        given: the survey's scans.
        scans: the scans themselves.
        seed: random seed.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        OptionError: if a scan besides the first fixed one is fixed and its pose is not stated, or there are too many.
    """
    placed = [
        scan if one.world_from_scanner is None else replace(scan, world_from_scanner=one.world_from_scanner)
        for one, scan in zip(given, scans, strict=True)
    ]
    root = next((k for k, one in enumerate(given) if one.fixed), 0)
    if len(scans) == 1:
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
        if one.fixed and before is not None:
            each.append(Station(before, True, ("Fixed by the survey.",)))
        elif found.index == root:
            each.append(Station(found.world_from_scanner, fixed, ("It defines the world.",)))
        elif found.state == "registered":
            each.append(Station(found.world_from_scanner, False, ("Registered by its surfaces.",)))
        elif found.state == "stated":
            each.append(Station(found.world_from_scanner, True, ("Where its file states; no surfaces verify that.",)))
        else:
            each.append(Station(None, False, ("No verified pair of scans leads to it: left out.",)))
    return Stations(tuple(each), network.pairs)


def _of_second(pair: StationPair) -> Matrix:
    """Return the covariance (6, 6) of the second scanner's own (w, c): w about its axes, c in the frame of the first.

    A pair's is of R_true = exp([w]x) R of `first_from_second`, w in the frame of the first; for the inverse rotation
    R^T exp(-[w]x) = exp(-[R^T w]x) R^T.
    """
    turn = np.eye(6)
    turn[:3, :3] = -pair.first_from_second.rotation.T
    return np.asarray(turn @ (pair.covariance + _FLOOR) @ turn.T)
