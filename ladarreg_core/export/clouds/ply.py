"""Export of the coloured cloud as binary PLY."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.export.clouds.cloud_part import SCANNER_FRAME, CloudPart, cloud_rows
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import write_chunks
from ladarreg_core.surface.texture.best_photo import CellColors
from ladarreg_core.surface.texture.registered_texture import Label, RegisteredTexture

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
_FROM_PHOTOS = np.dtype([("photo_id", "<u2"), ("sigma_px", "<f4")])
_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort"}


def write_ply(
    path: str | Path,
    scan: Scan,
    texture: RegisteredTexture | CellColors,
    *,
    frame: OutputFrame = SCANNER_FRAME,
    mark: str = "",
    comments: Sequence[str] = (),
    report: Report | None = None,
) -> None:
    """Write every return of a scan with its colour, intensity and label; see `ply_bytes`.

    Colours from several photographs add `photo_id` (from 1; 0: none) and `sigma_px`. A mark, of a pose that was not
    verified, and further sentences are written as comments. `report` receives the progress.

    Raises:
        ExportError: if the file cannot be written.
    """
    sentences = [*([f"pose: {mark}"] if mark else []), *comments]
    write_chunks(path, _chunks([CloudPart(scan, texture, frame)], sentences, report))


def write_layered_ply(
    path: str | Path, parts: Sequence[CloudPart], *, comments: Sequence[str] = (), report: Report | None = None
) -> None:
    """Write the returns of several scans in one frame as one cloud, with their layers as properties.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_chunks(path, _chunks(parts, comments, report))


def ply_bytes(scan: Scan, texture: RegisteredTexture, *, frame: OutputFrame = SCANNER_FRAME) -> bytes:
    """Return the returns of a scan as binary little-endian PLY, row by row.

    Cells that the camera does not see have their dimmed laser intensity as colour. Coordinates are in single precision,
    which most viewers have; a frame with large coordinates states its offset in a comment.

    Raises:
        ShapeError: if the texture is not on the scan's grid.
    """
    return b"".join(_chunks([CloudPart(scan, texture, frame)]))


def _chunks(parts: Sequence[CloudPart], comments: Sequence[str] = (), report: Report | None = None) -> Iterator[bytes]:
    """Yield the header, then the vertices of some rows at a time."""
    for part in parts:
        if part.texture.labels.shape != part.scan.shape:
            raise ShapeError(
                f"the texture has {part.texture.labels.shape} cells, the scan {part.scan.shape}; they must agree"
            )
    first = parts[0]
    count = sum(int(np.count_nonzero(part.scan.valid)) for part in parts)
    several = isinstance(first.texture, CellColors)
    layers = [(name, one.values.dtype.str) for name, one in first.layers.items()]
    layout = np.dtype([*_VERTEX.descr, *(_FROM_PHOTOS.descr if several else []), *layers])
    codes = ", ".join(f"{label.value} {label.name.lower().replace('_', ' ')}" for label in Label)
    offset = first.frame.offset_m
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment ladarreg: {first.frame.sentence}",
        *([f"comment offset_m {' '.join(f'{value:.0f}' for value in offset)}"] if any(offset) else []),
        *(f"comment {_ascii(comment)}" for comment in comments),
        f"comment label: {codes}",
        *(f"comment {name}: {_ascii(one.meaning)}" for name, one in first.layers.items()),
        f"element vertex {count}",
        *(f"property {_PLY_TYPES[layout[name].str]} {name}" for name in layout.names or ()),
        "end_header\n",
    ]
    yield "\n".join(header).encode("ascii")
    done = 0
    for part in parts:
        for vertices in _vertices(part, layout):
            yield vertices.tobytes()
            done += len(vertices)
            if report is not None:
                report(Progress(done, count, "writing the cloud"))


def _vertices(part: CloudPart, layout: np.dtype[Any]) -> Iterator[NDArray[Any]]:
    """Yield the vertices (N,) of some rows at a time."""
    for rows in cloud_rows(part):
        vertices = np.zeros(len(rows.points), dtype=layout)
        for k in range(3):
            vertices["xyz"[k]] = rows.points[:, k]
            vertices[("red", "green", "blue")[k]] = rows.color[:, k]
        vertices["intensity"], vertices["label"] = rows.intensity, rows.labels
        if rows.photo is not None:
            vertices["photo_id"] = rows.photo + np.uint16(1)  # that of none becomes 0
            vertices["sigma_px"] = rows.sigma_px
        for name, values in rows.layers.items():
            vertices[name] = values
        yield vertices


def _ascii(text: str) -> str:
    """Return a text on one line of ASCII, as a PLY's header must be."""
    return " ".join(text.encode("ascii", "replace").decode().split())
