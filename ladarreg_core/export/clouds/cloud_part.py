"""The returns of a scan with their colours, some rows at a time: what every file of points is written from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.layered_scan import LayerValues
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import CellColors
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, dimmed_levels, model_rows

SCANNER_FRAME = OutputFrame()
_ROWS_AT_ONCE = 128


@dataclass(frozen=True, slots=True, eq=False)
class CloudPart:
    """The returns of a scan with their colours, in the frame of the file."""

    scan: Scan
    texture: RegisteredTexture | CellColors
    frame: OutputFrame = SCANNER_FRAME
    layers: Mapping[str, LayerValues] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class CloudRows:
    """The N returns of some rows, row by row."""

    points: NDArray[np.float64]
    """(N, 3), m, in the frame of the file."""
    color: NDArray[np.uint8]
    """(N, 3) RGB; of cells that no photograph shows, the dimmed laser intensity."""
    intensity: NDArray[np.float32]
    """(N,)."""
    labels: NDArray[np.uint8]
    """(N,) codes of `Label`."""
    photo: NDArray[np.uint16] | None
    """(N,) as `CellColors.photo`; None where the colours are of one photograph."""
    sigma_px: NDArray[np.float32] | None
    """(N,) as `CellColors.sigma_px`; None likewise."""
    layers: Mapping[str, NDArray[Any]]
    """(N,) each."""


def cloud_rows(part: CloudPart) -> Iterator[CloudRows]:
    """Yield the returns of a part, some rows at a time."""
    scan, texture = part.scan, part.texture
    several = texture if isinstance(texture, CellColors) else None
    levels, drawn = dimmed_levels(scan), texture.texture if isinstance(texture, CellColors) else texture
    for rows, valid in _valid_rows(scan):
        yield CloudRows(
            points=part.frame.place(scan.points_at(rows, slice(None)).reshape(-1, 3).take(valid, axis=0)),
            color=model_rows(scan, drawn, rows, levels).reshape(-1, 3).take(valid, axis=0),
            intensity=scan.intensity[rows].take(valid),
            labels=texture.labels[rows].take(valid),
            photo=None if several is None else several.photo[rows].take(valid),
            sigma_px=None if several is None else several.sigma_px[rows].take(valid),
            layers={name: one.values[rows].take(valid) for name, one in part.layers.items()},
        )


def cloud_points(part: CloudPart) -> Iterator[NDArray[np.float64]]:
    """Yield the points of `cloud_rows` alone."""
    for rows, valid in _valid_rows(part.scan):
        yield part.frame.place(part.scan.points_at(rows, slice(None)).reshape(-1, 3).take(valid, axis=0))


def _valid_rows(scan: Scan) -> Iterator[tuple[slice, NDArray[np.intp]]]:
    """Yield some rows and which of their cells, flat, have a return."""
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        yield rows, np.flatnonzero(scan.valid[rows])


class SixteenBitIntensity:
    """The intensities of scans in 16 bits: unchanged where they are whole numbers that fit."""

    def __init__(self, scans: Sequence[Scan]) -> None:
        low, high, whole = np.inf, -np.inf, True
        for scan in scans:
            for first in range(0, scan.shape[0], 256):
                here = scan.intensity[first : first + 256][scan.valid[first : first + 256]]
                if not here.size:
                    continue
                low, high = min(low, float(here.min())), max(high, float(here.max()))
                whole = whole and bool((here == np.rint(here)).all())
        self._zero, self._factor = min(low, 0.0), 1.0
        if not whole or low < 0 or high > 65535:
            self._factor = 65535.0 / max(high - self._zero, 1e-30)
        self.words = "the scan's"
        if self._factor != 1.0:
            less = f" less {self._zero:g}" if self._zero else ""
            self.words = f"the scan's{less}, times {self._factor:.9g}, which is 65535 for the largest"

    def written(self, values: FloatArray) -> NDArray[np.uint16]:
        """Return intensities (N,) as they are written."""
        scaled = (values.astype(np.float64) - self._zero) * self._factor
        return np.asarray(np.rint(np.clip(scaled, 0, 65535)), dtype=np.uint16)
