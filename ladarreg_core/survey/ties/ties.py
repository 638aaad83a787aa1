"""Ties: places that several photographs show, put together from pairwise matches and laid on the laser's surface."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.photo_points import xyz_of_photo
from ladarreg_core.survey.least_squares.problem import Matrix, Ties
from ladarreg_core.survey.ties.features import Features

PairMatches = Mapping[tuple[int, int], IntArray]
"""Matches (M, 2) of features of two photographs, by their indices i < j."""
DrawnEnds = Mapping[tuple[int, int], tuple[int, float]]
"""Of the ties that were drawn by hand the number of the first one of the track, and the pixel sigma, by their ends:
(photograph, feature)."""
_SURFACE_SIGMA_M = 0.0025  # of the smoothed surface beside its range noise: texture is not exactly where the laser hit
MIN_PARALLAX_RAD = float(np.radians(2.0))
"""Angle between the rays of a tie that lies on no surface, or between the planes of a line."""
FAR_PX = 60.0
"""Of a photograph 1000 px wide: what lies farther from where the poses put it is a wrong match."""
_PAIR_LIMIT = 400  # matches of a pair that are used; more of them say nothing new


@dataclass(frozen=True, slots=True, eq=False)
class LaserPoints:
    """Places of the laser's surface under features of a photograph."""

    xyz: NDArray[np.float32]
    """(N, 3) scanner frame, m; NaN where there is none."""
    normal: NDArray[np.float32]
    """(N, 3)."""
    sigma_m: float
    """Standard deviation across the surface."""


def laser_points(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid, uv: FloatArray) -> LaserPoints:
    """Return the places of a scan's surface that pixels (N, 2) of a photograph show."""
    pose = describe_pose(
        camera_from_scanner, Matches.none(), np.zeros(0, np.bool_), camera,
        sigma_px=STATED_SIGMA_PX, sigma_range_m=STATED_SIGMA_RANGE_M, covariance=np.full((6, 6), np.nan),
    )  # fmt: skip
    found = xyz_of_photo(scan, replace(pose, evidence="given"), at=uv, normals=True)
    return LaserPoints(found.xyz.astype(np.float32), found.normals, _SURFACE_SIGMA_M)


def with_drawn(
    features: Sequence[Features], matches: PairMatches, drawn: Sequence[tuple[tuple[int, int], FloatArray, float]]
) -> tuple[list[Features], dict[tuple[int, int], IntArray], dict[tuple[int, int], tuple[int, float]]]:
    """Return features and matches with those that were drawn by hand: each end is a further feature of its photograph.

    Ties of one track (`tracks_of`) share the feature at their common end, so that their matches are connected.

    Args:
        features: of each photograph.
        matches: of pairs of them.
        drawn: of each tie its two photographs, its two pixels (2, 2) and their standard deviation, px.

    Returns:
        the features, the matches, and which features are the ends of what was drawn (`DrawnEnds`).
    """
    more: dict[int, list[FloatArray]] = {}
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    ends: dict[tuple[int, int], tuple[int, float]] = {}
    known_ends: dict[tuple[int, int], tuple[int, int]] = {}
    firsts = tracks_of([
        [(photo, (float(u), float(v))) for photo, (u, v) in zip(photos, uv, strict=True)] for photos, uv, _ in drawn
    ])  # fmt: skip
    for first, (photos, uv, sigma_px) in zip(firsts, drawn, strict=True):
        nodes = []
        for photo, place in zip(photos, uv, strict=True):
            node = known_ends.get((first, photo))
            if node is None:
                own = more.setdefault(photo, [])
                node = known_ends[first, photo] = photo, len(features[photo]) + len(own)
                own.append(place)
                ends[node] = first, sigma_px
            nodes.append(node)
        (i, a), (j, b) = sorted(nodes)
        pairs.setdefault((i, j), []).append((a, b))
    extended = [one.extended(np.array(more[k])) if k in more else one for k, one in enumerate(features)]
    joined = dict(matches)
    for pair, rows in pairs.items():
        known = joined.get(pair)
        joined[pair] = np.array(rows) if known is None else np.concatenate([known, np.array(rows)])
    return extended, joined, ends


def tracks_of(ends: Sequence[Sequence[tuple[Hashable, tuple[float, float]]]]) -> list[int]:
    """Return of each tie that was drawn the first one of its track: one place that more than two photographs show.

    Ties that share an end, at the very same pixel of a photograph, are one track. Where that would give it two places
    in one photograph, one of the ties is wrong and nobody knows which: each is a track of its own.

    Args:
        ends: of each tie its photographs, and the pixel in each.
    """
    first = list(range(len(ends)))

    def root(number: int) -> int:
        while first[number] != number:
            number = first[number]
        return number

    seen: dict[tuple[Hashable, tuple[float, float]], int] = {}
    for number, both in enumerate(ends):
        for end in both:
            one, other = sorted((root(number), root(seen.setdefault(end, number))))
            first[other] = one
    roots = [root(number) for number in range(len(ends))]
    places: dict[int, set[tuple[Hashable, tuple[float, float]]]] = {}
    for number, both in zip(roots, ends, strict=True):
        places.setdefault(number, set()).update(both)
    sound = {number for number, those in places.items() if len({photo for photo, _ in those}) == len(those)}
    return [one if one in sound else number for number, one in enumerate(roots)]


