"""How uncertain an aligned pose is: by how it moves without each region of the picture.

What errs alike over a region (a lens, a bias of range, a shadow) must not count as many independent errors: so whole
regions of several blocks are left out, not single blocks.

Source: Efron, The jackknife, the bootstrap and other resampling plans (1982); leaving out groups: Bell and McCaffrey,
Bias reduction in standard errors for linear regression with multi-stage samples (2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.arrays import FloatArray, IntArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.agreement import Agreement
from ladarreg_core.matching.blocks import BlockComparison
from ladarreg_core.matching.ecc import RefineOptions, block_systems
from ladarreg_core.matching.sampling import ViewPoints
from ladarreg_core.pose.jacobian import pose_jacobian

_TRUSTED_PX = 3.0
_SD_OF_MEDIAN = 1.4826
_MIN_SCATTER_PX = 0.02
_PRIOR_ANGLE_RAD, _PRIOR_POSITION_M = np.pi, 100.0
_REGION_BLOCKS = (3, 2, 1)
_MIN_REGIONS = 12
_MIN_INFORMATION = 1e-9
_MAX_SHAPE_SHARE = 0.5
_BETWEEN_REGIONS = (
    1.7  # what errs alike over several regions is seen by none of them; on simulated and half-real sets, variance
)
_WHOLE_IMAGE = 1.5  # and what errs alike over the whole picture; on simulated sets of other seeds
_MIN_ANGLE_RAD, _MIN_POSITION_M = 1e-6, 1e-6  # so that it can be inverted


@dataclass(frozen=True, slots=True, eq=False)
class WindowEvidence:
    """The windows as measurements."""

    agreeing: int
    """Windows that count."""
    covariance: FloatArray
    """(6, 6) of (w, c) as `PoseResult.covariance`."""
    scatter_px: float
    """Standard deviation of the agreeing windows' displacements, photo pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class RegionEvidence:
    """What the regions of the picture say of a finished pose and of its camera."""

    covariance: FloatArray
    """(6 + K, 6 + K) of (w, c) as `PoseResult.covariance`, and of (log f, k1)."""
    regions: int
    """How many regions were left out in turn."""

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) of (w, c), with what errs alike over the whole picture: such errors move no camera against another."""
        return _WHOLE_IMAGE * self.covariance[:6, :6]

    def inflated_by(self, moved: FloatArray) -> RegionEvidence:
        """Return the evidence for a pose that another, no better explanation of the picture moves by (w, c), (6,).

        The move counts as an error of its own. As many standard deviations as it is long, as far may the pose be off in
        any direction: what is wrong is not known, or it would have been estimated.
        """
        covariance = self.covariance[:6, :6]
        squared = float(moved @ np.linalg.solve(covariance, moved)) / len(moved)
        return RegionEvidence((1 + squared) * covariance + np.outer(moved, moved), self.regions)

    def normal_deviate(self, moved: FloatArray) -> float:
        """Return how surely (log f, k1), (K,), moved: not by chance, as a normal deviate.

        Source: Hotelling, The generalization of Student's ratio (1931); the deviate of F is Paulson's (1942).
        """
        count = len(moved)
        dof = self.regions - count
        covariance = self.covariance[6 : 6 + count, 6 : 6 + count]
        squared = float(moved @ np.linalg.lstsq(covariance, moved, rcond=None)[0])
        F = max(squared, 0.0) * dof / (count * (self.regions - 1))
        a, b, root = 2 / (9 * count), 2 / (9 * dof), np.cbrt(F)
        return float(((1 - b) * root - (1 - a)) / np.sqrt(b * root * root + a))


def region_evidence(
    seen: BlockComparison, points: ViewPoints, camera: Camera, pose: Rigid, options: RefineOptions
) -> RegionEvidence | None:
    """Return how a finished pose moves without each region, or None where too few regions are seen.

    Args:
        seen: the blocks at the pose.
        points: the points compared.
        camera: the ideal camera that they were compared in.
        pose: `camera_from_scanner`.
        options: of the climb that ended there, with what of the camera is asked about.
    """
    grid = points.blocks.grid[points.blocks.of_point[seen.index[seen.blocks.starts]]]
    for side in _REGION_BLOCKS:
        _, region = np.unique(grid // side, axis=0, return_inverse=True)
        count = int(region.max()) + 1
        if count >= _MIN_REGIONS:
            break
    else:
        return None
    H_blocks, g_blocks = block_systems(seen, camera, options)
    H_regions, g_regions = np.zeros((count, *H_blocks.shape[1:])), np.zeros((count, g_blocks.shape[1]))
    np.add.at(H_regions, region.ravel(), H_blocks)
    np.add.at(g_regions, region.ravel(), g_blocks)
    H, g = H_regions.sum(axis=0), g_regions.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    known = H / np.outer(scale, scale) + _MIN_INFORMATION * np.eye(len(H))
    without = known - H_regions / np.outer(scale, scale)
    steps = np.linalg.solve(without, ((g - g_regions) / scale)[..., None])[..., 0]
    moved = steps - steps.mean(axis=0)
    covariance = _BETWEEN_REGIONS * (count - 1) / count * moved.T @ moved
    # Few regions cannot tell all directions; part of the answer is the shape that the information alone has.
    shape = np.linalg.inv(known)
    share = min(_MAX_SHAPE_SHARE, len(H) / count)
    covariance = (1 - share) * covariance + share * np.trace(covariance @ known) / len(H) * shape
    to_centre = np.diag(1 / scale)
    to_centre[3:6] = -pose.rotation.T @ to_centre[3:6]  # from a shift of the camera's frame to one of its centre
    covariance = to_centre @ covariance @ to_centre.T
    covariance[range(6), range(6)] += [_MIN_ANGLE_RAD**2] * 3 + [_MIN_POSITION_M**2] * 3
    return RegionEvidence((covariance + covariance.T) / 2, count)


def window_evidence(
    maps: Agreement, points: ViewPoints, working: Camera, camera: Camera, pose: Rigid
) -> WindowEvidence:
    """Turn the pooled maps at an accepted pose into measurements.

    Each agreeing window is one 2-D measurement, taken at its middle block. Windows pool 3 x 3 blocks, so neighbours
    repeat each other: the information is divided by how many blocks a window pools.

    Args:
        maps: agreement at the finished pose.
        points: the scan points of that level.
        working: the ideal camera of that level.
        camera: the photo's own camera.
        pose: `camera_from_scanner`.
    """
    shift, _, border = maps.peaks()
    index = np.array([_middle(points, members) for members in maps.members], dtype=np.intp)
    at = points.points[index].astype(np.float64).reshape(-1, 3)
    uv = camera.project(working.unproject(working.project(pose @ at) + shift.reshape(-1, 2)))
    to_photo = camera.focal_px / working.focal_px
    offset = np.hypot(*shift.T) * to_photo if len(shift) else np.zeros(0)
    inliers = (offset <= _TRUSTED_PX * max(1.0, to_photo)) & ~border & np.isfinite(uv).all(axis=-1)

    used = np.flatnonzero(inliers)
    prior = np.diag([_PRIOR_ANGLE_RAD**2] * 3 + [_PRIOR_POSITION_M**2] * 3)
    if len(used) < 4:
        return WindowEvidence(len(used), prior, float("nan"))
    _, J = pose_jacobian(pose, at[used], camera)
    # From the median: the pose is a robust estimate, which windows that hardly agree do not move.
    scatter = float(_SD_OF_MEDIAN * to_photo * np.median(np.abs(shift[used]))) + _MIN_SCATTER_PX
    pooled = maps.pooled_blocks[used].astype(np.float64)
    information = np.einsum("n,nip,niq->pq", 1 / pooled, J, J) / scatter**2
    covariance = np.linalg.inv(information + np.linalg.inv(prior))
    return WindowEvidence(len(used), (covariance + covariance.T) / 2, scatter)


def _middle(points: ViewPoints, members: IntArray) -> int:
    """Return the visible point nearest to the middle of its block."""
    uv = points.uv[members]
    return int(members[np.argmin(((uv - uv.mean(axis=0)) ** 2).sum(axis=-1))])
