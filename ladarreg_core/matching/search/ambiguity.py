"""Search for a second pose that explains the image as well: the mirrored pose of a flat scene, or a repetition.

Source: Schweighofer and Pinz, Robust pose estimation from a planar target (2006), for the two-fold ambiguity.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.matching.images.blocks import project_visible
from ladarreg_core.matching.images.photo_levels import LEVELS
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.ecc import RefineOptions, refine_pose
from ladarreg_core.matching.verify.verification import GateOptions, Verification, unsure_gate
from ladarreg_core.pose.ambiguity import mirrored
from ladarreg_core.scan import Scan

_COARSEST = LEVELS[-1]
_REFINEMENT = RefineOptions(tau_px=8, iterations=8)
_MIN_SHIFT_PX = 3.0  # level pixels; smaller shifts lie in the same basin
_MAX_PEAKS = 2
_MAX_REFINED, _MAX_REFINED_UNSURE = 2, 4
_MIN_POINTS = 30
_SAMPLES = 10_000
_SAME_START_PX = 40.0  # radius of the basin of refinement


class KnownPoses:
    """Poses at which a photo was verified, and their distances in the image.

    Args:
        scan: the scan.
        camera: the photo's camera.
        gate: thresholds of verification; None: the default ones.
    """

    def __init__(self, scan: Scan, camera: CameraModel, gate: GateOptions | None = None) -> None:
        stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLES)))
        points = scan.thinned_points(stride).reshape(-1, 3).astype(np.float64)
        self._points = points[np.isfinite(points).all(axis=-1)]
        self._camera = camera
        self._same_px = (gate or GateOptions()).same_pose_px
        self._poses: list[Rigid] = []

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, pose: Rigid) -> None:
        """Add a verified pose."""
        self._poses.append(pose)

    def covers_start(self, start: Rigid) -> bool:
        """Return whether a start lies in the basin of a known pose, so that refining it would give nothing new."""
        return any(self._distance_px(pose, start) < _SAME_START_PX for pose in self._poses)

    def different_from(self, pose: Rigid) -> Rigid | None:
        """Return a known pose that differs from this one; None if there is none."""
        return next((other for other in self._poses if self._distance_px(other, pose) > self._same_px), None)

    def differ(self, first: Rigid, second: Rigid) -> bool:
        """Return whether two poses project the scan to different places in the photo."""
        return self._distance_px(first, second) > self._same_px

    def _distance_px(self, first: Rigid, second: Rigid) -> float:
        """Return the median displacement in the photo of the points that the first pose sees; inf if it sees none."""
        uv = self._camera.project(first @ self._points)
        seen = self._camera.contains(uv)
        if not seen.any():
            return float("inf")
        off = np.hypot(*(self._camera.project(second @ self._points[seen]) - uv[seen]).T)
        return float(np.median(np.where(np.isfinite(off), off, np.inf)))


def ambiguity_sentence(first: Rigid, second: Rigid) -> str:
    """Return the sentence that reports two verified poses."""
    apart_m, angle_deg = first.distance_to(second), float(np.degrees(first.angle_to(second)))
    return (
        f"The pose is ambiguous: two poses, {apart_m:.2f} m and {angle_deg:.1f} deg apart, agree with the images "
        "about equally well."
    )


def second_minimum(
    aligner: Aligner, pose: Rigid, own: Verification, known: KnownPoses, starts: Sequence[Rigid] | None = None
) -> Rigid | None:
    """Return another pose that the image verifies, or nearly verifies; None if none is found.

    A brick wall agrees with the image when shifted by one brick, nearly as well as at its own position. The second pose
    therefore need not pass the thresholds that the first one has passed. If few regions agree with the first pose, less
    suffices: what agrees may be the one surface that the pictures of two rooms have in common.

    Args:
        aligner: the pair that the pose was verified with.
        pose: `camera_from_scanner`, verified.
        own: its verdict.
        known: decides which poses are different.
        starts: `second_starts` of a pose that was refined to this one, if they are known.
    """
    sure = own.fraction >= aligner.gate.sure_fraction
    gate, most = (aligner.gate, _MAX_REFINED) if sure else (unsure_gate(aligner.gate), _MAX_REFINED_UNSURE)
    if starts is None:
        starts = second_starts(aligner, pose)
    coarsest = [aligner.picture(_COARSEST)]
    # One after the other: steps so short wait for each other in two threads.
    first, *ends = (refine_pose(coarsest, start, _REFINEMENT) for start in (pose, *starts))
    if first is None:
        return None
    others = [e for e in ends if e is not None and e.correlation >= gate.second_correlation * first.correlation]
    others.sort(key=lambda e: -e.correlation)
    elsewhere = [e for e in others if _differ(known, pose, e.camera_from_scanner, gate)]
    for end in elsewhere[:most]:
        candidate = aligner.refine(end.camera_from_scanner)
        if candidate is None or not competes(candidate.coarse_verdict, own, gate):
            continue
        if not _differ(known, pose, candidate.camera_from_scanner, gate):
            continue
        second = aligner.finish(candidate.camera_from_scanner)
        if _differ(known, pose, second, gate) and competes(aligner.verify(second)[0], own, gate):
            return second
    return None


def competes(other: Verification, own: Verification, gate: GateOptions) -> bool:
    """Return whether another pose is verified, or agrees with nearly as much of the image as the verified one."""
    nearly = (
        other.fraction >= gate.second_fraction * own.fraction and other.agreeing >= gate.second_count * own.agreeing
    )
    return other.accepted or nearly


def _differ(known: KnownPoses, first: Rigid, second: Rigid, gate: GateOptions) -> bool:
    """Return whether two poses differ in the image, or in camera orientation."""
    return known.differ(first, second) or first.angle_to(second) > gate.same_angle_rad


def second_starts(aligner: Aligner, pose: Rigid) -> list[Rigid]:
    """Return the mirrored pose, and the poses at which the coarse image, shifted as a whole, agrees again.

    Args:
        aligner: the pair.
        pose: `camera_from_scanner`, refined on the coarser levels at least.
    """
    points, target = aligner.points[_COARSEST], aligner.targets[_COARSEST]
    buffer = aligner.occluder.depth_buffer(pose)
    in_camera, uv, visible = project_visible(points, target, aligner.occluder, buffer, pose, border=1)
    if np.count_nonzero(visible) < _MIN_POINTS:
        return []
    seen = points.points[visible].astype(np.float64)
    found = [mirrored(pose, seen)]
    depth, camera = float(np.median(in_camera[visible, 2])), target.camera
    for du, dv in _peaks(points.channels[visible], uv[visible], target.channels, aligner.gate):
        # An image shift is either a translation, at the median depth, or a rotation, which does not depend on depth.
        shift = np.array([du / camera.fx, dv / camera.fy, 0.0]) * depth
        found.append(Rigid(pose.rotation, pose.translation + shift))
        turn = rotation_about("y", np.arctan2(du, camera.fx)) @ rotation_about("x", -np.arctan2(dv, camera.fy))
        found.append(Rigid(turn, np.zeros(3)) @ pose)
    return found


def _peaks(channels: FloatArray, uv: FloatArray, image: FloatArray, gate: GateOptions) -> list[tuple[int, int]]:
    """Return the far shifts (du, dv), level pixels, at which points agree with the image nearly as well, best first.

    Args:
        channels: (N, C) of the points.
        uv: (N, 2) their pixels in the image.
        image: (h, w, C) its channels.
        gate: thresholds of a second pose.
    """
    height, width = image.shape[:2]
    shape = (2 * height, 2 * width)
    column, row = np.rint(uv).astype(np.intp).T
    mask = np.zeros((height, width), np.float32)
    mask[row, column] = 1
    scan = np.zeros_like(image)
    scan[row, column] = channels - channels.mean(axis=0)
    centred = image - image.mean(axis=(0, 1))
    seen = np.conj(np.fft.rfft2(mask, shape))
    product = sum(
        np.conj(np.fft.rfft2(scan[..., k], shape)) * np.fft.rfft2(centred[..., k], shape)
        for k in range(image.shape[-1])
    )
    energy = np.fft.irfft2(seen * np.fft.rfft2((centred**2).sum(axis=-1), shape), shape)
    overlap = np.fft.irfft2(seen * np.fft.rfft2(np.ones_like(mask), shape), shape) / mask.sum()
    score = np.fft.irfft2(product, shape) / np.sqrt(np.maximum(energy, 1e-6 * float(energy.max()) + 1e-12))
    score = np.fft.fftshift(np.where(overlap >= gate.second_overlap, score, -np.inf))
    at_zero = float(score[height, width])
    v, u = np.mgrid[-height:height, -width:width]
    near = int(2 * _MIN_SHIFT_PX) | 1
    highest = score >= cv2.dilate(score, np.ones((near, near)))
    peak = highest & (np.hypot(u, v) > _MIN_SHIFT_PX) & (score > gate.second_peak * at_zero)
    rows, columns = np.nonzero(peak)
    best = np.argsort(-score[rows, columns], kind="stable")[:_MAX_PEAKS]
    return [(int(columns[k]) - width, int(rows[k]) - height) for k in best]
