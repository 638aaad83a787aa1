"""Where on the scan the quality of a registration shows best, and the scan's edges to judge it by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh import grid_edges
from ladarreg_core.surface.texture import RegisteredTexture, intensity_picture

DETAIL_ASPECT = 4 / 3
_DETAIL_SHARE = 0.17
_LEAST_CELLS = 16
_MARGIN_SHARE = 0.04
_WHOLE_SHARE = 0.85
_WORKING_CELLS = 400_000
_BLUR_CELLS = 0.8
_STRONG_EDGES, _WEAK_EDGES = 95.0, 88.0
_LEAST_EDGE = 3.0
_CANNY_RANGE = 16000.0
_NOISE_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class Window:
    """A part of the scan's grid, cells."""

    top: int
    """First row."""
    left: int
    """First column."""
    height: int
    """Rows."""
    width: int
    """Columns."""

    @property
    def cells(self) -> tuple[slice, slice]:
        """The rows and columns, to index an array on the grid with."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


def cell_aspect(scan: Scan) -> float:
    """Return how wide a cell is in angle against its height, within what a picture can bear."""
    down, across = scan.geometry.step_rad
    ratio = across / down if down > 0 and across > 0 else 1.0
    return float(np.clip(ratio, 0.2, 5.0)) if np.isfinite(ratio) else 1.0


def whole_window(scan: Scan) -> Window:
    """Return all of the grid."""
    return Window(0, 0, *scan.shape)


def seen_window(scan: Scan, textures: Sequence[RegisteredTexture]) -> Window:
    """Return the part of the grid that any of the pictures colours, with a margin; all of it where that is most.

    Args:
        scan: the scan.
        textures: the photograph on its grid, by several poses.
    """
    coloured = np.zeros(scan.shape, dtype=np.bool_)
    for texture in textures:
        coloured |= texture.coloured
    rows, columns = np.flatnonzero(coloured.any(axis=1)), np.flatnonzero(coloured.any(axis=0))
    if not len(rows):
        return whole_window(scan)
    margin = round(_MARGIN_SHARE * max(np.ptp(rows), np.ptp(columns)))
    window = _around(
        (float(rows[0] + rows[-1]) / 2, float(columns[0] + columns[-1]) / 2),
        max(int(np.ptp(rows)) + 1 + 2 * margin, _LEAST_CELLS),
        max(int(np.ptp(columns)) + 1 + 2 * margin, _LEAST_CELLS),
        scan.shape,
    )
    all_cells = scan.shape[0] * scan.shape[1]
    return window if window.height * window.width < _WHOLE_SHARE * all_cells else whole_window(scan)


def detail_window(scan: Scan, reference: RegisteredTexture, textures: Sequence[RegisteredTexture]) -> Window | None:
    """Return the part of the grid where depth edges meet a change of the photograph's colour, and most pictures see it.

    Args:
        scan: the scan.
        reference: the picture to judge contrast by.
        textures: all pictures, `reference` among them.

    Returns:
        The window, of the aspect `DETAIL_ASPECT` in angle where the grid is large enough; None if nothing is seen.
    """
    step = max(1, int(np.sqrt(scan.ranges.size / _WORKING_CELLS)))
    seen = reference.coloured[::step, ::step]
    if not seen.any():
        return None
    share = np.mean([texture.coloured[::step, ::step] for texture in textures], axis=0, dtype=np.float32)
    contrast = _local_contrast(reference.image[::step, ::step], seen)
    intensity = intensity_picture(scan)[::step, ::step, 0]
    edges = _torn(scan, step) + 0.3 * _local_contrast(np.repeat(intensity[..., None], 3, axis=-1), seen)
    score = edges * (0.05 + contrast) * share * seen

    height, width = _detail_size(scan, reference)
    box = (max(1, min(width // step, seen.shape[1])), max(1, min(height // step, seen.shape[0])))
    filled = _box_mean(seen.astype(np.float32), box)
    best = _box_mean(score.astype(np.float32), box)
    best[filled < 0.85 * filled.max()] = -1
    row, column = np.unravel_index(int(best.argmax()), best.shape)
    return _around((float(row) * step, float(column) * step), height, width, scan.shape)


def edge_lines(scan: Scan, window: Window, size: tuple[int, int]) -> BoolArray:
    """Return thin lines along the edges of the scan's intensity in a window, as a mask of an enlarged picture.

    Args:
        scan: the scan.
        window: which part of its grid.
        size: (width, height) of the picture, pixels.

    Returns:
        (height, width) bool.
    """
    intensity = intensity_picture(scan)[..., 0]
    known = scan.valid.astype(np.float32)
    # Speckle is blurred, and holes are filled from beside them so that they make no edge.
    weight = cv2.GaussianBlur(known, (0, 0), _BLUR_CELLS)
    smooth = cv2.GaussianBlur(intensity * known, (0, 0), _BLUR_CELLS) / np.maximum(weight, 1e-3)
    crop = np.asarray(cv2.resize(smooth[window.cells], size, interpolation=cv2.INTER_CUBIC))
    # The enlargement bends at every cell, and each bend in a ramp would be an edge of its own.
    cell_px = max(size[0] / window.width, size[1] / window.height)
    crop = cv2.GaussianBlur(crop, (0, 0), max(_BLUR_CELLS * cell_px, _BLUR_CELLS))
    slopes = [np.asarray(cv2.Sobel(crop, cv2.CV_32F, *d, ksize=3)) * (cell_px / 8) for d in ((1, 0), (0, 1))]
    strength = np.hypot(*slopes)  # gray levels per cell
    strong = max(float(np.percentile(strength, _STRONG_EDGES)), _LEAST_EDGE)
    weak = min(max(float(np.percentile(strength, _WEAK_EDGES)), _LEAST_EDGE / 2), strong)
    # Canny takes whole numbers; on an enlargement a slope of few levels would make hairy lines.
    finer = _CANNY_RANGE / max(float(strength.max()), _LEAST_EDGE)
    dx, dy = (np.rint(slope * finer).astype(np.int16) for slope in slopes)
    return np.asarray(cv2.Canny(dx, dy, weak * finer, strong * finer, L2gradient=True)) > 0


def _detail_size(scan: Scan, reference: RegisteredTexture) -> tuple[int, int]:
    """Return (rows, columns) of the detail: a share of what is seen, of one aspect in angle."""
    seen = seen_window(scan, [reference])
    aspect = cell_aspect(scan)
    across = max(_DETAIL_SHARE * np.sqrt(seen.width * aspect * seen.height * DETAIL_ASPECT), _LEAST_CELLS * aspect)
    height, width = round(across / DETAIL_ASPECT), round(across / aspect)
    return max(2, min(height, scan.shape[0])), max(2, min(width, scan.shape[1]))


def _around(middle: tuple[float, float], height: int, width: int, shape: tuple[int, int]) -> Window:
    """Return a window of a size about a cell, moved into the grid."""
    height, width = min(height, shape[0]), min(width, shape[1])
    top = int(np.clip(round(middle[0] - height / 2), 0, shape[0] - height))
    left = int(np.clip(round(middle[1] - width / 2), 0, shape[1] - width))
    return Window(top, left, height, width)


def _torn(scan: Scan, step: int) -> NDArray[np.float32]:
    """Return 1 at cells beside a depth edge, else 0, for every `step`-th cell."""
    edges, valid = grid_edges(scan), scan.valid
    torn = np.zeros(scan.shape, dtype=np.uint8)
    torn[:, 1:] |= ~edges.right & valid[:, 1:] & valid[:, :-1]
    torn[1:] |= ~edges.down & valid[1:] & valid[:-1]
    # An edge is thin; where most cells are torn there is no surface, only noise (windows, foliage).
    torn[_box_mean(torn.astype(np.float32), (9, 9)) > _NOISE_SHARE] = 0
    if step > 1:
        torn = np.asarray(cv2.dilate(torn, np.ones((step, step), np.uint8)))
    return torn[::step, ::step].astype(np.float32)


def _local_contrast(picture: ByteArray, seen: BoolArray) -> NDArray[np.float32]:
    """Return the spread of the brightness about each cell, 0 to 1, among the cells that are seen."""
    gray = np.ascontiguousarray(cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY))
    kernel = np.ones((5, 5), np.uint8)
    brightest = np.asarray(cv2.dilate(np.where(seen, gray, 0).astype(np.uint8), kernel), dtype=np.float32)
    darkest = np.asarray(cv2.erode(np.where(seen, gray, 255).astype(np.uint8), kernel), dtype=np.float32)
    return np.asarray(np.maximum(brightest - darkest, 0) / np.float32(255), dtype=np.float32)


def _box_mean(values: FloatArray, box: tuple[int, int]) -> NDArray[np.float32]:
    """Return the mean over a box (width, height) about each cell, with nothing outside the grid."""
    return np.asarray(cv2.blur(values, box, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
