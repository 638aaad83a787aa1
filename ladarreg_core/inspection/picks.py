"""Picks as an operator inspects them: residuals under a pose, predicted counterparts, and what the scan measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lines import along_line, line_on_scan
from ladarreg_core.picks.measure import SAMPLES_PER_LINE, matches_from_picks
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.quality.influence import influence
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import EDGE_FRACTION, measured_ranges
from ladarreg_core.surface.visibility.visible_points import (
    LARGEST_WHOLE_SCAN,
    ScanProjection,
    project_scan,
    projected_tiles,
)

_MAX_CACHED = 4_000  # some kilobytes each
_REACH_PX = 6
_REFINED_CELLS = 1.5
_AROUND = 2
_SD_OF_MEDIAN = 1.4826


@dataclass(frozen=True, slots=True)
class PickResiduals:
    """Residuals of one pick under a pose; of a line, those of its worse end."""

    px: float
    """Length of the pixel residual; NaN where undefined."""
    mm: float
    """Range residual, mm, signed; NaN where undefined."""
    depth_m: float
    """Laser minus stereo depth, m, signed; NaN where undefined."""
    inlier: bool | None
    """Whether the solver used it as an inlier; None: it was not part of the solution."""
    influence_px: float
    """Shift of the photo positions if it were removed, px; NaN where unknown."""
    photo: FloatArray
    """(1 or 2, 2) predicted photo pixels of its scan side; NaN where there are none."""


@dataclass(frozen=True, slots=True, eq=False)
class SampledLine:
    """Rays along a drawn line, with those that have a range marked."""

    rays: FloatArray
    """(K, 3) unit, scanner frame."""
    known: tuple[bool, ...]
    """(K,) whether the scan has a range along the ray."""
    sampled: int
    """Number of rays along which the straight edge was searched."""
    used: int
    """Number of these that lie on the edge; 0: the surface under the line is not straight."""


@dataclass(slots=True, eq=False)
class PickMeasurements:
    """Matches derived from picks, cached per pick, since one pick at a time is edited."""

    scan: Scan
    """The scan."""
    photo: Photo
    """The photo."""
    _cache: dict[tuple[object, ...], tuple[Matches, tuple[str, ...]]] = field(default_factory=dict)

    def of(self, pick: Pick) -> tuple[Matches, tuple[str, ...]]:
        """Return the matches of one pick, on or off, and sentences on any loss of samples."""
        lengths = None if pick.lengths_m is None else pick.lengths_m.tobytes()
        key = (pick.id, pick.scan.tobytes(), pick.photo.tobytes(), pick.kind, pick.weight, lengths, pick.name)
        if key not in self._cache:
            if len(self._cache) >= _MAX_CACHED:
                self._cache.clear()
            self._cache[key] = matches_from_picks(self.scan, [replace(pick, on=True)], camera=self.photo.camera)
        return self._cache[key]

    def joined(self, picks: Sequence[Pick]) -> Matches:
        """Return the matches of all picks."""
        return Matches.joined([m for m in (self.of(pick)[0] for pick in picks) if len(m)])

    def losses(self, picks: Sequence[Pick]) -> tuple[str, ...]:
        """Return sentences on the lost samples of the picks that are on."""
        return tuple(sentence for pick in picks if pick.on for sentence in self.of(pick)[1])


def pick_residuals(
    measurements: PickMeasurements, picks: Sequence[Pick], result: PoseResult
) -> dict[str, PickResiduals]:
    """Compute the residuals of each pick that has a range, whether it is on or off.

    Args:
        measurements: the matches of the picks.
        picks: any picks, on or off.
        result: the pose with the matches from which it was solved.
    """
    matches = measurements.joined(picks)
    if not len(matches):
        return {}
    with np.errstate(all="ignore"):
        described = describe_pose(
            result.camera_from_scanner,
            matches,
            np.ones(len(matches), np.bool_),
            result.camera,
            sigma_px=result.sigma_px,
            sigma_range_m=result.sigma_range_m,
            covariance=result.covariance,
        )
        expected = result.camera.project(result.camera_from_scanner @ matches.points)
    influences, inliers = _influences(result), _inliers(result)
    px = np.linalg.norm(described.residuals_px, axis=1)
    order, mm = np.nan_to_num(px, nan=-1.0).tolist(), (1000 * described.residuals_m).tolist()
    depth_m = described.stereo_depth_error_m.tolist()
    by_pick: dict[str, list[int]] = {}
    for k, name in enumerate(matches.pick_ids):
        by_pick.setdefault(name, []).append(k)
    ends = np.rint(matches.fractions).astype(int).tolist()
    found = {}
    for pick in picks:
        members = by_pick.get(pick.id)
        if not members:
            continue
        worst = max(members, key=order.__getitem__)
        photo = np.full((len(pick.photo), 2), np.nan)
        for k in members:
            photo[ends[k]] = expected[k]
        found[pick.id] = PickResiduals(
            float(px[worst]),
            _largest([mm[k] for k in members]),
            _largest([depth_m[k] for k in members]),
            inliers.get(pick.id),
            influences.get(pick.id, float("nan")),
            photo,
        )
    return found


def suggested_threshold(errors: ArrayLike, agrees: ArrayLike, *, sigmas: float) -> float | None:
    """Return an error above which matches may be disabled, to two figures; None without a finite error.

    It is a multiple of the robust standard deviation about zero, and never rejects a match that agrees with the robust
    estimator: under a pose that rests on wrong matches, too, the errors of right ones may be the larger ones.

    Args:
        errors: (N,) of the enabled matches, in any unit, signed or not; NaN where undefined.
        agrees: (N,) whether a match is an inlier of the robust estimator, as far as that is known.
        sigmas: multiple of the standard deviation.
    """
    sizes = np.abs(np.asarray(errors, dtype=np.float64))
    known = np.isfinite(sizes)
    good = sizes[known & np.asarray(agrees, dtype=np.bool_)]
    trusted = good if len(good) else sizes[known]
    if not len(trusted):
        return None
    usual = float(f"{sigmas * _SD_OF_MEDIAN * np.median(trusted):.2g}")
    largest = float(good.max(initial=0.0))
    rounded_up = float(f"{largest:.2g}")
    if rounded_up < largest:
        rounded_up = float(f"{rounded_up + 10 ** (math.floor(math.log10(largest)) - 1):.2g}")
    return max(usual, rounded_up) or None


def sample_line(scan: Scan, ends: ArrayLike, *, samples: int = SAMPLES_PER_LINE) -> SampledLine:
    """Return the rays along a line drawn on the scan and which of them have a range.

    Args:
        scan: the scan.
        ends: (2, 3) unit rays, scanner frame.
        samples: number of rays.
    """
    ends = np.asarray(ends, dtype=np.float64)
    rays = along_line(ends, np.linspace(0, 1, samples))
    known = np.isfinite(measured_ranges(scan, rays).outline)
    edge = line_on_scan(scan, ends)
    sampled, used = (edge.sampled, edge.used) if edge else (samples, 0)
    return SampledLine(rays, tuple(known.tolist()), sampled, used)


def pick_points(scan: Scan, picks: Sequence[Pick]) -> tuple[FloatArray, list[str], list[bool]]:
    """Return the points (N, 3) m, scanner frame, of the ends of all picks, with pick id and on/off; NaN: no range."""
    rays = [pick.scan for pick in picks]
    ids = [pick.id for pick in picks for _ in range(len(pick.scan))]
    on = [pick.on for pick in picks for _ in range(len(pick.scan))]
    if not rays:
        return np.zeros((0, 3)), ids, on
    directions = np.concatenate(rays)
    ranges = measured_ranges(scan, directions).outline
    stated = [np.full(len(pick.scan), np.nan) if pick.lengths_m is None else pick.lengths_m for pick in picks]
    ranges = np.where(np.isnan(np.concatenate(stated)), ranges, np.concatenate(stated))
    return directions * ranges[:, None], ids, on


@dataclass(frozen=True, slots=True)
class DepthEdge:
    """The two surfaces that meet, as the scanner sees it, beside a ray."""

    near_m: float
    """Range of the nearer one, m."""
    far_m: float
    """Range of the farther one, m."""
    near_ray: FloatArray
    """(3,) unit, scanner frame: towards what is seen of the nearer one."""
    far_ray: FloatArray
    """(3,) of the farther one."""


@dataclass(frozen=True, slots=True)
class Probe:
    """Measurement of the scan along a ray."""

    range_m: float | None
    """Along the ray, m; None without a return, or at a depth edge."""
    intensity: float | None
    """Of the nearest cell, in the sensor's unit; None outside the grid."""
    cell: tuple[float, float] | None
    """Fractional row and column; None outside the grid."""
    edge: DepthEdge | None = None
    """The depth edge within two cells; None without one."""


