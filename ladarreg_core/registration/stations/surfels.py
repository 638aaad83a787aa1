"""A scan as its surfaces: evenly spread points with normals, however densely the scanner sampled them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.scan import Scan

_MAX_CELLS = 500_000
_MAX_RETURNS = 160_000
_SPACING_SHARE = 0.016  # of the typical range
_FINEST_M, _COARSEST_M = 0.05, 0.5
_NEIGHBOURS = 10
_UPRIGHT_NORMAL = 0.35  # |n_z| below it: a wall
_LEVEL_NORMAL = 0.92
_BENT = 0.12  # thickness over extent of a neighbourhood that has no normal


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """Points of a scan with their normals, about one for each square of the spacing."""

    points: NDArray[np.float64]
    """(N, 3) m, scanner frame; each is the mean of the returns of a voxel."""
    normals: NDArray[np.float64]
    """(N, 3) unit, toward the scanner."""
    is_wall: BoolArray
    """(N,) the normal is horizontal, within 20 degrees."""
    is_level: BoolArray
    """(N,) the normal is vertical, within 23 degrees: floors, tables, ceilings."""
    intensity: NDArray[np.float64]
    """(N,) logarithm of the intensity, the fall with range removed where the scan's is raw; NaN where it is dark."""
    returns: NDArray[np.float64]
    """(M, 3) m, single returns spread evenly over the grid of the scan."""
    spacing_m: float
    """Side of the voxels."""
    reach_m: float
    """Horizontal distance within which nearly all points lie."""


def surfels_of(scan: Scan) -> Surfels:
    """Return the surfaces of a scan."""
    thin, _ = scan.thinned(_MAX_CELLS)
    valid = thin.valid
    points = thin.points[valid].astype(np.float64)
    light = _light(thin)[valid]
    ranges = np.linalg.norm(points, axis=-1)
    spacing = float(np.clip(_SPACING_SHARE * np.median(ranges), _FINEST_M, _COARSEST_M))
    key = np.floor(points / spacing).astype(np.int64) + (1 << 20)
    _, voxel = np.unique((key[:, 0] << 42) | (key[:, 1] << 21) | key[:, 2], return_inverse=True)
    count = np.bincount(voxel)
    centre = np.stack([np.bincount(voxel, points[:, k]) for k in range(3)], axis=-1) / count[:, None]
    bright = np.isfinite(light)
    lit = np.bincount(voxel[bright], minlength=len(count))
    with np.errstate(invalid="ignore", divide="ignore"):
        intensity = np.bincount(voxel[bright], light[bright], len(count)) / lit
    normals, flat = _normals(centre, spacing)
    stride = max(1, -(-len(points) // _MAX_RETURNS))
    centre, normals, intensity = centre[flat], normals[flat], intensity[flat]
    steep = np.abs(normals[:, 2])
    across = np.hypot(centre[:, 0], centre[:, 1])
    return Surfels(
        centre, normals, steep < _UPRIGHT_NORMAL, steep > _LEVEL_NORMAL, intensity, points[::stride], spacing,
        float(np.quantile(across, 0.98)) if len(across) else 1.0,
    )  # fmt: skip


def _light(scan: Scan) -> FloatArray:
    """Return the logarithm of the intensity (H, W), NaN where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        light = np.log(np.where(scan.intensity > 0, scan.intensity, np.nan).astype(np.float64))
        if scan.intensity_is == "raw":
            light = light + 2 * np.log(scan.ranges)
    return np.asarray(light, np.float64)


def _normals(points: FloatArray, spacing: float) -> tuple[NDArray[np.float64], BoolArray]:
    """Return normals toward the scanner (N, 3), and whether the neighbourhood of each point is flat."""
    from scipy.spatial import cKDTree

    if len(points) < _NEIGHBOURS:
        return np.zeros((len(points), 3)), np.zeros(len(points), np.bool_)
    apart, near = cKDTree(points).query(points, _NEIGHBOURS)
    there = apart < 3.5 * spacing
    weight = there.astype(np.float64)
    total = weight.sum(-1)
    around = points[near]
    middle = (around * weight[..., None]).sum(1) / total[:, None]
    off = (around - middle[:, None]) * np.sqrt(weight)[..., None]
    values, axes = np.linalg.eigh(off.transpose(0, 2, 1) @ off / total[:, None, None])
    normals = axes[..., 0]
    normals *= -np.sign((normals * points).sum(-1, keepdims=True) + 1e-12)
    flat = (total >= 5) & (values[:, 1] > 1e-12) & (values[:, 0] < _BENT * values[:, 1])
    return np.ascontiguousarray(normals), np.asarray(flat, np.bool_)
