"""Images of a scan for the comparison with photographs: its ranges without spikes, laser intensity, and geometry."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.matching.images.structure import structured_cells
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View
from ladarreg_core.surface.spikes import NearestValid, gate_spikes, median_range

_STANDARD_RANGE_M = 2.5
_RANGE_RATIO = (0.4, 4.0)
_STRETCH_PERCENT = (1.0, 99.5)
_STRETCH_SAMPLES = 100_000
_RANGE_SPAN_M = (0.3, 300.0)
_SOBEL_SCALE = 1 / 128  # of 5 x 5 derivatives


@dataclass(frozen=True, slots=True, eq=False)
class CleanedScan:
    """A scan's images on its own grid, which all views of it share."""

    ranges: FloatArray
    """(H, W) m, without spikes."""
    gray: FloatArray
    """(H, W) square root of range-compensated intensity, without holes."""
    structured: BoolArray | None = None
    """(H, W) bool: cells with structure to compare; None: all."""
    stretch: tuple[float, float] | None = None
    """Gray levels that become 0 and 255 in every view; None: each view is stretched by its own."""

    @staticmethod
    def of(scan: Scan, *, for_many_views: bool = False) -> CleanedScan:
        """Return the images of a scan.

        Args:
            scan: the scan.
            for_many_views: its views are compared together, and some are nearly empty: their gray levels are stretched
                alike, and only structured cells are compared.
        """
        nearest = NearestValid(scan.valid)
        median = median_range(scan.ranges, nearest)
        gated = gate_spikes(scan.ranges, median)
        gray = nearest.fill(_laser_gray(scan, median))
        if not for_many_views:
            return CleanedScan(gated, gray)
        stride = max(1, int(np.sqrt(gray.size / _STRETCH_SAMPLES)))
        low, high = np.percentile(gray[::stride, ::stride][scan.valid[::stride, ::stride]], _STRETCH_PERCENT)
        return CleanedScan(gated, gray, structured_cells(gated, gray), (float(low), float(high)))

    def stretched(self, gray: FloatArray, valid: BoolArray) -> FloatArray:
        """Return gray levels (h, w) of a view, float32, stretched to 0 to 255.

        Args:
            gray: (h, w) of the view.
            valid: (h, w) bool, pixels with a return.
        """
        shown = gray[valid] if valid.any() else gray.reshape(-1)
        sample = shown[:: max(1, shown.size // _STRETCH_SAMPLES)]
        low, high = self.stretch or np.percentile(sample, _STRETCH_PERCENT)
        return np.clip((gray - low) * (255 / max(float(high - low), 1e-9)), 0, 255).astype(np.float32)


def _laser_gray(scan: Scan, ranges: FloatArray) -> FloatArray:
    """Return the square root of intensity, (H, W) float32, compensated for ranges without spikes and holes."""
    intensity = np.maximum(scan.intensity, 0)
    if scan.intensity.min(initial=0.0, where=scan.valid) < 0:  # logarithmic, as in dB: only differences count
        low = float(np.percentile(scan.intensity[scan.valid], _STRETCH_PERCENT[0]))
        intensity = np.maximum(scan.intensity - low, 0)
    root = np.sqrt(intensity).astype(np.float32, copy=False)
    if scan.intensity_is == "raw":
        root *= np.clip(ranges / np.float32(_STANDARD_RANGE_M), *_RANGE_RATIO)
    return root


def geometry_planes(view: View, ranges: FloatArray) -> list[FloatArray]:
    """Return nx, ny, nz and 1.5 log r of a view's ranges, scaled so that edges are as strong as gray ones.

    Args:
        view: the view.
        ranges: (h, w) float32 m, median-filtered and without holes.
    """
    log_range = cv2.bilateralFilter(np.log(np.clip(ranges, *_RANGE_SPAN_M)), 7, 0.03, 3)
    camera = view.camera
    x = np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)
    y = np.arange(camera.height, dtype=np.float32)[:, None] - np.float32(camera.cy)
    a, b = x / np.float32(camera.fx), y / np.float32(camera.fy)
    depth = np.exp(log_range) / np.sqrt(1 + a**2 + b**2)
    # The normal of the surface (a z, b z, z), z(u, v) the depth: (-fx z_u, -fy z_v, z + (u - cx) z_u + (v - cy) z_v).
    z_u, z_v = (
        np.asarray(cv2.Sobel(depth, cv2.CV_32F, *order, ksize=5, scale=_SOBEL_SCALE)) for order in ((1, 0), (0, 1))
    )
    normal = [np.float32(camera.fx) * z_u, np.float32(camera.fy) * z_v, depth + x * z_u + y * z_v]
    scale = 255 / np.maximum(np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2), 1e-12)
    planes = [np.asarray(cv2.GaussianBlur(plane * scale, (0, 0), 1.0)) for plane in normal]
    return [np.ascontiguousarray(plane, dtype=np.float32) for plane in (*planes, np.float32(1.5 * 255) * log_range)]
