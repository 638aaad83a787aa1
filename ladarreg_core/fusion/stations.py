"""Scans of several stations as the parts of one model: poses relative to each, and no surface twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.fusion.fused_model import FusedModel
from ladarreg_core.fusion.samples import OtherSurface
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.texture.best_photo import PosedPhoto

_SAME_RELATIVE, _SAME_SIGMAS, _SAME_M = 0.003, 4.0, 0.01
_MIN_COSINE = 0.1
_WINDOW = 9  # cells; single cells decide nothing
_OVERLAP = 2  # cells, so that no gap is left between two parts
_CELLS_AT_ONCE = 1_000_000


def relative_pose(view: PosedPhoto, scanner_from_other: Rigid) -> PosedPhoto:
    """Return a photograph with its pose, and the covariance of that, relative to another scanner."""
    turn = scanner_from_other.rotation.T
    covariance = view.covariance
    if isinstance(covariance, CameraUncertainty):
        covariance = replace(covariance, covariance=_turned(covariance.covariance, turn))
    elif covariance is not None:
        covariance = _turned(covariance, turn)
    return replace(view, camera_from_scanner=view.camera_from_scanner @ scanner_from_other, covariance=covariance)


def _turned(covariance: FloatArray, turn: FloatArray) -> FloatArray:
    """Return a covariance of (w, c, ...) with c, the error of the camera's centre, in the axes of another scanner."""
    J = np.eye(len(covariance))
    J[3:6, 3:6] = turn
    return np.asarray(J @ covariance @ J.T)


def other_surfaces(scans: Sequence[Scan], index: int) -> list[OtherSurface]:
    """Return the surfaces of all scans but one, as seen from that one.

    Raises:
        OptionError: if a scan has no pose in the world.
    """
    here = _pose(scans[index])
    return [OtherSurface(other, _pose(other).inverse @ here) for k, other in enumerate(scans) if k != index]


def _pose(scan: Scan) -> Rigid:
    if scan.world_from_scanner is None:
        raise OptionError(f"{scan.name} has no pose in the world; adjust the survey, or register the scans")
    return scan.world_from_scanner


def doubled_cells(scans: Sequence[Scan]) -> list[BoolArray]:
    """Return for each scan the cells (H, W) whose surface another one sees in finer steps.

    A cell is doubled if the other scan has a return on the same surface, within the noise of both. The finer one has
    the smaller distance between its cells on the surface, which grows with range and incidence. Regions of a scan that
    are cut overlap those of the other by two cells.

    Args:
        scans: scans with their poses in the world.

    Raises:
        OptionError: if a scan has none.
    """
    spacing = [_spacing(scan) for scan in scans]
    result: list[BoolArray] = []
    for k, scan in enumerate(scans):
        cut: BoolArray = np.zeros(scan.shape, np.bool_)
        for n, other in enumerate(scans):
            if n != k:
                cut = cut | _finer(scan, spacing[k], other, spacing[n], first=n < k)
        share = cv2.blur(cut.astype(np.float32), (_WINDOW, _WINDOW))
        valid = cv2.blur(scan.valid.astype(np.float32), (_WINDOW, _WINDOW))
        mostly = ((share > 0.5 * valid) | ~scan.valid).astype(np.uint8)
        inner = cv2.erode(mostly, np.ones((2 * _OVERLAP + 1, 2 * _OVERLAP + 1), np.uint8))
        result.append(np.asarray(inner.astype(np.bool_) & scan.valid))
    return result


def _spacing(scan: Scan) -> NDArray[np.float32]:
    """Return the distance between neighbouring cells on the surface (H, W), m; NaN without a return."""
    rows, columns = np.nonzero(scan.valid)
    result = np.full(scan.shape, np.nan, np.float32)
    step = np.float32(np.sqrt(np.prod(scan.geometry.step_rad)))
    for first in range(0, len(rows), _CELLS_AT_ONCE):
        some = slice(first, first + _CELLS_AT_ONCE)
        at = rows[some], columns[some]
        normals = cell_normals(scan, np.stack(at, axis=-1))
        rays = scan.points[at] / scan.ranges[at][:, None]
        cosine = np.abs(np.einsum("nk,nk->n", normals, rays))
        result[at] = step * scan.ranges[at] / np.sqrt(np.maximum(cosine, np.float32(_MIN_COSINE)))
    return result


def _finer(scan: Scan, spacing: FloatArray, other: Scan, other_spacing: FloatArray, *, first: bool) -> BoolArray:
    """Return the cells of a scan (H, W) on a surface that another scan sees finer, or equally fine and is `first`."""
    other_from_scanner = _pose(other).inverse @ _pose(scan)
    result: NDArray[np.bool_] = np.zeros(scan.shape, np.bool_)
    rows, columns = np.nonzero(scan.valid)
    noise_m = _SAME_SIGMAS * float(np.hypot(grid_edges(scan).noise_m, grid_edges(other).noise_m)) + _SAME_M
    for begin in range(0, len(rows), _CELLS_AT_ONCE):
        at = rows[begin : begin + _CELLS_AT_ONCE], columns[begin : begin + _CELLS_AT_ONCE]
        there = other_from_scanner @ scan.points[at].astype(np.float64)
        place = np.rint(np.nan_to_num(other.geometry.cell_of(there), nan=-1.0))
        inside: BoolArray = np.asarray(((place >= 0) & (place < np.array(other.shape))).all(axis=-1))
        row, column = np.where(inside[:, None], place, 0).astype(np.int64).T
        distance = np.linalg.norm(there, axis=1)
        found = other_spacing[row, column]
        with np.errstate(invalid="ignore"):
            # Beside the ray by half a cell, an oblique surface has another range.
            slack = noise_m + _SAME_RELATIVE * distance + found
            same = inside & (np.abs(other.ranges[row, column] - distance) <= slack)
            finer = found <= spacing[at] if first else found < spacing[at]
        result[at] = same & finer
    return result


def without_cells(model: FusedModel, cells: BoolArray) -> FusedModel | None:
    """Return a model whose scan has no return in cells (H, W); None if none is left."""
    if not cells.any():
        return model
    try:
        scan = replace(model.scan, ranges=np.where(cells, np.float32(np.nan), model.scan.ranges))
    except ShapeError:  # no return is left
        return None
    return replace(model, scan=scan)
