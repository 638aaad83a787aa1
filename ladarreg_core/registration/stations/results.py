"""What is known of stations that were registered to each other: pairs, loops, and the poses that follow."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan

PairVerdict = Literal["verified", "ambiguous", "refused"]
StationState = Literal["fixed", "registered", "kept", "stated", "out"]


@dataclass(frozen=True, slots=True)
class PairEvidence:
    """The figures that a pair is judged by; NaN where there is none."""

    overlap: float
    """Share of both stations' surfaces, without floors and ceilings, that the other one measured as well."""
    contradicted: float
    """Share of the surfaces in plain view of the other station that it saw through."""
    shared_planes: int
    """Planes that the alignment rests on."""
    held_out_planes: int
    """Planes that were kept from it, and then compared."""
    held_out_ratio: float
    """RMS distance of both scans from the held-out planes, over that of each scan from its own: 1 is perfect."""
    runner_up_overlap: float
    """Overlap of the best other placement; 0 without any."""
    runner_up_contradicted: float
    """What is contradicted of it; 1 without any."""
    print_correlation: float
    """Correlation of the intensities' local contrast."""
    print_by_chance: float
    """Its median with the surfaces shifted along themselves by 25 to 85 cm."""


@dataclass(frozen=True, slots=True, eq=False)
class StatedPose:
    """How well two scans agree at the poses in their files, before anything is moved."""

    first_from_second: Rigid
    """The pose of a pair's second scan in the frame of its first."""
    overlap: float
    """As of `PairEvidence`, at this pose."""
    contradicted: float
    """As of `PairEvidence`, at this pose."""

    def away_m(self, found: Rigid) -> float:
        """Return how far another pose puts the second scanner from here, m."""
        return float(np.linalg.norm(found.translation - self.first_from_second.translation))

    def away_rad(self, found: Rigid) -> float:
        """Return the angle between another pose and this one, rad."""
        return found.angle_to(self.first_from_second)


