"""Assessment of a registration beyond its pose: findings, influence, uncertainty and suggested matches.

Each part that cannot be computed is left out with a reason; a poor registration needs the other parts most.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import DegenerateGeometryError, LadarregError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.formatting import format_number
from ladarreg_core.foundations.parallel import side_by_side
from ladarreg_core.quality.findings import Finding, findings
from ladarreg_core.quality.influence import INFLUENTIAL_COOK, Influence, influence
from ladarreg_core.quality.next_match import SuggestedMatch, part_of_photo, suggest_matches
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.spikes import SPIKE_FRACTION, median_range
from ladarreg_core.surface.uncertainty import picture_sigma, pixel_sigma
from ladarreg_core.surface.visibility.visible_points import LARGEST_WHOLE_SCAN, places_in_picture

_SPIKE_MARGIN = 16  # cells around a tile: those that its medians depend on


@dataclass(frozen=True, slots=True, eq=False)
class PictureUncertainty:
    """Uncertainty of the photo position of each scan cell, one standard deviation, from the covariance of the pose."""

    sigma_px: NDArray[np.float32]
    """(H, W) photo pixels; NaN without a return and outside the photo. Without cells, (0, 0)."""
    median_px: float
    """Median over all cells in the photo."""
    p95_px: float
    """95th percentile over the same cells."""
    worst_px: float
    """Largest value over cells that are not range spikes; at a spike it would reflect the range error instead."""
    worst_cell: tuple[int, int]
    """Row and column of the scan cell with the largest value."""
    worst_uv: FloatArray
    """(2,) photo pixel of that cell."""
    worst_where: str
    """Part of the photo that contains it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma_px", read_only(self.sigma_px, np.float32, (None, None), "the uncertainty"))
        object.__setattr__(self, "worst_uv", read_only(self.worst_uv, np.float64, (2,), "the worst pixel"))

    def summary(self) -> str:
        """Return the uncertainty as a sentence."""
        return (
            f"Median uncertainty {format_number(self.median_px)} px, 95 % within {format_number(self.p95_px)} px "
            f"(1 sigma); largest near {self.worst_where} of the photo, {format_number(self.worst_px)} px."
        )


@dataclass(frozen=True, slots=True, eq=False)
class Assessment:
    """Assessment of one registration; a part that could not be computed is None, with its reason in `absent`."""

    findings: tuple[Finding, ...] | None
    """Statements on what limits the quality of the pose."""
    influence: Influence | None
    """Shift of the pose when each match is removed."""
    uncertainty: PictureUncertainty | None
    """Uncertainty of the photo position, cell by cell."""
    advice: tuple[SuggestedMatch, ...] | None
    """Positions where one more match would help most, best first."""
    absent: Mapping[str, str] = field(default_factory=dict)
    """Reason for each part that could not be computed."""

    @property
    def match_to_check(self) -> str:
        """A sentence on the most influential match; empty where no match is influential enough to be checked."""
        if self.influence is None or not len(self.influence.cook):
            return ""
        influential = self.influence.cook[self.influence.most_influential] >= INFLUENTIAL_COOK
        return self.influence.summary() if influential else ""

    def without_cells(self) -> Assessment:
        """Return the same without the uncertainty of every cell, which takes as much memory as a scan's ranges."""
        if self.uncertainty is None:
            return self
        return replace(self, uncertainty=replace(self.uncertainty, sigma_px=np.zeros((0, 0), np.float32)))


def _findings(result: PoseResult) -> tuple[Finding, ...]:
    if len(result.matches) == 0 and result.evidence == "given":
        raise DegenerateGeometryError("the pose was given, so it has no matches to assess it by")
    if len(result.matches) == 0 and not result.is_determined:
        raise DegenerateGeometryError("no pose was found, so there is nothing to assess; add matches")
    if len(result.matches) == 0 and result.accepted:
        raise DegenerateGeometryError(
            "the pose has no matches of its own to assess it by, as it was carried over from another photo"
        )
    return findings(result)


def assess(scan: Scan, result: PoseResult) -> Assessment:
    """Assess a registration, accepted or not.

    Args:
        scan: the scan.
        result: a pose of a photo of it, with its matches.
    """
    parts: dict[str, Callable[[], Any]] = {
        "findings": lambda: _findings(result),
        "influence": lambda: influence(result),
        "uncertainty": lambda: _uncertainty(scan, result),
        "advice": lambda: _advice(scan, result),
    }

    def attempt(work: Callable[[], Any]) -> tuple[Any, str | None]:
        try:
            with np.errstate(all="ignore"):
                return work(), None
        except LadarregError as error:
            return None, str(error)
        except np.linalg.LinAlgError:
            return None, "the matches contradict the pose so strongly that nothing can be computed"

    found = dict(zip(parts, side_by_side(attempt, parts.values()), strict=True))
    absent = {name: reason for name, (_, reason) in found.items() if reason is not None}
    return Assessment(**{name: value for name, (value, _) in found.items()}, absent=absent)


