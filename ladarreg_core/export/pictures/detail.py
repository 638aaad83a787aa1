"""Choice of the detail that shows the quality of a registration best, and the scan's edges drawn on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, intensity_picture

DETAIL_ASPECT = 4 / 3
_DETAIL_SHARE = 0.17
_MIN_CELLS = 16
_MARGIN_SHARE = 0.04
_WHOLE_SHARE = 0.85
_WORKING_CELLS = 400_000
_BLUR_CELLS = 0.8
_STRONG_EDGES, _WEAK_EDGES = 95.0, 88.0
_MIN_EDGE = 3.0
_CANNY_RANGE = 16000.0
_NOISE_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangular part of the scan's grid, in cells."""

    top: int
    """First row."""
    left: int
    """First column."""
    height: int
    """Number of rows."""
    width: int
    """Number of columns."""

    @property
    def cells(self) -> tuple[slice, slice]:
        """Slices of rows and columns that index arrays on the grid."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


def cell_aspect(scan: Scan) -> float:
    """Return the ratio of a cell's angular width and height, limited to a displayable range."""
    down, across = scan.geometry.step_rad
    ratio = across / down if down > 0 and across > 0 else 1.0
    return float(np.clip(ratio, 0.2, 5.0)) if np.isfinite(ratio) else 1.0


def whole_window(scan: Scan) -> Window:
    """Return the window of the whole grid."""
    return Window(0, 0, *scan.shape)


def seen_window(scan: Scan, textures: Sequence[RegisteredTexture]) -> Window:
    """Return the part of the grid coloured by any texture, with a margin; the whole grid if that is most of it.

    Args:
        scan: the scan.
        textures: the photograph on its grid, for several poses.
    """
    colored = np.zeros(scan.shape, dtype=np.bool_)
    for texture in textures:
        colored |= texture.colored
    rows, columns = np.flatnonzero(colored.any(axis=1)), np.flatnonzero(colored.any(axis=0))
    if not len(rows):
        return whole_window(scan)
    margin = round(_MARGIN_SHARE * max(np.ptp(rows), np.ptp(columns)))
    window = _around(
        (float(rows[0] + rows[-1]) / 2, float(columns[0] + columns[-1]) / 2),
        max(int(np.ptp(rows)) + 1 + 2 * margin, _MIN_CELLS),
        max(int(np.ptp(columns)) + 1 + 2 * margin, _MIN_CELLS),
        scan.shape,
    )
    all_cells = scan.shape[0] * scan.shape[1]
    return window if window.height * window.width < _WHOLE_SHARE * all_cells else whole_window(scan)


