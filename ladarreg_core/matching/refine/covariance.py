"""Covariance of an aligned pose: a jackknife over image regions.

Errors that are common to a region (of the lens, range bias, shadows) must not count as many independent errors.
Therefore whole regions of several blocks are left out, not single blocks.

Source: Efron, The jackknife, the bootstrap and other resampling plans (1982); leaving out groups: Bell and McCaffrey,
Bias reduction in standard errors for linear regression with multi-stage samples (2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.blocks import BlockComparison
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.refine.ecc import CameraAnchor, Picture, RefineOptions
from ladarreg_core.matching.verify.agreement import Agreement

_TRUSTED_PX = 3.0
_SD_OF_MEDIAN = 1.4826
_MIN_SCATTER_PX = 0.02
_PRIOR_ANGLE_RAD, _PRIOR_POSITION_M = np.pi, 100.0
_REGION_BLOCKS = (3, 2, 1)
_MIN_REGIONS = 12
_MIN_INFORMATION = 1e-9
_MAX_SHAPE_SHARE = 0.5
_BETWEEN_REGIONS = 1.7  # variance factor for errors common to several regions; from simulated and half-real sets
_WHOLE_IMAGE = 1.5  # variance factor for errors common to the whole image; from simulated sets of other seeds
_MIN_ANGLE_RAD, _MIN_POSITION_M = 1e-6, 1e-6  # keep the covariance invertible
_OBJECT_BLOCKS = 3
"""Side of the neighbourhoods of blocks that are left out to see whether the pose rests on one of them."""
_MAX_OBJECT_SHARE = 0.25  # of all blocks: more is no part of a picture but most of it
_RESTS_SIGMA = 1.5
"""A pose that moves farther without a neighbourhood, in its own standard deviations, rests on it: in 36 dense and
uneven rooms none does (.9 at most), of 52 photographs of coarse sweeps 8 do (1.5 to 9.2), among them both that were
wrong by 2.8 and 5.7 of their standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowEvidence:
    """Covariance of a pose from its agreeing windows as measurements."""

    agreeing: int
    """Number of windows used."""
    covariance: FloatArray
    """(6, 6) of (w, c) as `PoseResult.covariance`."""
    scatter_px: float
    """Standard deviation of the agreeing windows' displacements, photo pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class RegionEvidence:
    """Jackknife covariance of a finished pose and of the estimated intrinsics."""

    covariance: FloatArray
    """(6 + K, 6 + K) of (w, c) as `PoseResult.covariance`, and of (log f, k1, centre x, centre y): the scatter that the
    regions show."""
    regions: int
    """Number of regions left out in turn."""
    by_prior: FloatArray | None = None
    """(6 + K, 6 + K) likewise: what the error of the camera as known before contributes; None: nothing."""
    by_object: FloatArray | None = None
    """(6 + K, 6 + K) likewise: how far the pose moves without the object on which it rests most, where that is far;
    None: it rests on none. A near object with a repeated pattern can fit elsewhere, too, and nothing contradicts it."""
    unit_variance: float = 1.0
    """Mean variance of a parameter of unit information; of `CameraAnchor`."""

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) of (w, c) of `joint_covariance`."""
        return self.joint_covariance()[:6, :6]

    def joint_covariance(self, variance_factor: float = 1.0) -> FloatArray:
        """Return (6 + K, 6 + K) of (w, c) and the intrinsics, enlarged for errors common to the whole image.

        The jackknife cannot see these.

        Args:
            variance_factor: of the scatter, beyond that for the whole image.
        """
        covariance = _WHOLE_IMAGE * variance_factor * self.covariance
        return sum((part for part in (self.by_prior, self.by_object) if part is not None), start=covariance)

    def anchor(self, mean: FloatArray, sigma: FloatArray, *, variance_factor: float = 1.0) -> CameraAnchor:
        """Return what is known of a camera (K,), in the unit of this pair's blocks."""
        return CameraAnchor(mean, sigma, _WHOLE_IMAGE * variance_factor * self.unit_variance)

    def inflated_by(self, moved: FloatArray) -> RegionEvidence:
        """Return the evidence enlarged by (w, c), (6,): the shift to another pose that explains the image no better.

        The shift is added as an error of its own. In addition, the covariance is scaled by its squared length in
        standard deviations, since the direction of the unknown error is not known.
        """
        covariance = self.covariance[:6, :6]
        squared = float(moved @ np.linalg.solve(covariance, moved)) / len(moved)
        by_object = None if self.by_object is None else self.by_object[:6, :6]
        inflated = (1 + squared) * covariance + np.outer(moved, moved)
        return RegionEvidence(inflated, self.regions, by_object=by_object)

    def normal_deviate(
        self, moved: FloatArray, *, variance_factor: float = 1.0, known_to: FloatArray | None = None
    ) -> float:
        """Return the significance of a change (K,) of the first intrinsics, as a normal deviate.

        Args:
            moved: the change.
            variance_factor: of the covariance.
            known_to: (K,) standard deviations of the values that were stated; None: they are exact.

        Source: Hotelling, The generalization of Student's ratio (1931); the deviate of F is Paulson's (1942).
        """
        count = len(moved)
        dof = self.regions - count
        covariance = variance_factor * self.covariance[6 : 6 + count, 6 : 6 + count]
        if known_to is not None:
            covariance = covariance + np.diag(known_to**2)
        squared = float(moved @ np.linalg.lstsq(covariance, moved, rcond=None)[0])
        F = max(squared, 0.0) * dof / (count * (self.regions - 1))
        a, b, root = 2 / (9 * count), 2 / (9 * dof), np.cbrt(F)
        return float(((1 - b) * root - (1 - a)) / np.sqrt(b * root * root + a))


