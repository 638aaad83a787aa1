"""Export of the coloured cloud as binary PLY."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ladarreg_core.errors import ShapeError
from ladarreg_core.export.atomic_write import write_chunks
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture import Label, RegisteredTexture, dimmed_levels, model_rows

_VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("intensity", "<f4"),
        ("label", "u1"),
    ]
)
SCANNER_FRAME = OutputFrame()
_ROWS_AT_ONCE = 128
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(
    path: str | Path, scan: Scan, texture: RegisteredTexture, *, frame: OutputFrame = SCANNER_FRAME, mark: str = ""
) -> None:
    """Write every return of a scan with its colour, intensity and label; see `ply_bytes`.

    A mark, of a pose that was not verified, is written as a comment.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_chunks(path, _chunks(scan, texture, frame, mark))


def ply_bytes(scan: Scan, texture: RegisteredTexture, *, frame: OutputFrame = SCANNER_FRAME) -> bytes:
    """Return the returns of a scan as binary little-endian PLY, row by row.

    Cells that the camera does not see have their dimmed laser intensity as colour. Coordinates are in single precision,
    which most viewers have; a frame with large coordinates states its offset in a comment.

    Raises:
        ShapeError: if the texture is not on the scan's grid.
    """
    return b"".join(_chunks(scan, texture, frame))


def _chunks(scan: Scan, texture: RegisteredTexture, frame: OutputFrame, mark: str = "") -> Iterator[bytes]:
    """Yield the header, then the vertices of some rows at a time."""
    if texture.labels.shape != scan.shape:
        raise ShapeError(f"the texture has {texture.labels.shape} cells, the scan {scan.shape}; they must agree")
    codes = ", ".join(f"{label.value} {label.name.lower().replace('_', ' ')}" for label in Label)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment ladarreg: {frame.sentence}",
        *([f"comment offset_m {' '.join(f'{value:.0f}' for value in frame.offset_m)}"] if any(frame.offset_m) else []),
        *([f"comment pose: {mark}"] if mark else []),
        f"comment label: {codes}",
        f"element vertex {int(np.count_nonzero(scan.valid))}",
        *(f"property {_PLY_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()),
        "end_header\n",
    ]
    yield "\n".join(header).encode("ascii")
    levels = dimmed_levels(scan)
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        valid = scan.valid[rows]
        vertices = np.zeros(int(np.count_nonzero(valid)), dtype=_VERTEX)
        points = frame.place(scan.points_at(rows, slice(None))[valid])
        rgb = model_rows(scan, texture, rows, levels)[valid]
        for k in range(3):
            vertices["xyz"[k]] = points[:, k]
            vertices[("red", "green", "blue")[k]] = rgb[:, k]
        vertices["intensity"] = scan.intensity[rows][valid]
        vertices["label"] = texture.labels[rows][valid]
        yield vertices.tobytes()