def detail_window(scan: Scan, reference: RegisteredTexture, textures: Sequence[RegisteredTexture]) -> Window | None:
    """Return the part of the grid where depth edges coincide with contrast and most textures have colour.

    Args:
        scan: the scan.
        reference: the texture whose contrast is used.
        textures: all textures, including `reference`.

    Returns:
        The window, with the angular aspect `DETAIL_ASPECT` if the grid is large enough; None if no cell is coloured.
    """
    step = max(1, int(np.sqrt(scan.ranges.size / _WORKING_CELLS)))
    seen = reference.colored[::step, ::step]
    if not seen.any():
        return None
    share = np.mean([texture.colored[::step, ::step] for texture in textures], axis=0, dtype=np.float32)
    brightness = cv2.cvtColor(np.ascontiguousarray(reference.image[::step, ::step]), cv2.COLOR_RGB2GRAY)
    contrast = _local_contrast(np.asarray(brightness, np.uint8), seen)
    edges = _depth_edges(scan, step) + 0.3 * _local_contrast(intensity_picture(scan)[::step, ::step, 0], seen)
    score = edges * (0.05 + contrast) * share * seen

    height, width = _detail_size(scan, reference)
    box = (max(1, min(width // step, seen.shape[1])), max(1, min(height // step, seen.shape[0])))
    filled = _box_mean(seen.astype(np.float32), box)
    best = _box_mean(score.astype(np.float32), box)
    best[filled < 0.85 * filled.max()] = -1
    row, column = np.unravel_index(int(best.argmax()), best.shape)
    return _around((float(row) * step, float(column) * step), height, width, scan.shape)


def edge_lines(scan: Scan, window: Window, size: tuple[int, int]) -> BoolArray:
    """Return thin lines along the edges of the scan's intensity in a window, as a mask of the enlarged image.

    Args:
        scan: the scan.
        window: the part of its grid.
        size: (width, height) of the enlarged image, pixels.

    Returns:
        (height, width) bool.
    """
    reach = int(np.ceil(4 * _BLUR_CELLS)) + 1  # of the blur
    rows, columns = (slice(max(0, part.start - reach), part.stop + reach) for part in window.cells)
    inner = slice(window.top - rows.start, None), slice(window.left - columns.start, None)
    intensity = intensity_picture(scan)[rows, columns, 0]
    known = scan.valid[rows, columns].astype(np.float32)
    # Speckle is blurred, and holes are filled from their neighbours so that they create no edges.
    weight = cv2.GaussianBlur(known, (0, 0), _BLUR_CELLS)
    smooth = cv2.GaussianBlur(intensity * known, (0, 0), _BLUR_CELLS) / np.maximum(weight, 1e-3)
    part = smooth[inner][: window.height, : window.width]
    crop = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_CUBIC))
    # The enlarged image is piecewise smooth per cell; without blurring, each cell border in a ramp would be an edge.
    cell_px = max(size[0] / window.width, size[1] / window.height)
    crop = cv2.GaussianBlur(crop, (0, 0), max(_BLUR_CELLS * cell_px, _BLUR_CELLS))
    slopes = [np.asarray(cv2.Sobel(crop, cv2.CV_32F, *d, ksize=3)) * (cell_px / 8) for d in ((1, 0), (0, 1))]
    strength = np.hypot(*slopes)  # gray levels per cell
    strong = max(float(np.percentile(strength, _STRONG_EDGES)), _MIN_EDGE)
    weak = min(max(float(np.percentile(strength, _WEAK_EDGES)), _MIN_EDGE / 2), strong)
    # Canny takes integers; on an enlarged image, slopes of few levels would give frayed lines.
    finer = _CANNY_RANGE / max(float(strength.max()), _MIN_EDGE)
    dx, dy = (np.rint(slope * finer).astype(np.int16) for slope in slopes)
    return np.asarray(cv2.Canny(dx, dy, weak * finer, strong * finer, L2gradient=True)) > 0


def _detail_size(scan: Scan, reference: RegisteredTexture) -> tuple[int, int]:
    """Return (rows, columns) of the detail: a share of the coloured part, with a fixed angular aspect."""
    seen = seen_window(scan, [reference])
    aspect = cell_aspect(scan)
    across = max(_DETAIL_SHARE * np.sqrt(seen.width * aspect * seen.height * DETAIL_ASPECT), _MIN_CELLS * aspect)
    height, width = round(across / DETAIL_ASPECT), round(across / aspect)
    return max(2, min(height, scan.shape[0])), max(2, min(width, scan.shape[1]))


def _around(middle: tuple[float, float], height: int, width: int, shape: tuple[int, int]) -> Window:
    """Return a window centred on a cell, shifted into the grid."""
    height, width = min(height, shape[0]), min(width, shape[1])
    top = int(np.clip(round(middle[0] - height / 2), 0, shape[0] - height))
    left = int(np.clip(round(middle[1] - width / 2), 0, shape[1] - width))
    return Window(top, left, height, width)


def _depth_edges(scan: Scan, step: int) -> NDArray[np.float32]:
    """Return 1 at cells next to a depth edge, else 0, for every `step`-th cell."""
    edges, valid = grid_edges(scan), scan.valid
    found = np.zeros(scan.shape, dtype=np.uint8)
    found[:, 1:] |= ~edges.right & valid[:, 1:] & valid[:, :-1]
    found[1:] |= ~edges.down & valid[1:] & valid[:-1]
    # Edges are thin; where most cells are edges there is no surface but noise (windows, foliage).
    found[_box_mean(found.astype(np.float32), (9, 9)) > _NOISE_SHARE] = 0
    if step > 1:
        found = np.asarray(cv2.dilate(found, np.ones((step, step), np.uint8)))
    return found[::step, ::step].astype(np.float32)


def _local_contrast(gray: ByteArray, seen: BoolArray) -> NDArray[np.float32]:
    """Return the range of brightness (H, W) around each cell, 0 to 1, among the coloured cells."""
    kernel = np.ones((5, 5), np.uint8)
    brightest = np.asarray(cv2.dilate(np.where(seen, gray, 0).astype(np.uint8), kernel), dtype=np.float32)
    darkest = np.asarray(cv2.erode(np.where(seen, gray, 255).astype(np.uint8), kernel), dtype=np.float32)
    return np.asarray(np.maximum(brightest - darkest, 0) / np.float32(255), dtype=np.float32)


def _box_mean(values: FloatArray, box: tuple[int, int]) -> NDArray[np.float32]:
    """Return the mean over a box (width, height) around each cell, with zeros outside the grid."""
    return np.asarray(cv2.blur(values, box, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