@dataclass(frozen=True, slots=True, eq=False)
class StationPair:
    """Two stations registered to each other, and the verdict on it."""

    first: int
    """Index of the scan whose frame is used."""
    second: int
    """Index of the scan that was placed in it."""
    verdict: PairVerdict
    """`verified`; `ambiguous`: another placement, or a sliding one, explains the scans as well, or too little was left
    to check it by; `refused`: something speaks against it."""
    reasons: tuple[str, ...]
    """Sentences that say why."""
    first_from_second: Rigid
    """The pose; the best guess unless the pair is verified."""
    covariance: NDArray[np.float64]
    """(6, 6) of (w, c): R_true = exp([w]x) R, c = C_true - C; w in rad, C the second scanner's centre, m, both in
    the frame of the first."""
    evidence: PairEvidence
    """The figures."""
    start: str
    """Where the pose was found from: `search` or `poses in the files`; `poses in the files, kept`, if it is theirs."""
    not_determined: tuple[str, ...] = ()
    """What the surfaces do not hold, in words."""
    runner_up: Rigid | None = None
    """The best other placement."""
    stated: StatedPose | None = None
    """How well the scans agree at the poses in the files, whatever these were used for; None if the files state none,
    or one and the same."""

    @property
    def verified(self) -> bool:
        """Whether the pair may be used."""
        return self.verdict == "verified"

    @property
    def sigma_mm(self) -> float:
        """Largest standard deviation of the second scanner's position, mm."""
        return 1000 * _largest(self.covariance[3:, 3:])

    @property
    def sigma_deg(self) -> float:
        """Largest standard deviation of its orientation, deg."""
        return float(np.degrees(_largest(self.covariance[:3, :3])))

    def as_fields(self) -> dict[str, Any]:
        """Return what `stations.json` states of the pair."""
        pose = {"first_from_second": self.first_from_second.matrix.tolist()}
        return {
            "first": self.first, "second": self.second, "verdict": self.verdict, "reasons": list(self.reasons),
            **(pose if self.verified else {"first_from_second": None, "rejected_guess": pose}),
            "covariance": _numbers(self.covariance) if self.verified else None,
            "sigma_mm": _number(self.sigma_mm), "sigma_deg": _number(self.sigma_deg), "start": self.start,
            "evidence": {name: _number(value) for name, value in asdict(self.evidence).items()},
            "not_determined": list(self.not_determined), "stated": self._stated_fields(),
        }  # fmt: skip

    def _stated_fields(self) -> dict[str, Any] | None:
        stated = self.stated
        if stated is None:
            return None
        pose = self.first_from_second
        return {
            "first_from_second": stated.first_from_second.matrix.tolist(), "overlap": stated.overlap,
            "contradicted": stated.contradicted,
            "away_mm": 1000 * stated.away_m(pose), "away_deg": float(np.degrees(stated.away_rad(pose))),
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Loop:
    """Verified pairs that lead back to where they began, and by how much they miss it."""

    stations: tuple[int, ...]
    """Indices in order."""
    error_mm: float
    """Distance by which the loop does not close."""
    error_deg: float
    """Angle by which it does not close."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedStation:
    """Where one scan stands."""

    index: int
    """Its place in the list of scans."""
    name: str
    """Its display name."""
    state: StationState
    """`fixed`; `registered`; `kept`: the pose of its file, confirmed by verified pairs; without a verified pair that
    leads to it: `stated`, where its file and those of its component put it, or `out`."""
    world_from_scanner: Rigid | None
    """Its pose; None if it is out."""
    covariance: NDArray[np.float64]
    """(6, 6) of (w, c) against the fixed station, as `StationPair.covariance`, in the world; zero for the fixed
    one, NaN if it is not `registered`. In surveyed coordinates no station is fixed."""
    component: int = 0
    """Stations that verified pairs connect have the same number; the fixed one has 0."""
    component_from_scanner: Rigid | None = None
    """Its pose in the frame of the first station of its component, if that has several; None in the fixed station's
    component."""

    @property
    def is_verified(self) -> bool:
        """Whether verified pairs connect it to the fixed station."""
        return self.state in ("fixed", "registered", "kept")

    def as_fields(self) -> dict[str, Any]:
        """Return what `stations.json` states of the station."""
        pose, within, known = self.world_from_scanner, self.component_from_scanner, np.isfinite(self.covariance).all()
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0)) if known else None
        return {
            "index": self.index, "name": self.name, "state": self.state,
            "world_from_scanner": None if pose is None else pose.matrix.tolist(),
            "component": self.component,
            "component_from_scanner": None if within is None else within.matrix.tolist(),
            "covariance": _numbers(self.covariance) if known else None,
            "sigma_mm": None if sigma is None else [_number(1000 * float(v)) for v in sigma[3:]],
            "sigma_deg": None if sigma is None else [_number(float(np.degrees(v))) for v in sigma[:3]],
        }  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class StationNetwork:
    """Scans in one world."""

    stations: tuple[PlacedStation, ...]
    """One for each scan, in their order."""
    pairs: tuple[StationPair, ...]
    """Every pair that was tried."""
    loops: tuple[Loop, ...]
    """Loops of verified pairs."""
    reasons: tuple[str, ...]
    """Remarks on the whole."""
    seed: int = 0
    """Random seed."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """How it was asked for."""
    statement: Mapping[str, Any] = field(default_factory=dict)
    """What else is stated, such as the survey targets that it rests on."""

    @property
    def accepted(self) -> bool:
        """Whether verified pairs lead to every scan."""
        return all(one.is_verified for one in self.stations)

    def placed(self, scans: Sequence[Scan]) -> list[Scan]:
        """Return the scans that were placed, each with its pose; those that are `out` are omitted."""
        return [
            replace(scans[one.index], world_from_scanner=one.world_from_scanner)
            for one in self.stations
            if one.world_from_scanner is not None
        ]

    def as_fields(self) -> dict[str, Any]:
        """Return the result as JSON-ready fields."""
        return {
            "accepted": self.accepted, "reasons": list(self.reasons),
            "stations": [one.as_fields() for one in self.stations],
            "pairs": [one.as_fields() for one in self.pairs], "loops": [asdict(one) for one in self.loops],
            "options": dict(self.options), "seed": self.seed, **self.statement,
        }  # fmt: skip

    def to_json(self) -> str:
        """Return the result as JSON."""
        return json.dumps(self.as_fields(), allow_nan=False, indent=2)


def _largest(covariance: NDArray[np.float64]) -> float:
    """Return the largest standard deviation in any direction; infinite if nothing is known."""
    if not np.isfinite(covariance).all():
        return float("inf")
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _numbers(matrix: NDArray[np.float64]) -> list[list[float | None]]:
    return [[_number(float(value)) for value in row] for row in matrix]