def _uncertainty(scan: Scan, result: PoseResult) -> PictureUncertainty:
    covariance = _require_usable_pose(result)
    if scan.ranges.size > LARGEST_WHOLE_SCAN:
        return _uncertainty_by_tiles(scan, result, covariance)
    camera, pose = result.camera, result.camera_from_scanner
    sigma = picture_sigma(scan, camera, pose, covariance)
    # One product with a (3, N) matrix is ten times as fast as a million products with 3 x 3 ones.
    rotated = pose.rotation.astype(np.float32) @ np.ascontiguousarray(scan.points.reshape(-1, 3).T, dtype=np.float32)
    rotated += pose.translation.astype(np.float32)[:, None]
    uv = camera.project(rotated.T).reshape(*scan.shape, 2)
    known = np.isfinite(sigma) & camera.contains(uv)
    if not known.any():
        raise DegenerateGeometryError("no cell of the scan lies in the photo; check the pose and the camera")
    sigma_in_photo = np.where(known, sigma, np.float32(np.nan))
    median, p95 = (float(v) for v in np.percentile(sigma[known].astype(np.float64), (50, 95)))
    around = median_range(scan.ranges)
    spike = ~(np.abs(scan.ranges - around) <= SPIKE_FRACTION * around)
    without_spikes = np.where(spike, np.float32(np.nan), sigma_in_photo) if (known & ~spike).any() else sigma_in_photo
    row, column = (int(v) for v in np.unravel_index(int(np.nanargmax(without_spikes)), scan.shape))
    worst = uv[row, column]
    return PictureUncertainty(
        sigma_in_photo,
        median,
        p95,
        float(sigma_in_photo[row, column]),
        (row, column),
        worst,
        part_of_photo(worst, camera),
    )


def _uncertainty_by_tiles(
    scan: Scan, result: PoseResult, covariance: FloatArray | CameraUncertainty
) -> PictureUncertainty:
    """Return the uncertainty of a large scan, computed only where it is in the photo."""
    camera, pose = result.camera, result.camera_from_scanner
    sigma = np.full(scan.shape, np.nan, np.float32)
    # of the largest value: whether it is no spike, the value, cell and pixel
    worst: tuple[bool, float, tuple[int, int], FloatArray] | None = None
    for rows, columns in places_in_picture(scan, camera, pose):
        points = scan.points_at(rows, columns)
        points_camera = np.asarray(pose @ points, np.float32)
        uv = camera.project(points_camera)
        known = camera.contains(uv)
        part = np.full(points.shape[:2], np.nan, np.float32)
        part[known] = pixel_sigma(points_camera[known], camera, pose.rotation, covariance)
        sigma[rows, columns] = part
        top, left = (max(0, one.start - _SPIKE_MARGIN) for one in (rows, columns))
        around = median_range(scan.ranges[top : rows.stop + _SPIKE_MARGIN, left : columns.stop + _SPIKE_MARGIN])
        around = around[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        spike = ~(np.abs(scan.ranges[rows, columns] - around) <= SPIKE_FRACTION * around)
        for is_plain, values in ((True, np.where(spike, np.float32(np.nan), part)), (False, part)):
            if np.isnan(values).all():
                continue
            row, column = np.unravel_index(int(np.nanargmax(values)), values.shape)
            found = is_plain, float(values[row, column])
            if worst is None or found > worst[:2]:
                worst = *found, (rows.start + int(row), columns.start + int(column)), uv[row, column]
    if worst is None:
        raise DegenerateGeometryError("no cell of the scan lies in the photo; check the pose and the camera")
    median, p95 = (float(v) for v in np.percentile(sigma[np.isfinite(sigma)].astype(np.float64), (50, 95)))
    sigma.flags.writeable = False  # handed over, not copied
    where = part_of_photo(worst[3], camera)
    return PictureUncertainty(sigma, median, p95, worst[1], worst[2], worst[3], where)


def _advice(scan: Scan, result: PoseResult) -> tuple[SuggestedMatch, ...]:
    _require_usable_pose(result)
    found = suggest_matches(scan, result)
    if not found:
        raise DegenerateGeometryError("no scan surface in the photo is free for another match")
    return found


def _require_usable_pose(result: PoseResult) -> FloatArray | CameraUncertainty:
    """Return the covariance of a pose whose uncertainty means something."""
    covariance = result.joint_covariance
    if covariance is None:
        raise DegenerateGeometryError("the pose was given without its uncertainty")
    if not result.accepted and not result.inliers.any():
        raise DegenerateGeometryError(
            "no match agrees with the pose, so its uncertainty cannot be computed; add matches"
        )
    if not result.is_determined:
        raise DegenerateGeometryError(
            "the matches do not determine the pose, so its uncertainty means nothing; add matches"
        )
    return covariance
