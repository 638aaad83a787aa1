"""What a rig is registered from, and its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo, TimedPhoto
from ladarreg_core.results.steps import Step
from ladarreg_core.scan import Scan

PairOutcome = Literal["agrees", "disagrees", "undecided"]


@dataclass(frozen=True, slots=True, eq=False)
class RigPair:
    """A scan and a photograph that a rig took from one place."""

    name: str
    """For messages."""
    scan: Scan
    photo: Photo
    camera_name: str = ""
    """Of the camera, where the rig has several: letters, digits, _ and -."""
    taken: tuple[TimedPhoto, ...] = ()
    """Photographs of the same camera before, at and after the time of the scan; needed for a time offset only."""


@dataclass(frozen=True, slots=True)
class PairEvidence:
    """What one pair says of the pose that the other pairs determine."""

    name: str
    """Of the pair."""
    outcome: PairOutcome
    """`agrees`, `disagrees`, or `undecided` where too little could be compared."""
    windows: int
    """Regions that could be compared."""
    agreeing: int
    """Regions that agree."""
    fine_fraction: float
    """Share of the regions that agree at full resolution."""
    false_alarm: float
    """Bound on the probability that so many regions agree by chance."""
    exchange_alarm: float
    """Probability that a photograph of another place correlates as well with this scan; 1 if fewer than three can be
    compared, mirror images included."""
    swapped_fraction: float
    """The largest share of agreeing regions of this scan with a photograph of another pair, at the pose."""
    accepted_alone: bool
    """Whether the pair was accepted when it was registered by itself."""
    sentence: str
    """The outcome in words."""

    @property
    def fraction(self) -> float:
        """Share of the regions that agree."""
        return self.agreeing / max(self.windows, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready."""
        return {
            "name": self.name,
            "outcome": self.outcome,
            "windows": self.windows,
            "agreeing": self.agreeing,
            "fraction": round(self.fraction, 4),
            "fine_fraction": round(self.fine_fraction, 4),
            "false_alarm": float(f"{self.false_alarm:.3g}"),
            "exchange_alarm": float(f"{self.exchange_alarm:.3g}"),
            "swapped_fraction": round(self.swapped_fraction, 4),
            "accepted_alone": self.accepted_alone,
            "sentence": self.sentence,
        }


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """The time by which photographs are stamped later than scans of the same moment."""

    seconds: float
    """Add it to the time of a scan for the time stamp of its photograph, s; 0 if it cannot be told."""
    sigma_s: float
    """Its standard deviation, s; inf if it cannot be told."""
    sentence: str
    """The finding in words."""

    @property
    def known(self) -> bool:
        """Whether it could be told."""
        return bool(np.isfinite(self.sigma_s))

    def as_dict(self) -> dict[str, Any]:
        """Return the finding, JSON-ready."""
        sigma = self.sigma_s if self.known else None
        return {"seconds": self.seconds, "sigma_s": sigma, "known": self.known, "sentence": self.sentence}


class RigSigmas(NamedTuple):
    """The largest standard deviations of a rig's pose."""

    angle_deg: float
    """About an axis of the camera."""
    position_mm: float
    """Along an axis of the scanner."""


@dataclass(frozen=True, slots=True, eq=False)
class RigResult:
    """The one pose of a rig, with its verdict; a refused pose is only the best guess."""

    camera_from_scanner: Rigid | None
    """The pose; None: nothing was found, or the rig has several cameras, see `by_camera`."""
    covariance: FloatArray
    """(6, 6) of (w, c) as `PoseResult.covariance`; NaN without a pose."""
    accepted: bool
    """Whether pairs that were held out verified it; of several cameras, each of them."""
    reasons: tuple[str, ...]
    """The verdict in sentences."""
    pairs: tuple[PairEvidence, ...]
    """The evidence of each pair at the pose of the others, in the order given."""
    false_alarm: float
    """Bound on the probability of the held-out agreement by chance, without the pair that agrees best; of several
    cameras, the highest."""
    cameras: tuple[CameraModel, ...]
    """The camera of each pair."""
    steps: tuple[Step, ...] = ()
    """The steps taken."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The options, JSON-ready."""
    seed: int = 0
    """The random seed."""
    time_offset: TimeOffset | None = None
    """That of the camera's clock, if it was asked for."""
    by_camera: Mapping[str, RigResult] = field(default_factory=dict)
    """The result of each camera by its name, where the rig has several; each has a verdict of its own."""

    @property
    def sigmas(self) -> RigSigmas:
        """The largest standard deviations; NaN without a pose."""
        sigma = np.sqrt(np.diag(self.covariance))
        return RigSigmas(float(np.degrees(sigma[:3].max())), float(1e3 * sigma[3:].max()))

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the pairs that the pose was solved from."""
        return tuple(pair.name for pair in self.pairs if pair.outcome == "agrees")

    @property
    def refused(self) -> tuple[str, ...]:
        """Names of the pairs that disagree with the others."""
        return tuple(pair.name for pair in self.pairs if pair.outcome == "disagrees")
