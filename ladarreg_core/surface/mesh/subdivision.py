"""Triangles divided along their edges: an edge is cut at the same point on both sides, so that no cracks appear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, IntArray


def edge_keys(faces: IntArray, vertices: int) -> NDArray[np.int64]:
    """Return a number for each edge of triangles (F, 3): edge k runs from corner k to corner k + 1, in any direction.

    Args:
        faces: (F, 3).
        vertices: their number.
    """
    keys = np.empty(faces.shape, np.int64)
    for k in range(3):
        first, second = faces[:, k], faces[:, (k + 1) % 3]
        np.multiply(np.minimum(first, second), vertices, out=keys[:, k], dtype=np.int64)
        keys[:, k] += np.maximum(first, second)
    return keys


def distinct(values: IntArray) -> NDArray[np.int64]:
    """Return the different ones of many integers, ascending; by sorting, many times as fast as `np.unique` hashes."""
    ordered = np.sort(values, axis=None)
    first = np.concatenate([ordered[:1] == ordered[:1], ordered[1:] != ordered[:-1]])
    return np.asarray(ordered[first], dtype=np.int64)


def vertices_of(faces: IntArray, vertices: int) -> IntArray:
    """Return the vertices that triangles (F, 3) have, ascending."""
    used = np.zeros(vertices, np.bool_)
    used[faces] = True
    return np.flatnonzero(used)


def edge_ends(keys: IntArray, vertices: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the two vertices of edges (E,), the smaller one first."""
    return np.asarray(keys // vertices), np.asarray(keys % vertices)


def at_any_corner(flags: BoolArray, faces: IntArray) -> BoolArray:
    """Return whether a flag (N,) of the vertices holds at a corner of triangles (F, 3); faster than `any` over rows."""
    return np.asarray(flags[faces[:, 0]] | flags[faces[:, 1]] | flags[faces[:, 2]])


def at_all_corners(flags: BoolArray, faces: IntArray) -> BoolArray:
    """Return whether a flag (N,) of the vertices holds at all corners of triangles (F, 3)."""
    return np.asarray(flags[faces[:, 0]] & flags[faces[:, 1]] & flags[faces[:, 2]])


def with_edge_of(faces: IntArray, cut: IntArray, vertices: int) -> IntArray:
    """Return which triangles (F, 3) may have one of the edges, given by their keys: two corners are ends of some."""
    is_end = np.zeros(vertices, np.int8)
    for ends in edge_ends(cut, vertices):
        is_end[ends] = 1
    return np.flatnonzero(is_end[faces[:, 0]] + is_end[faces[:, 1]] + is_end[faces[:, 2]] >= 2)


def cut_edges(faces: IntArray, cut: IntArray, vertices: int) -> tuple[IntArray, IntArray, BoolArray]:
    """Divide triangles at new vertices on their edges, into two, three or four.

    Args:
        faces: (F, 3).
        cut: (E,) keys of the edges to cut, ascending; edge e gets the vertex `vertices + e`.
        vertices: number of vertices before.

    Returns:
        faces (G, 3) int32, of the same orientation; the triangle that each was a part of, (G,); and whether it was
        divided (G,) bool.
    """
    if not len(cut):
        return faces, np.arange(len(faces)), np.zeros(len(faces), np.bool_)
    near = with_edge_of(faces, cut, vertices)
    keys = edge_keys(faces.take(near, axis=0), vertices)
    place = np.minimum(np.searchsorted(cut, keys), len(cut) - 1)
    is_cut = cut[place] == keys
    middle = (place + vertices).astype(np.int32)
    cuts = is_cut[:, 0].view(np.int8) + is_cut[:, 1].view(np.int8) + is_cut[:, 2].view(np.int8)
    count = np.zeros(len(faces), np.int8)
    count[near] = cuts
    whole = np.flatnonzero(count == 0)
    parts: list[IntArray] = [faces.take(whole, axis=0)]
    parents: list[IntArray] = [whole]

    def turned(rows: IntArray, first: IntArray) -> list[IntArray]:
        """Return corners a b c and the vertices on ab, bc, ca of rows of `near`, beginning with corner `first`."""
        at = [(first + k) % 3 for k in range(3)]
        return [*(faces[near[rows], k] for k in at), *(middle[rows, k] for k in at)]

    def add(rows: IntArray, *triangles: tuple[IntArray, IntArray, IntArray]) -> None:
        for corners in triangles:
            parts.append(np.stack(corners, axis=-1))
            parents.append(near[rows])

    rows = np.flatnonzero(cuts == 1)
    a, b, c, ab, _, _ = turned(rows, np.argmax(is_cut[rows], axis=1))
    add(rows, (a, ab, c), (ab, b, c))
    rows = np.flatnonzero(cuts == 2)
    # Begin with the corner between the two edges that are cut: the edge opposite to it is whole.
    a, b, c, ab, _, ca = turned(rows, (np.argmin(is_cut[rows], axis=1) + 2) % 3)
    add(rows, (a, ab, ca), (ab, b, c), (ab, c, ca))
    rows = np.flatnonzero(cuts == 3)
    a, b, c, ab, bc, ca = turned(rows, np.zeros(len(rows), np.int64))
    add(rows, (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    parent = np.concatenate(parents)
    return np.concatenate(parts).astype(np.int32, copy=False), parent, count.take(parent) > 0
