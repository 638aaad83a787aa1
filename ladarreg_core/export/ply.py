"""Export of the coloured cloud as binary PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ladarreg_core.errors import ShapeError
from ladarreg_core.export.atomic_write import write_bytes
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture import Label, RegisteredTexture, model_picture

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
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: str | Path, scan: Scan, texture: RegisteredTexture, *, frame: OutputFrame = SCANNER_FRAME) -> None:
    """Write every return of a scan with its colour, intensity and label; see `ply_bytes`.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_bytes(path, ply_bytes(scan, texture, frame=frame))


def ply_bytes(scan: Scan, texture: RegisteredTexture, *, frame: OutputFrame = SCANNER_FRAME) -> bytes:
    """Return the returns of a scan as binary little-endian PLY, row by row.

    Cells that the camera does not see have their dimmed laser intensity as colour. Coordinates are in single precision,
    which most viewers have; a frame with large coordinates states its offset in a comment.

    Raises:
        ShapeError: if the texture is not on the scan's grid.
    """
    if texture.labels.shape != scan.shape:
        raise ShapeError(f"the texture has {texture.labels.shape} cells, the scan {scan.shape}; they must agree")
    valid = scan.valid
    vertices = np.zeros(int(np.count_nonzero(valid)), dtype=_VERTEX)
    points, rgb = frame.place(scan.points[valid]), model_picture(scan, texture)[valid]
    for k in range(3):
        vertices["xyz"[k]] = points[:, k]
        vertices[("red", "green", "blue")[k]] = rgb[:, k]
    vertices["intensity"] = scan.intensity[valid]
    vertices["label"] = texture.labels[valid]
    codes = ", ".join(f"{label.value} {label.name.lower().replace('_', ' ')}" for label in Label)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment ladarreg: {frame.sentence}",
        *([f"comment offset_m {' '.join(f'{value:.0f}' for value in frame.offset_m)}"] if any(frame.offset_m) else []),
        f"comment label: {codes}",
        f"element vertex {len(vertices)}",
        *(f"property {_PLY_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()),
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + vertices.tobytes()
