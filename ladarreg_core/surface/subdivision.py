"""Triangles divided along their edges: an edge is cut at the same point on both sides, so that no cracks appear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, IntArray


def edge_keys(faces: IntArray, vertices: int) -> NDArray[np.int64]:
    """Return a number for each edge of triangles (F, 3): edge k runs from corner k to corner k + 1, in any direction.

    Args:
        faces: (F, 3).
        vertices: their number.
    """
    first, second = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    return np.asarray(np.minimum(first, second) * vertices + np.maximum(first, second))


def edge_ends(keys: IntArray, vertices: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the two vertices of edges (E,), the smaller one first."""
    return np.asarray(keys // vertices), np.asarray(keys % vertices)


def cut_edges(faces: IntArray, keys: IntArray, cut: IntArray, vertices: int) -> tuple[IntArray, IntArray, BoolArray]:
    """Divide triangles at new vertices on their edges, into two, three or four.

    Args:
        faces: (F, 3).
        keys: (F, 3) their `edge_keys`.
        cut: (E,) keys of the edges to cut, ascending; edge e gets the vertex `vertices + e`.
        vertices: number of vertices before.

    Returns:
        faces (G, 3) int32, of the same orientation; the triangle that each was a part of, (G,); and whether it was
        divided (G,) bool.
    """
    if not len(cut):
        return faces, np.arange(len(faces)), np.zeros(len(faces), np.bool_)
    place = np.minimum(np.searchsorted(cut, keys), len(cut) - 1)
    is_cut = cut[place] == keys
    count = is_cut.sum(axis=1)
    middle = (place + vertices).astype(np.int32)
    whole = np.flatnonzero(count == 0)
    parts: list[IntArray] = [faces[whole]]
    parents: list[IntArray] = [whole]

    def turned(rows: IntArray, first: IntArray) -> list[IntArray]:
        """Return corners a b c and the vertices on ab, bc, ca, beginning with corner `first`."""
        at = [((first + k) % 3)[:, None] for k in range(3)]
        return [
            *(np.take_along_axis(faces[rows], k, axis=1)[:, 0] for k in at),
            *(np.take_along_axis(middle[rows], k, axis=1)[:, 0] for k in at),
        ]

    def add(rows: IntArray, *triangles: tuple[IntArray, IntArray, IntArray]) -> None:
        for corners in triangles:
            parts.append(np.stack(corners, axis=-1))
            parents.append(rows)

    rows = np.flatnonzero(count == 1)
    a, b, c, ab, _, _ = turned(rows, np.argmax(is_cut[rows], axis=1))
    add(rows, (a, ab, c), (ab, b, c))
    rows = np.flatnonzero(count == 2)
    # Begin with the corner between the two edges that are cut: the edge opposite to it is whole.
    a, b, c, ab, _, ca = turned(rows, (np.argmin(is_cut[rows], axis=1) + 2) % 3)
    add(rows, (a, ab, ca), (ab, b, c), (ab, c, ca))
    rows = np.flatnonzero(count == 3)
    a, b, c, ab, bc, ca = turned(rows, np.zeros(len(rows), np.int64))
    add(rows, (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    parent = np.concatenate(parents)
    return np.concatenate(parts).astype(np.int32), parent, count[parent] > 0
