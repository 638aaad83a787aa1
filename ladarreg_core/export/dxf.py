"""Drawings as DXF R12 in ASCII: points, polylines and texts, which every CAD program since 1992 reads.

R12 needs neither handles nor classes, so that a drawing is a list of tags: a line with a number, a line with its value.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.storage.atomic_write import write_bytes

_NOT_IN_LAYERS = re.compile(r"[^A-Z0-9_$-]+")
_LONGEST_LAYER, _LONGEST_TEXT = 31, 250
_COLORS = (7, 1, 3, 5, 6, 4, 2)  # of layers, in turn


@dataclass(frozen=True, slots=True, eq=False)
class DxfEntity:
    """A point, polyline or text of a drawing."""

    points: FloatArray
    """(N, 3) m: one of a point or a text, two or more of a polyline."""
    layer: str
    """Name of its layer; characters that R12 does not know become underscores."""
    closed: bool = False
    """Whether the polyline returns to its first point."""
    text: str = ""
    """What is written at its only point; empty: a point or polyline."""
    height: float = 0.05
    """Of the text, m."""


def write_dxf(path: str | Path, entities: Sequence[DxfEntity], *, comment: str = "") -> None:
    """Write a drawing; its unit is the metre.

    Args:
        path: the file.
        entities: what is drawn; coordinates must be finite.
        comment: a line at its top, such as the frame of its coordinates.

    Raises:
        ExportError: if the file cannot be written.

    Source: AutoCAD R12 DXF reference (AC1009).
    """
    write_bytes(path, ("\n".join(_tags(entities, comment)) + "\n").encode("ascii"))


def _tags(entities: Sequence[DxfEntity], comment: str) -> Iterator[str]:
    for line in ("ladarreg; metres", comment):
        if line:
            yield from ("999", _ascii(line))
    every = np.concatenate([one.points for one in entities] or [np.zeros((1, 3))])
    yield from _pairs((0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009"))
    for name, corner in (("$EXTMIN", every.min(axis=0)), ("$EXTMAX", every.max(axis=0))):
        yield from _pairs((9, name), *zip((10, 20, 30), corner.tolist(), strict=True))
    yield from _pairs((0, "ENDSEC"), (0, "SECTION"), (2, "TABLES"))
    layers = list(dict.fromkeys(_layer(one.layer) for one in entities))
    yield from _pairs((0, "TABLE"), (2, "LTYPE"), (70, 1), (0, "LTYPE"), (2, "CONTINUOUS"), (70, 64))
    yield from _pairs((3, "Solid line"), (72, 65), (73, 0), (40, 0.0), (0, "ENDTAB"))
    yield from _pairs((0, "TABLE"), (2, "LAYER"), (70, len(layers)))
    for number, layer in enumerate(layers):
        color = _COLORS[number % len(_COLORS)]
        yield from _pairs((0, "LAYER"), (2, layer), (70, 0), (62, color), (6, "CONTINUOUS"))
    yield from _pairs((0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES"))
    for one in entities:
        yield from _entity(one)
    yield from _pairs((0, "ENDSEC"), (0, "EOF"))


def _entity(one: DxfEntity) -> Iterator[str]:
    layer, rows = _layer(one.layer), one.points.tolist()
    if one.text:
        yield from _pairs((0, "TEXT"), (8, layer), *_place(rows[0]), (40, one.height), (1, _ascii(one.text)))
    elif len(rows) == 1:
        yield from _pairs((0, "POINT"), (8, layer), *_place(rows[0]))
    else:
        yield from _pairs((0, "POLYLINE"), (8, layer), (66, 1), *_place([0.0, 0.0, 0.0]), (70, 8 | int(one.closed)))
        for row in rows:
            yield from _pairs((0, "VERTEX"), (8, layer), *_place(row), (70, 32))
        yield from _pairs((0, "SEQEND"), (8, layer))


def _place(row: Sequence[float]) -> list[tuple[int, float]]:
    return list(zip((10, 20, 30), row, strict=True))


def _pairs(*pairs: tuple[int, object]) -> Iterator[str]:
    for code, value in pairs:
        yield str(code)
        yield f"{value:.6f}" if isinstance(value, float) else str(value)


def _layer(name: str) -> str:
    return _NOT_IN_LAYERS.sub("_", name.upper())[:_LONGEST_LAYER] or "0"


def _ascii(text: str) -> str:
    line = " ".join(text.split())[:_LONGEST_TEXT]
    return "".join(c if 32 <= ord(c) < 127 else f"\\U+{min(ord(c), 0xFFFF):04X}" for c in line)
