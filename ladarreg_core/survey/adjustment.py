"""The result of a survey: poses, cameras and verdicts with their covariances, and `adjustment.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import OptionError
from ladarreg_core.export.json import software_document
from ladarreg_core.frames import Rigid
from ladarreg_core.results.registration import COARSE_SIGMA_PX
from ladarreg_core.survey.least_squares.problem import Matrix
from ladarreg_core.survey.least_squares.solver import Adjusted

SurveyEvidence = Literal["image", "ties", "rig", "none"]
VERSION = 1
_HOW = {"image": "verified against the image", "ties": "verified by ties", "rig": "held by its rig"}
COVARIANCE_IS = (
    "of (w, c): R_true = exp([w]x) R (rad), c = true minus estimated camera centre in the world (m); the "
    "uncertainty of the camera is in it"
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedScan:
    """Where a scanner stood."""

    world_from_scanner: Rigid | None
    """None: nothing connects it to the others."""
    covariance: Matrix
    """(6, 6) of (w, c): R_true = exp([w]x) R of `world_from_scanner`, c in the world, m; zeros of a fixed one."""
    fixed: bool
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Whether it has a place in the world."""
        return self.world_from_scanner is not None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedCamera:
    """A camera as its photographs determine it together."""

    camera: CameraModel
    """Of upright pixels of its first photograph."""
    names: tuple[str, ...]
    """The intrinsics that were estimated."""
    covariance: Matrix
    """Of these, in the same order; px, 1, px, px."""
    photos: tuple[str, ...]
    """Ids of the accepted photographs that it took."""

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedSensor:
    """A sensor of a rig relative to the rig's first one."""

    reference_from_sensor: Rigid
    covariance: Matrix
    """(6, 6) of (w, c): w about the axes of the first sensor, c in the frame of this one."""
    frames: tuple[str, ...]
    """Frames that it was measured in; empty: it was stated."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedPhoto:
    """Where a photograph was taken, and how that is known."""

    camera_from_world: Rigid | None
    """None: it is not accepted."""
    covariance: Matrix
    """(6, 6), see `COVARIANCE_IS`; NaN if it is not accepted."""
    camera: CameraModel
    """The camera of its pixels."""
    camera_id: str
    """Id of the camera that took it."""
    evidence: SurveyEvidence
    """`image`: a scan's image verifies it; `ties`: it rests on what other photographs show of the surface, and their
    colours verify it; `rig`: a verified photograph of the same frame holds it."""
    reasons: tuple[str, ...]
    scans: tuple[str, ...] = ()
    """Ids of the scans whose images verify it."""
    ties: int = 0
    """Ties that agree with the adjustment."""
    ties_left_out: int = 0
    """Ties that do not."""
    partners: tuple[str, ...] = ()
    """Ids of the accepted photographs that it is tied to."""
    median_px: float = float("nan")
    """Median residual of its ties, px."""
    tie_marks: Matrix = field(default_factory=lambda: np.zeros((0, 5)))
    """(N, 5) where it shows ties: u, v, observed minus predicted (2), px, and 1 for one that agrees; evenly chosen of
    all, and no part of `adjustment.json`."""
    sigma_px: float = float("nan")
    """How far what it shows may lie from where the laser's points are drawn: standard deviation, median, px."""
    moved_others_sigmas: float | None = None
    """By how much it would have moved another photograph, if it had not been taken out: the largest, in standard
    deviations; None: it was not taken out."""

    @property
    def accepted(self) -> bool:
        """Whether its pose may be used."""
        return self.camera_from_world is not None

    @property
    def sigma_position_m(self) -> float:
        """Standard deviation of the position, over all three axes, m."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def sigma_angle_rad(self) -> float:
        """Standard deviation of the orientation, over all three axes, rad."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def is_coarse(self) -> bool:
        """Whether it is accepted, and known to more than `COARSE_SIGMA_PX` only."""
        return self.accepted and self.sigma_px > COARSE_SIGMA_PX * np.sqrt(self.camera.width * self.camera.height / 1e6)

    @property
    def verdict(self) -> str:
        """The verdict as a sentence."""
        if not self.accepted:
            return "Not accepted: taken out." if self.moved_others_sigmas is not None else "Not accepted."
        words = "Accepted, coarse" if self.is_coarse else "Accepted"
        return f"{words}: {_HOW[self.evidence]}."


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedTie:
    """A tie that was drawn by hand, and whether it agrees with all else."""

    id: str
    photos: tuple[str, str]
    """Ids of its photographs."""
    agrees: bool
    """Whether it was kept."""
    residual_px: float
    """The larger of its two residuals, px; NaN: it was no part of the adjustment."""
    reason: str
    """A sentence."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedLine:
    """A line that was drawn by hand, and whether it agrees with all else."""

    id: str
    photos: tuple[str, ...]
    """Ids of its photographs."""
    agrees: bool
    """Whether all of it was kept that is in accepted photographs."""
    residuals_px: tuple[float, ...]
    """How far its ends lie from the image of the line in each photograph, the larger of both, px; NaN: it was no part
    of the adjustment there."""
    scan_residual_m: float = float("nan")
    """How far its places in its scan lie from the line, the larger of both, m; NaN: likewise, or no scan shows it."""
    reason: str
    """A sentence."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Adjustment:
    """The result of `adjust`."""

    scans: Mapping[str, AdjustedScan]
    cameras: Mapping[str, AdjustedCamera]
    photos: Mapping[str, AdjustedPhoto]
    chi2_per_dof: float
    """Of everything that was kept: near 1 if what is stated to be known is known so well."""
    sigma_px: float
    """Noise of the ties, px."""
    joint: Matrix
    """(6 n, 6 n) covariance of the n scans and photographs in `joint_ids`."""
    joint_ids: tuple[tuple[str, str], ...]
    """Kind (`scan` or `photo`) and id of each six rows."""
    residuals: tuple[TieResidual, ...] = ()
    """The ties that disagree most."""
    rigs: Mapping[str, Mapping[str, AdjustedSensor]] = field(default_factory=dict)
    """By their ids and the names of their sensors."""
    ties: tuple[AdjustedTie, ...] = ()
    """Those that were drawn by hand."""
    lines: tuple[AdjustedLine, ...] = ()
    """Likewise."""
    folder: Path | None = None
    """Where the results were written; None: nowhere."""
    options: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Any] = field(default_factory=dict)
    """Name, size and SHA-256 of the files, by kind and id."""

    @property
    def accepted(self) -> bool:
        """Whether all photographs and scans are."""
        return all(one.accepted for one in self.photos.values()) and all(one.accepted for one in self.scans.values())

    def covariance_between(self, first: str, second: str) -> Matrix:
        """Return the covariance (12, 12) of the (w, c) of two photographs together, by their ids.

        Raises:
            OptionError: if one is not accepted.
        """
        rows = []
        for name in (first, second):
            if ("photo", name) not in self.joint_ids:
                raise OptionError(f"the photo {name!r:.60} is not among the accepted ones")
            at = 6 * self.joint_ids.index(("photo", name))
            rows += list(range(at, at + 6))
        return self.joint[np.ix_(rows, rows)]

    def document(self) -> dict[str, Any]:
        """Return the contents of `adjustment.json`, without its checksum; it has neither times nor folders."""
        return {
            "version": VERSION,
            "kind": "adjustment",
            "software": software_document(),
            "covariance_is": COVARIANCE_IS,
            "scans": {name: self._scan_fields(name, one) for name, one in self.scans.items()},
            "cameras": {name: _camera_fields(one) for name, one in self.cameras.items()},
            "photos": {name: self._photo_fields(name, one) for name, one in self.photos.items()},
            "rigs": {
                rig: {
                    name: {
                        "reference_from_sensor": one.reference_from_sensor.matrix.tolist(),
                        "covariance": one.covariance.tolist(),
                        "frames": list(one.frames),
                    }
                    for name, one in sensors.items()
                }
                for rig, sensors in self.rigs.items()
            },
            "ties": [
                {
                    "id": one.id,
                    "photos": list(one.photos),
                    "agrees": one.agrees,
                    "residual_px": _number(one.residual_px),
                    "reason": one.reason,
                }
                for one in self.ties
            ],
            **({"lines": [_line_fields(one) for one in self.lines]} if self.lines else {}),
            "chi2_per_dof": _number(self.chi2_per_dof),
            "sigma_px": _number(self.sigma_px),
            "options": dict(self.options),
        }

    def _scan_fields(self, name: str, one: AdjustedScan) -> dict[str, Any]:
        targets = self.inputs.get(f"targets/{name}")
        return {
            "world_from_scanner": None if one.world_from_scanner is None else one.world_from_scanner.matrix.tolist(),
            "covariance": one.covariance.tolist() if one.accepted else None,
            "fixed": one.fixed,
            "accepted": one.accepted,
            "reasons": list(one.reasons),
            "input": self.inputs.get(f"scan/{name}"),
            **({} if targets is None else {"targets": targets}),
        }

    def _photo_fields(self, name: str, one: AdjustedPhoto) -> dict[str, Any]:
        pose = one.camera_from_world
        return {
            "camera_from_world": None if pose is None else pose.matrix.tolist(),
            "covariance": None if pose is None else one.covariance.tolist(),
            "accepted": one.accepted,
            "evidence": one.evidence,
            "precision": "coarse" if one.is_coarse else None,
            "verdict": one.verdict,
            "reasons": list(one.reasons),
            "sigma": None
            if pose is None
            else {
                "angle_rad": one.sigma_angle_rad, "position_m": one.sigma_position_m, "pixel_px": _number(one.sigma_px),
            },
            "scans": list(one.scans),
            "ties": {
                "agree": one.ties, "left_out": one.ties_left_out, "median_px": _number(one.median_px),
                "photos": list(one.partners),
            },
            "moved_others_sigmas": one.moved_others_sigmas,
            "camera": one.camera_id,
            "folder": f"photos/{name}" if one.accepted else None,
            "input": self.inputs.get(f"photo/{name}"),
        }  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TieResidual:
    """A tie that disagrees with the adjustment."""

    photos: tuple[str, ...]
    """Ids of the photographs that show it."""
    uv: Matrix
    """(n, 2) where, px."""
    residual_px: Matrix
    """(n, 2) observed minus predicted."""


def scan_covariance(adjusted: Adjusted, body: int) -> Matrix:
    """Return the covariance (6, 6) of `world_from_scanner`, see `AdjustedScan`, of a scanner's body.

    The body's pose is the inverse: R^T true = R^T exp(-[w]x) = exp(-[R^T w]x) R^T.
    """
    turn = np.eye(6)
    turn[:3, :3] = -adjusted.problem.poses[body].rotation.T
    return np.asarray(turn @ adjusted.covariance_of(body) @ turn.T)


def _camera_fields(one: AdjustedCamera) -> dict[str, Any]:
    return {
        "is": f"{one.camera.width} x {one.camera.height} px",
        "pooled": list(one.photos),
        "camera": one.camera.as_fields(),
        "estimated": list(one.names),
        "sigmas": one.sigmas,
        "covariance": one.covariance.tolist(),
        "photos": list(one.photos),
    }


def _line_fields(one: AdjustedLine) -> dict[str, Any]:
    return {
        "id": one.id, "photos": list(one.photos), "agrees": one.agrees,
        "residuals_px": [_number(value) for value in one.residuals_px],
        "scan_residual_m": _number(one.scan_residual_m), "reason": one.reason,
    }  # fmt: skip


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