def probe(scan: Scan, ray: ArrayLike) -> Probe:
    """Return the measurement along a unit ray (3,), scanner frame."""
    direction = np.asarray(ray, dtype=np.float64)[None]
    row, column = (float(v) for v in np.asarray(scan.geometry.cell_of(direction), dtype=np.float64)[0])
    height, width = scan.shape
    if not (-0.5 <= row <= height - 0.5 and -0.5 <= column <= width - 0.5):
        return Probe(None, None, None)
    measured = float(measured_ranges(scan, direction).ranges[0])
    nearest = scan.intensity[min(max(round(row), 0), height - 1), min(max(round(column), 0), width - 1)]
    return Probe(
        measured if np.isfinite(measured) else None, float(nearest), (row, column), _depth_edge(scan, row, column)
    )


def _depth_edge(scan: Scan, row: float, column: float) -> DepthEdge | None:
    """Return the depth edge around a fractional cell: where the ranges around it fall into two groups."""
    i, j = round(row), round(column)
    rows, columns = slice(max(i - _AROUND, 0), i + _AROUND + 1), slice(max(j - _AROUND, 0), j + _AROUND + 1)
    around = scan.ranges[rows, columns].astype(np.float64)
    known = np.sort(around[np.isfinite(around) & (around > 0)])
    if len(known) < 2:
        return None
    gaps = np.diff(known) / known[:-1]
    widest = int(np.argmax(gaps))
    if gaps[widest] <= EDGE_FRACTION:
        return None
    between = 0.5 * (known[widest] + known[widest + 1])
    found: list[tuple[float, FloatArray]] = []
    for side in (around < between, around > between):
        cells = np.argwhere(side) + np.array([rows.start, columns.start])
        ray = np.asarray(scan.geometry.ray_at(cells.astype(np.float64))).mean(axis=0)
        found.append((float(np.median(around[side])), ray / np.linalg.norm(ray)))
    (near_m, near_ray), (far_m, far_ray) = found
    return DepthEdge(near_m, far_m, near_ray, far_ray)