def region_evidence(
    compared: Sequence[tuple[Picture, BlockComparison]], pose: Rigid, options: RefineOptions
) -> RegionEvidence | None:
    """Return the jackknife covariance of a finished pose, or None if too few regions are visible.

    Args:
        compared: the pictures with their blocks at the pose.
        pose: `camera_from_scanner`.
        options: those of the refinement that ended there, with the number of free intrinsics.
    """
    parts = []
    for number, (picture, seen) in enumerate(compared):
        blocks = picture.points.blocks
        grid = blocks.grid[blocks.of_point[seen.index[seen.blocks.starts]]]
        parts.append((*picture.block_systems(seen, options), np.full(len(grid), number, np.intp), grid))
    if not parts:
        return None
    H, g, picture_of_block, grid = (np.concatenate(values) for values in zip(*parts, strict=True))
    return _jackknife(H, g, picture_of_block, grid, pose, options.anchor)


def _jackknife(
    H_blocks: FloatArray,
    g_blocks: FloatArray,
    picture: IntArray,
    grid: IntArray,
    pose: Rigid,
    anchor: CameraAnchor | None,
) -> RegionEvidence | None:
    """Return the jackknife covariance of a pose from the contributions of its blocks; None if they form few regions.

    Args:
        H_blocks: (b, 6 + K, 6 + K) of `Picture.block_systems`.
        g_blocks: (b, 6 + K) likewise.
        picture: (b,) picture of each block: regions never extend over two pictures.
        grid: (b, 2) row and column of each block in its picture.
        pose: `camera_from_scanner`.
        anchor: what was known of the intrinsics before; its own error is `RegionEvidence.by_prior`.
    """
    for side in _REGION_BLOCKS:
        _, region = np.unique(np.column_stack([picture, grid // side]), axis=0, return_inverse=True)
        count = int(region.max()) + 1
        if count >= _MIN_REGIONS:
            break
    else:
        return None
    H_regions, g_regions = np.zeros((count, *H_blocks.shape[1:])), np.zeros((count, g_blocks.shape[1]))
    np.add.at(H_regions, region.ravel(), H_blocks)
    np.add.at(g_regions, region.ravel(), g_blocks)
    H, g = H_regions.sum(axis=0), g_regions.sum(axis=0)
    if anchor is not None:
        H[range(6, len(H)), range(6, len(H))] += anchor.information
        g[6:] += anchor.information * anchor.mean
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    known = H / np.outer(scale, scale) + _MIN_INFORMATION * np.eye(len(H))
    without = known - H_regions / np.outer(scale, scale)
    steps = np.linalg.solve(without, ((g - g_regions) / scale)[..., None])[..., 0]
    moved = steps - steps.mean(axis=0)
    covariance = _BETWEEN_REGIONS * (count - 1) / count * moved.T @ moved
    # Few regions do not determine all directions; part of the result has the shape of the inverse information.
    shape = np.linalg.inv(known)
    share = min(_MAX_SHAPE_SHARE, len(H) / count)
    unit_variance = float(np.trace(covariance @ known)) / len(H)
    covariance = (1 - share) * covariance + share * unit_variance * shape
    to_centre = np.diag(1 / scale)
    to_centre[3:6] = -pose.rotation.T @ to_centre[3:6]  # from the translation t to the camera centre c
    covariance = to_centre @ covariance @ to_centre.T
    covariance[range(6), range(6)] += [_MIN_ANGLE_RAD**2] * 3 + [_MIN_POSITION_M**2] * 3
    by_prior = None
    if anchor is not None:
        gain = to_centre @ shape[:, 6:] / scale[6:] * np.sqrt(anchor.information * anchor.unit_variance)
        by_prior = gain @ gain.T
    covariance = (covariance + covariance.T) / 2
    H_scaled, g_scaled = H_blocks / np.outer(scale, scale), g_blocks / scale
    moved = _steps_without_neighbours(H_scaled, g_scaled, picture, grid, known, g / scale)
    by_object = _of_strongest(moved @ to_centre.T, covariance)
    return RegionEvidence(covariance, count, by_prior, by_object, unit_variance)


def _steps_without_neighbours(
    H_blocks: FloatArray, g_blocks: FloatArray, picture: IntArray, grid: IntArray, H: FloatArray, g: FloatArray
) -> FloatArray:
    """Return (n, 6 + K) how the solution changes without each neighbourhood of blocks.

    An object of several regions hides from a jackknife over single ones: each of its regions is held by the others.
    """
    found: list[FloatArray] = [np.zeros((0, len(g)))]
    for number in np.unique(picture):
        of_picture = np.flatnonzero(picture == number)
        at = grid[of_picture] - grid[of_picture].min(axis=0) + _OBJECT_BLOCKS
        rows, columns = at.max(axis=0) + _OBJECT_BLOCKS
        H_cells, g_cells = np.zeros((rows, columns, *H_blocks.shape[1:])), np.zeros((rows, columns, len(g)))
        blocks = np.zeros((rows, columns))
        index = tuple(at.T)
        H_cells[index], g_cells[index], blocks[index] = H_blocks[of_picture], g_blocks[of_picture], 1
        H_cells, g_cells, blocks = map(_sums_of_neighbours, (H_cells, g_cells, blocks))
        tried = (blocks > 0) & (blocks <= _MAX_OBJECT_SHARE * len(picture))
        steps: FloatArray = np.linalg.solve(H - H_cells[tried], (g - g_cells[tried])[..., None])[..., 0]
        found.append(steps)
    return np.concatenate(found) - np.linalg.solve(H, g)


def _sums_of_neighbours(values: FloatArray) -> FloatArray:
    """Return the sums over squares of `_OBJECT_BLOCKS`, (rows, columns, ...), along the first two axes."""
    for axis in (0, 1):
        total = np.cumsum(values, axis=axis)
        start = np.roll(total, _OBJECT_BLOCKS, axis=axis)
        start[(slice(None),) * axis + (slice(_OBJECT_BLOCKS),)] = 0
        values = total - start
    return values


def _of_strongest(moved: FloatArray, covariance: FloatArray) -> FloatArray | None:
    """Return the longest of the shifts (n, 6 + K) as a covariance; None if none of the poses moves beyond accident."""
    if not len(moved):
        return None
    pose = moved[:, :6]
    squared = np.einsum("np,np->n", pose, np.linalg.solve(_WHOLE_IMAGE * covariance[:6, :6], pose.T).T) / 6
    strongest = int(np.argmax(squared))
    return np.outer(moved[strongest], moved[strongest]) if squared[strongest] > _RESTS_SIGMA**2 else None


def window_evidence(
    maps: Agreement, points: ViewPoints, working: Camera, camera: Camera, pose: Rigid
) -> WindowEvidence:
    """Return the covariance that the pooled maps at a finished pose imply.

    Each agreeing window is one 2-D measurement at its central block. Windows pool 3 x 3 blocks and overlap, so the
    information of each is divided by the number of blocks it pools.

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
    # From the median: the pose is a robust estimate, insensitive to windows that hardly agree.
    scatter = float(_SD_OF_MEDIAN * to_photo * np.median(np.abs(shift[used]))) + _MIN_SCATTER_PX
    pooled = maps.pooled_blocks[used].astype(np.float64)
    information = np.einsum("n,nip,niq->pq", 1 / pooled, J, J) / scatter**2
    covariance = np.linalg.inv(information + np.linalg.inv(prior))
    return WindowEvidence(len(used), (covariance + covariance.T) / 2, scatter)


def _middle(points: ViewPoints, members: IntArray) -> int:
    """Return the index of the visible point nearest to the centroid of its block."""
    uv = points.uv[members]
    return int(members[np.argmin(((uv - uv.mean(axis=0)) ** 2).sum(axis=-1))])
