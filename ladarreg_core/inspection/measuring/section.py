"""Sections: the lines in which a plane cuts the surface of a scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.inspection.measuring.developable import Plane
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import scan_mesh

_LARGEST_CELLS = 4_000_000


def section(scan: Scan, plane: Plane, *, least_m: float = 0.05) -> list[NDArray[np.float64]]:
    """Return the polylines in which a plane cuts the surface of a scan.

    Args:
        scan: the scan; it is open at depth edges, and so are the lines.
        plane: the plane.
        least_m: shorter lines are left out, m.

    Returns:
        Polylines (N, 3), scanner frame, m, the longest first; a closed one ends where it begins.
    """
    if scan.ranges.size > _LARGEST_CELLS:
        scan, _ = scan.thinned(_LARGEST_CELLS)
    mesh = scan_mesh(scan)
    vertices = mesh.vertices.astype(np.float64)
    height = plane.flattened(vertices)[:, 2]
    height[height == 0] = 1e-12  # a corner on the plane lies on one side of it
    above = height > 0
    count = above[mesh.faces].sum(axis=1)
    faces = mesh.faces[(count == 1) | (count == 2)]
    if not len(faces):
        return []
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)  # (F, 3, 2)
    crossed = above[sides[..., 0]] != above[sides[..., 1]]
    pairs = sides[crossed]  # two a triangle, in order
    keys, place = np.unique(pairs[:, 0].astype(np.int64) * len(vertices) + pairs[:, 1], return_inverse=True)
    a, b = keys // len(vertices), keys % len(vertices)
    share = (height[a] / (height[a] - height[b]))[:, None]
    points = vertices[a] + share * (vertices[b] - vertices[a])
    lines = [points[chain] for chain in _chains(place.reshape(-1, 2), len(points))]
    lengths = [float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines]
    order = np.argsort([-length for length in lengths], kind="stable")
    return [lines[k] for k in order if lengths[k] >= least_m]


def _chains(links: IntArray, count: int) -> list[list[int]]:
    """Return the points of each chain, in order, of links (L, 2) between points with at most two links each."""
    neighbors: list[list[int]] = [[] for _ in range(count)]
    for a, b in links.tolist():
        neighbors[a].append(b)
        neighbors[b].append(a)
    left = [True] * count
    chains = []
    ends = [k for k, beside in enumerate(neighbors) if len(beside) == 1]
    for start in [*ends, *range(count)]:  # rings have no ends and remain
        if not left[start]:
            continue
        chain, here = [start], start
        left[start] = False
        while (following := next((k for k in neighbors[here] if left[k]), None)) is not None:
            left[following] = False
            chain.append(following)
            here = following
        if len(chain) > 2 and start in neighbors[here]:
            chain.append(start)
        if len(chain) > 1:
            chains.append(chain)
    return chains


def simplified(line: FloatArray, tolerance_m: float) -> NDArray[np.float64]:
    """Return the points (M, 3) of a polyline (N, 3) from which none of the others is farther than a tolerance, m.

    Source: D. Douglas and T. Peucker, Algorithms for the reduction of the number of points, 1973.
    """
    kept = np.zeros(len(line), np.bool_)
    kept[[0, -1]] = True
    spans = [(0, len(line) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        inner, along = line[first + 1 : last] - line[first], line[last] - line[first]
        length = float(along @ along)
        share = np.clip(inner @ along / length, 0, 1)[:, None] if length > 0 else 0.0
        off = np.linalg.norm(inner - share * along, axis=1)
        farthest = int(off.argmax())
        if off[farthest] > tolerance_m:
            middle = first + 1 + farthest
            kept[middle] = True
            spans += [(first, middle), (middle, last)]
    return np.asarray(line[kept], np.float64)
