"""What there is to say of a registration beside its pose: findings, influence, uncertainty, and where to go on.

Whatever cannot be told of a registration is absent with its reason: a poor one needs the rest most.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray, read_only
from ladarreg_core.errors import DegenerateGeometryError, LadarregError
from ladarreg_core.quality.findings import Finding, findings
from ladarreg_core.quality.influence import WORTH_A_CHECK, Influence, influence
from ladarreg_core.quality.next_match import Place, advise, part_of_photo
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.spikes import SPIKE_FRACTION, median_range
from ladarreg_core.surface.uncertainty import picture_sigma

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class PictureUncertainty:
    """How far the registered picture may be off, one standard deviation of the pose."""

    sigma_px: NDArray[np.float32]
    """(H, W) photo pixels; NaN without a return and out of the photo."""
    median_px: float
    """Of all cells in the photo."""
    p95_px: float
    """What 95 % of them do not exceed."""
    worst_px: float
    """The largest where the range is no spike, which would show what its own error does."""
    worst_cell: tuple[int, int]
    """Row and column of the scan where it is."""
    worst_uv: FloatArray
    """(2,) its photo pixel."""
    worst_where: str
    """Which part of the photo that is."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma_px", read_only(self.sigma_px, np.float32, (None, None), "the uncertainty"))
        object.__setattr__(self, "worst_uv", read_only(self.worst_uv, np.float64, (2,), "the worst pixel"))

    def in_words(self) -> str:
        """Return a sentence."""
        return (
            f"Half of the picture is known to {_px(self.median_px)} px and 95 % of it to {_px(self.p95_px)} px (1 "
            f"sigma); it is worst near {self.worst_where} of the photo, {_px(self.worst_px)} px."
        )


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """What there is to say of one registration; a part that has no answer is None, and `absent` says why."""

    findings: tuple[Finding, ...] | None
    """What makes the pose good or not."""
    influence: Influence | None
    """How far the pose moves without each match."""
    uncertainty: PictureUncertainty | None
    """How far the picture may be off, cell by cell."""
    advice: tuple[Place, ...] | None
    """Where the next match would help most, best first."""
    absent: Mapping[str, str] = field(default_factory=dict)
    """The parts without an answer, with the reason."""

    @property
    def match_to_check(self) -> str:
        """A sentence on the match that moves the pose most; empty where none is worth a check."""
        if self.influence is None or not len(self.influence.cook):
            return ""
        worth = self.influence.cook[self.influence.most] >= WORTH_A_CHECK
        return self.influence.in_words() if worth else ""


def _findings(result: PoseResult) -> tuple[Finding, ...]:
    if len(result.matches) == 0 and result.accepted:
        raise DegenerateGeometryError(
            "the pose has no matches of its own to be judged by, as one that was carried over has none"
        )
    return findings(result)


def assess(scan: Scan, result: PoseResult) -> Assessment:
    """Return what there is to say of a registration, accepted or not.

    Args:
        scan: the scan.
        result: a pose of a photo of it, with its matches.
    """
    absent: dict[str, str] = {}

    def part(name: str, work: Callable[[], T]) -> T | None:
        try:
            with np.errstate(all="ignore"):
                return work()
        except LadarregError as error:
            absent[name] = str(error)
        except np.linalg.LinAlgError:
            absent[name] = "the matches and the pose contradict each other so far that nothing can be computed"
        return None

    return Assessment(
        part("findings", lambda: _findings(result)),
        part("influence", lambda: influence(result)),
        part("uncertainty", lambda: _uncertainty(scan, result)),
        part("advice", lambda: _advice(scan, result)),
        absent,
    )


def _uncertainty(scan: Scan, result: PoseResult) -> PictureUncertainty:
    _check_pose(result)
    camera, pose = result.camera, result.camera_from_scanner
    sigma = picture_sigma(scan, camera, pose, result.covariance)
    known = np.isfinite(sigma)
    uv = np.full((*scan.shape, 2), np.nan, dtype=np.float32)
    # Rows of a (3, N) matrix: a million products with a 3 x 3 one take ten times as long.
    turned = pose.rotation.astype(np.float32) @ np.ascontiguousarray(scan.points[known].T, dtype=np.float32)
    uv[known] = camera.project((turned + pose.translation.astype(np.float32)[:, None]).T)
    known &= camera.contains(uv)
    if not known.any():
        raise DegenerateGeometryError("no cell of the scan lies in the photo; check the pose and the camera")
    within = np.where(known, sigma, np.float32(np.nan))
    median, p95 = (float(v) for v in np.percentile(sigma[known].astype(np.float64), (50, 95)))
    around = median_range(scan.ranges)
    spike = ~(np.abs(scan.ranges - around) <= SPIKE_FRACTION * around)
    judged = np.where(spike, np.float32(np.nan), within) if (known & ~spike).any() else within
    row, column = (int(v) for v in np.unravel_index(int(np.nanargmax(judged)), scan.shape))
    worst = uv[row, column]
    return PictureUncertainty(
        within, median, p95, float(within[row, column]), (row, column), worst, part_of_photo(worst, camera)
    )


def _advice(scan: Scan, result: PoseResult) -> tuple[Place, ...]:
    _check_pose(result)
    found = advise(scan, result)
    if not found:
        raise DegenerateGeometryError("the photo sees no surface of the scan where a match is missing")
    return found


def _check_pose(result: PoseResult) -> None:
    if not result.accepted and not result.inliers.any():
        raise DegenerateGeometryError("no match agrees with the pose, so it says nothing of the picture; add matches")


def _px(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