class PickPredictor:
    """Predicts the counterparts of picks in the other image under one pose; shared work is done once."""

    def __init__(self, scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> None:
        self._scan = scan
        self._camera = camera
        self._pose = camera_from_scanner

    def in_photo(self, rays: ArrayLike) -> FloatArray:
        """Return the photo pixels (N, 2) of unit rays (N, 3), scanner frame.

        NaN where the scan has no return along the ray, or outside the photo. At a depth edge the nearer surface counts.
        """
        directions = np.asarray(rays, dtype=np.float64)
        ranges = measured_ranges(self._scan, directions).outline
        uv = self._camera.project(self._pose @ (directions * ranges[:, None]))
        return np.where(self._camera.contains(uv)[:, None], uv, np.nan)

    def on_scan(self, uv: ArrayLike) -> FloatArray:
        """Return the unit rays (N, 3), scanner frame, to the surfaces seen at photo pixels (N, 2).

        NaN where it sees no surface of the scan within 6 px.
        """
        return np.array([self._ray_at(np.asarray(at, dtype=np.float64)) for at in np.asarray(uv)]).reshape(-1, 3)

    @cached_property
    def _projection(self) -> ScanProjection:
        return project_scan(self._scan, self._camera, self._pose)

    @cached_property
    def _nearest_cell(self) -> NDArray[np.int32]:
        """Flat index of the nearest visible cell in each photo pixel; -1: none."""
        if self._is_large:
            return self._nearest_of_tiles()
        projection = self._projection
        seen = np.flatnonzero(projection.visible)
        seen = seen[np.argsort(-projection.depth_m.reshape(-1)[seen], kind="stable")]  # the nearest is written last
        at = np.rint(projection.uv.reshape(-1, 2)[seen]).astype(np.intp)
        grid = np.full((self._camera.height, self._camera.width), -1, np.int32)
        u, v = np.clip(at[:, 0], 0, self._camera.width - 1), np.clip(at[:, 1], 0, self._camera.height - 1)
        grid[v, u] = seen
        return grid

    @property
    def _is_large(self) -> bool:
        return self._scan.ranges.size > LARGEST_WHOLE_SCAN

    def _nearest_of_tiles(self) -> NDArray[np.int32]:
        """Return `_nearest_cell`, tile by tile, in memory that does not grow with the scan."""
        size = self._camera.height * self._camera.width
        found, depth = np.full(size, -1, np.int32), np.full(size, np.inf, np.float32)
        for tile in projected_tiles(self._scan, self._camera, self._pose):
            part = tile.projection.of_cells(*tile.inner)
            row, column = np.nonzero(part.visible)
            z = part.depth_m[row, column]
            order = np.argsort(-z, kind="stable")  # the nearest is written last
            row, column, z = row[order], column[order], z[order]
            at = np.rint(part.uv[row, column]).astype(np.intp)
            u, v = np.clip(at[:, 0], 0, self._camera.width - 1), np.clip(at[:, 1], 0, self._camera.height - 1)
            pixel = v * self._camera.width + u
            nearer = z < depth[pixel]
            cells = (row + tile.rows.start) * self._scan.shape[1] + column + tile.columns.start
            found[pixel[nearer]], depth[pixel[nearer]] = cells[nearer], z[nearer]
        return found.reshape(self._camera.height, self._camera.width)

    def _uv_of(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Return the photo pixels (N, 2) of cells (N,)."""
        if not self._is_large:
            return self._projection.uv[rows, columns]
        rays = self._scan.geometry.ray_at(np.stack([rows, columns], axis=-1))
        return self._camera.project(self._pose @ (rays * self._scan.ranges[rows, columns, None]))

    def _ray_at(self, at: FloatArray) -> FloatArray:
        nowhere = np.full(3, np.nan)
        if not np.isfinite(at).all() or not self._camera.contains(at):
            return nowhere
        u, v = np.rint(at).astype(int)
        around = self._nearest_cell[
            max(v - _REACH_PX, 0) : v + _REACH_PX + 1, max(u - _REACH_PX, 0) : u + _REACH_PX + 1
        ]
        cells = np.unique(around[around >= 0])
        if not len(cells):
            return nowhere
        uv = self._uv_of(*np.divmod(cells, self._scan.shape[1])).astype(np.float64)
        distance = np.linalg.norm(uv - at, axis=1)
        best = int(np.argmin(distance))
        if distance[best] > _REACH_PX:
            return nowhere
        cell = np.array(divmod(int(cells[best]), self._scan.shape[1]), dtype=np.float64)
        return np.asarray(self._scan.geometry.ray_at((cell + self._sub_cell_offset(cell, at - uv[best]))[None])[0])

    def _sub_cell_offset(self, cell: FloatArray, offset_px: FloatArray) -> FloatArray:
        """Return the offset (2,) from a cell centre, in cells, of a pixel offset, by the slope of the surface around
        it."""
        row, column = cell.astype(int)
        height, width = self._scan.shape
        r0, r1, c0, c1 = max(row - 1, 0), min(row + 1, height - 1), max(column - 1, 0), min(column + 1, width - 1)
        uv = self._uv_of(np.array([r0, r1, row, row]), np.array([column, column, c0, c1]))
        J = np.stack([(uv[1] - uv[0]) / (r1 - r0), (uv[3] - uv[2]) / (c1 - c0)], axis=1)
        if not np.isfinite(J).all() or abs(np.linalg.det(J.astype(np.float64))) < 1e-6:
            return np.zeros(2)
        offset = np.linalg.solve(J.astype(np.float64), offset_px)
        return np.asarray(offset if np.abs(offset).max() <= _REFINED_CELLS else np.zeros(2))


def _influences(result: PoseResult) -> Mapping[str, float]:
    try:
        with np.errstate(all="ignore"):
            found = influence(result)
    except (LadarregError, np.linalg.LinAlgError):
        return {}
    by_pick: dict[str, float] = {}
    for name, pixels in zip(found.pick_ids, found.pixels.tolist(), strict=True):
        by_pick[name] = max(pixels, by_pick.get(name, 0.0))
    return by_pick


def _inliers(result: PoseResult) -> Mapping[str, bool]:
    by_pick: dict[str, bool] = {}
    for name, inlier in zip(result.matches.pick_ids, result.inliers.tolist(), strict=True):
        by_pick[name] = by_pick.get(name, True) and bool(inlier)
    return by_pick


def _largest(values: Sequence[float]) -> float:
    """Return the finite value farthest from 0; NaN where there is none."""
    return max(filter(math.isfinite, values), key=abs, default=math.nan)