def thinned(matches: IntArray, uv: FloatArray, limit: int = _PAIR_LIMIT, *, keep: BoolArray | None = None) -> IntArray:
    """Return matches (M, 2) thinned to `limit`, evenly over the first photograph: the order of `uv` (N, 2) decides.

    A cell of a grid gives one after the other, so that crowded places give no more than others.

    Args:
        matches: the matches.
        uv: features of the first photograph.
        limit: how many are left.
        keep: (M,) which stay besides these; None: none.
    """
    if keep is not None and keep.any():
        return np.concatenate([thinned(matches[~keep], uv, limit), matches[keep]])
    if len(matches) <= limit:
        return matches
    at = uv[matches[:, 0]]
    low, extent = at.min(axis=0), np.maximum(np.ptp(at, axis=0), 1e-6)
    cells = np.minimum(((at - low) / extent * 16).astype(int), 15) @ np.array([1, 16])
    order = np.argsort(cells, kind="stable")
    first = np.r_[0, np.flatnonzero(np.diff(cells[order])) + 1]
    turn = np.arange(len(order)) - np.repeat(first, np.diff(np.r_[first, len(order)]))
    kept = order[np.argsort(turn, kind="stable")[:limit]]
    return matches[np.sort(kept)]


def tracks(pairs: PairMatches) -> list[list[tuple[int, int]]]:
    """Return the connected matches as lists of (photograph, feature); those with two features in one are left out."""
    parent: dict[tuple[int, int], tuple[int, int]] = {}

    def root(node: tuple[int, int]) -> tuple[int, int]:
        parent.setdefault(node, node)
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for (i, j), matches in sorted(pairs.items()):
        for a, b in matches.tolist():
            one, other = root((i, a)), root((j, b))
            if one != other:
                parent[max(one, other)] = min(one, other)
    members: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for node in sorted(parent):
        members.setdefault(root(node), []).append(node)
    return [group for group in members.values() if len({photo for photo, _ in group}) == len(group)]


def tie_points(
    pairs: PairMatches,
    uv: Sequence[FloatArray],
    poses: Mapping[int, Rigid],
    cameras: Mapping[int, CameraModel],
    on_laser: Mapping[tuple[int, int], LaserPoints],
    scan_poses: Sequence[Rigid],
    *,
    body_of_scan: Sequence[int],
    body_of_photo: Mapping[int, int],
    drawn: DrawnEnds = MappingProxyType({}),
) -> Ties:
    """Return the ties of photographs that have poses.

    A tie's point starts where the laser's surface was met, from whichever photograph shows it best; where there is no
    surface, as behind glass or at a depth edge, it is triangulated. Those that lie far from where the poses put them,
    or whose rays are nearly parallel and meet no surface, are left out.

    Args:
        pairs: matches of pairs of photographs.
        uv: pixels (N, 2) of the features of each photograph.
        poses: `camera_from_world` of the photographs.
        cameras: theirs.
        on_laser: places on the surface of scan s under all features of photograph p, by (p, s).
        scan_poses: `scanner_from_world` of each scan.
        body_of_scan: index of each scan in the problem.
        body_of_photo: index of each photograph.
        drawn: which features are ends of ties that were drawn by hand.
    """
    usable = {}
    for (i, j), matches in pairs.items():
        if i in poses and j in poses:
            by_hand = np.array([(i, a) in drawn for a in matches[:, 0].tolist()], np.bool_)
            usable[i, j] = thinned(matches, uv[i], keep=by_hand)
    groups = tracks(usable)
    out: dict[str, list[object]] = {
        name: [] for name in ("points", "drawn", "point", "photo", "uv", "px", "on", "scan", "xyz", "n", "s")
    }
    for group in groups:
        candidates = _places(group, on_laser, scan_poses)
        point, off = _best(candidates, group, uv, poses, cameras)
        if point is None:
            point, off = _triangulated(group, uv, poses, cameras)
        if point is None:
            continue
        number = len(out["points"])
        allowed = np.array([FAR_PX * cameras[photo].width / 1000 for photo, _ in group])
        near = off <= allowed
        if near.sum() < 2:
            continue
        out["points"].append(point)
        out["drawn"].append(drawn.get(group[0], (-1, np.nan))[0])
        for (photo, feature), kept in zip(group, near.tolist(), strict=True):
            if kept:
                out["point"].append(number)
                out["photo"].append(body_of_photo[photo])
                out["uv"].append(uv[photo][feature])
                out["px"].append(drawn.get((photo, feature), (-1, np.nan))[1])
        for scan, place in _one_of_each_scan(candidates, point).items():
            out["on"].append(number)
            out["scan"].append(body_of_scan[scan])
            out["xyz"].append(place[0])
            out["n"].append(place[1])
            out["s"].append(place[2])

    def array(name: str, width: int) -> Matrix:
        return np.array(out[name], np.float64).reshape(-1, width) if width > 1 else np.array(out[name], np.float64)

    def indices(name: str) -> IntArray:
        return np.array(out[name], np.int64)

    return Ties(
        array("points", 3), indices("point"), indices("photo"), array("uv", 2), indices("on"), indices("scan"),
        array("xyz", 3), array("n", 3), array("s", 1), array("px", 1), indices("drawn"),
    )  # fmt: skip


