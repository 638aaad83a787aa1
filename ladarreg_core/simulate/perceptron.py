"""A raw file as scanners like the Perceptron P5000 write them, with the descriptor that makes it readable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ladarreg_core.formats.parsing.json_file import write_json
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.case import SimulatedCase
from ladarreg_core.simulate.ladar import LADAR, Ladar

_ROWS = _COLUMNS = 512
_DR_M = 0.0020236
P5000: Ladar = replace(
    LADAR,
    geometry=AzimuthElevation(_ROWS, _COLUMNS, np.radians(51.65 / _COLUMNS), np.radians(36.73 / _ROWS)),
    r0_m=830.3 * _DR_M,
    dr_m=_DR_M,
)
"""Field of view, standoff and count of the scanner, its mirrors taken for a single centre.

Source: readers of the range image data base of USF and ORNL, whose unit is taken for the centimetre.
"""
_MASK, _SHIFT = 4095, 12
_HEADER_LINES = 10
_AFTER_HEADER = b"\r\n"


def perceptron_files(case: SimulatedCase) -> list[tuple[str, Callable[[Path], None]]]:
    """Return the scan of a case as `scan.raw` and its descriptor `scan.json`, each with a function that writes it.

    `scan.raw` has ten lines of text, two more bytes, and for each cell a big-endian word of 32 bits: in bits 0 to 11
    the range count, in bits 12 to 23 the reflectance.
    """
    header = _header(case.counts.shape)
    words = case.counts.astype(np.uint32) | np.minimum(case.intensity, _MASK).astype(np.uint32) << _SHIFT
    geometry = case.ladar.geometry
    fields = {
        "kind": "counts", "file": "scan.raw", "rows": geometry.rows, "columns": geometry.columns, "dtype": ">u4",
        "header_bytes": len(header), "count_mask": _MASK, "intensity_mask": _MASK, "intensity_shift": _SHIFT,
        "r0_m": case.ladar.r0_m, "dr_m": case.ladar.dr_m, "d_azimuth_rad": geometry.d_azimuth_rad,
        "d_elevation_rad": geometry.d_elevation_rad,
    }  # fmt: skip
    return [
        ("scan.raw", lambda path: _write(path, header + words.astype(">u4").tobytes())),
        ("scan.json", lambda path: write_json(path, fields)),
    ]


def _header(shape: tuple[int, ...]) -> bytes:
    lines = [f"rows : {shape[0]}", f"columns : {shape[1]}", "made_by : ladarreg simulate"]
    lines += [f"unused_{number} : 0" for number in range(_HEADER_LINES - len(lines))]
    return "".join(f"{line}\n" for line in lines).encode() + _AFTER_HEADER


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
