"""The laser's points and the photographs as a reconstruction: what each photograph sees, thinned evenly over it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.export.photo_files import WrittenPhoto
from ladarreg_core.export.registered_scan import Registered, RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.colmap_files import ColmapImage, ColmapModel, joined
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.surface.texture.registered_texture import COLORED, Label

MAX_POINTS = 200_000
"""Points at most, of all photographs together."""
_POINTS_AT_ONCE = 1_000_000
_ROUNDS = 8
_ROWS_AT_ONCE = 128


class Reconstruction:
    """Photographs with the points that they see; computed when it is first needed.

    Args:
        handed: the scans and their photographs.
        photos: those that are written.
        report: receives the progress; may raise `Cancelled`.
    """

    def __init__(self, handed: Registered, photos: Sequence[WrittenPhoto], report: Report | None) -> None:
        self._handed, self._photos, self._report = handed, photos, report

    @cached_property
    def model(self) -> ColmapModel:
        """The reconstruction in the frame of the export.

        The error of a point is the standard deviation of its pixel in the photograph that colours it, where the pose's
        covariance is known, otherwise 0: its pixels are projections of the laser's point and have no residuals.
        """
        scans = [(scan, [one for one in self._photos if one.one in scan.photos]) for scan in self._handed.scans]
        parts = [_Part(scan, photos, len(self._photos), self._report).model for scan, photos in scans if photos]
        return joined(parts) if len(parts) != 1 else parts[0]


class _Part:
    """The points of one scan that its photographs see."""

    def __init__(self, handed: RegisteredScan, photos: Sequence[WrittenPhoto], all_photos: int, report: Report | None):
        self._handed, self._photos, self._all_photos, self._report = handed, photos, all_photos, report

    @property
    def model(self) -> ColmapModel:
        """The reconstruction of this scan."""
        self._handed.compute_colors(self._report)
        seen = [self._seen(index) for index in range(len(self._photos))]
        share = MAX_POINTS // self._all_photos
        kept = np.unique(np.concatenate([_thinned(cells, uv, share) for cells, uv in seen]))
        points = self._handed.frame.place(self._points(kept))
        images = []
        for written, (cells, _) in zip(self._photos, seen, strict=True):
            # Projected again from the written coordinates: readers that project them find the same pixels.
            among = np.flatnonzero(np.isin(kept, cells, assume_unique=True))
            pose = self._handed.written_from_camera(written.one).inverse
            uv = written.camera.project(pose @ points[among])
            inside = written.camera.contains(uv)
            images.append(ColmapImage(written.name, written.camera, pose, among[inside], uv[inside]))
        colors = self._handed.colors
        sigma = np.nan_to_num(colors.sigma_px.reshape(-1)[kept].astype(np.float64), nan=0.0, posinf=0.0)
        words = [line for written in self._photos for line in written.words(self._handed)]
        return ColmapModel(images, points, colors.image.reshape(-1, 3)[kept], sigma, words)

    def _seen(self, index: int) -> tuple[NDArray[np.int64], FloatArray]:
        """Return the cells that a photograph sees, flat and ascending, and their pixels (N, 2) float32."""
        if self._report is not None:
            self._report(Progress(index, len(self._photos), "points of the reconstruction"))
        written = self._photos[index]
        labels = self._labels(written.one)
        cells = np.flatnonzero(labels == Label.SEEN)
        if not len(cells):
            cells = np.flatnonzero(np.isin(labels, COLORED))
        all_uv = []
        kept = []
        for first in range(0, len(cells), _POINTS_AT_ONCE):
            part = cells[first : first + _POINTS_AT_ONCE]
            points_camera = written.one.camera_from_scanner @ self._points(part)
            uv = written.camera.project(points_camera)
            inside = written.camera.contains(uv) & _has_pixel(written.camera, points_camera)
            kept.append(part[inside])
            all_uv.append(uv[inside].astype(np.float32))
        if not kept:
            return cells, np.empty((0, 2), np.float32)
        return np.concatenate(kept), np.concatenate(all_uv)

    def _labels(self, one: RegisteredPhoto) -> NDArray[np.uint8]:
        index = next(k for k, other in enumerate(self._handed.photos) if other is one)
        return np.asarray(self._handed.photo_labels[index]).reshape(-1)

    def _points(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the points (N, 3), scanner frame, of flat cells in ascending order."""
        width = self._handed.scan.shape[1]
        result = np.empty((len(cells), 3))
        at = 0
        while at < len(cells):
            first = int(cells[at]) // width
            end = int(np.searchsorted(cells, (first + _ROWS_AT_ONCE) * width))
            last = int(cells[end - 1]) // width
            band = self._handed.scan.points_at(slice(first, last + 1), slice(None)).reshape(-1, 3)
            result[at:end] = band[cells[at:end] - first * width]
            at = end
        return result


def _has_pixel(camera: CameraModel, points_camera: FloatArray) -> NDArray[np.bool_]:
    """Return which points COLMAP's models map to a pixel: a fisheye's only in front of the camera."""
    in_front: NDArray[np.bool_] = points_camera[:, 2] > 0
    is_fisheye = camera.as_focal is not None and camera.as_pinhole is None
    return in_front if is_fisheye else np.ones(len(points_camera), np.bool_)


def _thinned(cells: NDArray[np.int64], uv: FloatArray, most: int) -> NDArray[np.int64]:
    """Return at most `most` cells, one for each square of the picture of a size that they need."""
    if len(cells) <= most:
        return cells
    chosen = cells
    side = float(np.sqrt(np.prod(uv.max(axis=0) - uv.min(axis=0) + 1) / most))
    for _ in range(_ROUNDS):
        square = np.floor(uv / np.float32(side)).astype(np.int64)
        _, first = np.unique(square[:, 0] * (1 << 32) + square[:, 1], return_index=True)
        if len(first) <= most:
            chosen = cells[np.sort(first)]
            if len(first) > 0.8 * most:
                break
        side *= float(np.sqrt(len(first) / (0.9 * most)))
    return chosen if len(chosen) <= most else chosen[:: -(-len(chosen) // most)]