_Place = tuple[NDArray[np.float64], NDArray[np.float64], float, NDArray[np.float64], int]
"""xyz and normal in the scanner's frame, sigma, the point in the world, and the scan."""


def _places(
    group: Sequence[tuple[int, int]], on_laser: Mapping[tuple[int, int], LaserPoints], scan_poses: Sequence[Rigid]
) -> list[_Place]:
    """Return where the rays of a tie meet each scan's surface; nowhere if fewer than half of them meet it.

    At a depth edge those that do meet it may show another surface than the one that was matched.
    """
    found: list[_Place] = []
    for scan, pose in enumerate(scan_poses):
        met: list[_Place] = []
        for photo, feature in group:
            laser = on_laser.get((photo, scan))
            if laser is None or not np.isfinite(laser.xyz[feature]).all():
                continue
            xyz, normal = laser.xyz[feature].astype(np.float64), laser.normal[feature].astype(np.float64)
            if np.isfinite(normal).all():
                met.append((xyz, normal, laser.sigma_m, pose.inverse @ xyz, scan))
        if 2 * len(met) >= len(group):
            found += met
    return found


def _off(
    point: FloatArray, group: Sequence[tuple[int, int]], uv: Sequence[FloatArray], poses: Mapping[int, Rigid],
    cameras: Mapping[int, CameraModel],
) -> FloatArray:  # fmt: skip
    """Return how far from its features a point lies in each photograph, px; infinite behind a camera."""
    off = []
    for photo, feature in group:
        there = cameras[photo].project((poses[photo] @ point)[None])
        away = cameras[photo].difference(uv[photo][feature][None].astype(np.float64), there)
        length = float(np.linalg.norm(away))
        off.append(length if np.isfinite(length) else np.inf)
    return np.array(off)


def _best(
    candidates: Sequence[_Place], group: Sequence[tuple[int, int]], uv: Sequence[FloatArray],
    poses: Mapping[int, Rigid], cameras: Mapping[int, CameraModel],
) -> tuple[FloatArray | None, FloatArray]:  # fmt: skip
    """Return the place of the surface that lies nearest to the features in all photographs."""
    best, at = None, np.full(len(group), np.inf)
    for place in candidates:
        off = _off(place[3], group, uv, poses, cameras)
        if np.median(off) < np.median(at):
            best, at = place[3], off
    return best, at


def _triangulated(
    group: Sequence[tuple[int, int]], uv: Sequence[FloatArray], poses: Mapping[int, Rigid],
    cameras: Mapping[int, CameraModel],
) -> tuple[FloatArray | None, FloatArray]:  # fmt: skip
    """Return the point nearest to all rays; None: they are nearly parallel."""
    centres = np.array([poses[photo].centre for photo, _ in group])
    rays = np.array(
        [poses[photo].rotation.T @ cameras[photo].unproject(uv[photo][feature][None].astype(np.float64))[0]
         for photo, feature in group]
    )  # fmt: skip
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    cosine = np.clip(rays @ rays.T, -1, 1)
    if not np.isfinite(rays).all() or np.arccos(cosine.min()) < MIN_PARALLAX_RAD:
        return None, np.zeros(0)
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    return point, _off(point, group, uv, poses, cameras)


def _one_of_each_scan(candidates: Sequence[_Place], point: FloatArray) -> dict[int, _Place]:
    """Return the place of each scan that is nearest to a point."""
    found: dict[int, _Place] = {}
    for place in candidates:
        before = found.get(place[4])
        if before is None or np.linalg.norm(place[3] - point) < np.linalg.norm(before[3] - point):
            found[place[4]] = place
    return found


def spread(uv: FloatArray, inliers: BoolArray, cell_px: float = 40.0) -> int:
    """Return in how many cells of a photograph inliers lie."""
    return len(np.unique(np.floor(uv[inliers] / cell_px).astype(np.int64), axis=0))
