"""Viewing directions from the scanner: one for a narrow scan, several for a wide one. Sampling density in a photo."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, look_along, rotation_about
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View

_STEP = 0.6
_MARGIN = 1.4
_MIN_SHARE = 0.05
_SAMPLES = 10_000
_MIN_SEEN = 30
_ENOUGH_SEEN, _MIN_GAIN_SEEN = 0.7, 0.1
_SETTLED_RAD = np.radians(3.0)  # with 6, the edge of what a photo sees was cut off, and its camera not determined
_MOSTLY = 0.5
_COMBINE, _ACCUMULATE = "combine several scans", "accumulate longer from the same place"
MIN_RETURNS_IN_PHOTO = 25_000
"""Least number of returns in a full image: images are compared at the scan's resolution, not the photo's."""
_DENSITY_SAMPLES = 200_000
_TILES = (16, 10)


def viewing_directions(scan: Scan, camera: Camera, *, initial: Rigid | None = None) -> list[Rigid]:
    """Return the rotations (view from scanner) to search, likeliest first.

    Args:
        scan: the scan.
        camera: the working camera, which defines the field of view.
        initial: an initial pose; the first direction is then that of the overlap, with the camera's roll, because
            channels are not invariant to rotation.

    Returns:
        one or more rotations. A scan that is not much wider than the photo is viewed along its mean direction; a wider
        one in steps of 0.6 of the field of view, from the centre outwards.
    """
    found = []
    if initial is not None:
        found.append(direction_towards_overlap(scan, camera, initial) or Rigid(initial.rotation, np.zeros(3)))
    rays = scan.sampled_directions
    rays = rays[np.isfinite(rays).all(axis=-1)]  # a strongly distorted lens has no rays at its corners
    centre = scan.mean_direction
    half_width = np.arctan(0.5 * camera.width / camera.fx)
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    spread = _wrapped(azimuth - np.arctan2(centre[1], centre[0]))
    reach = float(np.percentile(np.abs(spread), 98))
    first = Rigid(look_along(centre), np.zeros(3))
    if reach <= _MARGIN * half_width:
        return [*found, first]
    step = 2 * half_width * _STEP
    count = int(np.ceil(2 * min(reach, np.pi) / step))
    scored = []
    for turn in (np.arange(count) - (count - 1) / 2) * step:
        angle = np.arctan2(centre[1], centre[0]) + turn
        near = np.abs(_wrapped(azimuth - angle)) < half_width
        if near.mean() < _MIN_SHARE:
            continue
        elevation = float(np.median(np.arcsin(np.clip(rays[near, 2], -1, 1))))
        direction = [np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)]
        scored.append((abs(turn), Rigid(look_along(direction), np.zeros(3))))
    scored.sort(key=lambda item: item[0])
    return [*found, *(view for _, view in scored)] or [first]


def rolled_view(view_from_scanner: Rigid, angle_rad: float) -> Rigid:
    """Return the rotation (view from scanner) of a view rolled clockwise, seen from behind, by an angle, rad."""
    return Rigid(rotation_about("z", -angle_rad), np.zeros(3)) @ view_from_scanner


def direction_towards_overlap(scan: Scan, camera: Camera, pose: Rigid, *, view: View | None = None) -> Rigid | None:
    """Return the rotation (view from scanner) towards the part of the scan that a photo sees, with the photo's roll.

    Args:
        scan: the scan.
        camera: the working camera.
        pose: `camera_from_scanner` of the photo.
        view: the current view, if any.

    Returns:
        the rotation; None if the photo sees hardly anything of the scan, or `view` shows most of it already.
    """
    stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLES)))
    points = scan.thinned_points(stride).reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=-1)]
    points = points[camera.contains(camera.project(pose @ points))]
    if len(points) < _MIN_SEEN:
        return None
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    forward = rays.mean(axis=0)
    right = np.cross(pose.rotation[1], forward)
    if min(np.linalg.norm(forward), np.linalg.norm(right)) < 1e-3:
        return None
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    found = Rigid(np.stack([right, np.cross(forward, right), forward]), np.zeros(3))
    if view is not None:
        now, then = (
            float(view.camera.contains(view.camera.project(rays @ turn.rotation.T)).mean())
            for turn in (view.view_from_scanner, found)
        )
        if now >= _ENOUGH_SEEN or then < now + _MIN_GAIN_SEEN:
            return None
    return found


def settled_view(direction: Rigid) -> Rigid:
    """Return the rotation (view from scanner) of the nearest of a fixed set of views, some degrees apart.

    How the cells of a coarse scan fall on the pixels of a view displaces what is found there by parts of a cell. All
    that is found near a pose is therefore compared in one and the same view.

    Args:
        direction: rotation (view from scanner) towards what is compared.
    """
    forward = direction.rotation[2]
    steps = np.array([np.arctan2(forward[1], forward[0]), np.arcsin(np.clip(forward[2], -1, 1))]) / _SETTLED_RAD
    azimuth, elevation = np.rint(steps) * _SETTLED_RAD
    along = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    upright = Rigid(look_along(along), np.zeros(3))
    right = upright.rotation @ direction.rotation[0]
    roll = np.rint(np.arctan2(right[1], right[0]) / _SETTLED_RAD) * _SETTLED_RAD
    return rolled_view(upright, roll)


@dataclass(frozen=True, slots=True)
class ScanDensity:
    """Density at which a scan samples a photo."""

    points: int
    """Number of returns within the image, occluded ones included."""
    photo_px_per_point: float
    """Photo pixels per return, in the parts of the image that have returns."""
    needed_px_per_point: float
    """Largest number of photo pixels per return at which registration works."""
    covered: float = 1.0
    """Share of the image that has returns, by tiles."""

    @property
    def too_sparse(self) -> bool:
        """Whether too few returns lie in the image for a registration."""
        return self.photo_px_per_point > self.needed_px_per_point

    def summary(self) -> str:
        """Return the sentence for a scan that is too sparse."""
        needed = round(self.needed_px_per_point)
        found = max(round(self.photo_px_per_point), needed + 1)  # never the same number twice
        return (
            f"The scan is too sparse for this photo: 1 point per {found} photo pixels "
            f"({self.points:,} points in the image); about 1 per {needed} is needed. Scan at a "
            f"higher resolution, or {_COMBINE}."
        )

    def advice(self) -> str:
        """Return what to do about a coarse scan that gives too little evidence."""
        if self.covered < _MOSTLY:
            return (
                f"The scan has returns in {self.covered:.0%} of the photo: turn the camera to where the scan has more, "
                "near and far."
            )
        return (
            f"The scan is coarse for this photo, with 1 point per {self.photo_px_per_point:.0f} photo pixels where it "
            f"has any: {_ACCUMULATE}, or turn the camera to where outlines stand before what is far or the sky."
        )


def would_clouds_help(reasons: Iterable[str]) -> bool:
    """Return whether the reasons of a verdict advise further clouds of the scan's standpoint."""
    return any(advice in reason for reason in reasons for advice in (_COMBINE, _ACCUMULATE))


def scan_density(scan: Scan, camera: Camera, poses: Sequence[Rigid]) -> ScanDensity | None:
    """Return the highest sampling density of a photo over several poses, or None if it sees no return at any.

    Args:
        scan: the scan.
        camera: the photo's own camera.
        poses: `camera_from_scanner`; approximate ones are sufficient, such as views from the scanner's position.
    """
    stride = max(1, round(float(np.sqrt(scan.ranges.size / _DENSITY_SAMPLES))))
    points = scan.thinned_points(stride).reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=-1)]
    densest: ScanDensity | None = None
    area = camera.width * camera.height
    for pose in poses:
        uv = camera.project(pose @ points)
        uv = uv[camera.contains(uv)]
        count = len(uv) * stride**2
        if not count or (densest is not None and count <= densest.points):
            continue
        tiles = np.array(_TILES)
        column, row = np.minimum(np.floor((uv + 0.5) * tiles / camera.size).astype(np.intp), tiles - 1).T
        seen = np.bincount(row * _TILES[0] + column, minlength=_TILES[0] * _TILES[1])
        covered = np.count_nonzero(seen) / len(seen)
        densest = ScanDensity(count, covered * area / count, area / MIN_RETURNS_IN_PHOTO, covered)
    return densest


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
