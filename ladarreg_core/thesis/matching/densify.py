"""Densification: additional matches along lines between matches, where the lines lie on planar surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.validation import require_choice, require_int, require_number
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.scan_levels import ScanLevels
from ladarreg_core.picks.lines import fraction_in_photo, kappa_of
from ladarreg_core.surface.remap import look_up

Kappa = Literal["equal", "by_pose"]
_LINES_AT_A_TIME = 256
_CHECK_EVERY_PX = 1.0  # depth edges and holes are marked three pixels wide
_MAX_NEIGHBOURS = 100
_MAX_LINES = 10_000
_LARGEST_PX = 1e5
_LARGEST_M = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class DensifyOptions:
    """Options of the lines between matches.

    Raises:
        OptionError: if a value is out of range.
    """

    plane_sigma_m: float = 0.01
    """Maximum rms deviation of the measured ranges from the straight line, m..."""
    plane_sigma_relative: float = 0.004
    """...or as a fraction of the range, since noise grows with range; the larger applies. 0: the absolute one only."""
    interval_px: float = 8.0
    """Interval between the points along a line, scan pixels."""
    shortest_px: float = 20.0
    """Minimum length of a line in either image, pixels."""
    longest_px: float = 200.0
    """Maximum length of a line, scan pixels."""
    most_stretch: float = 3.0
    """Maximum ratio of a line's lengths in the two images; beyond it one of its ends is a mismatch."""
    neighbours: int = 12
    """Maximum number of nearest matches that each match is connected with."""
    lines_per_match: int = 4
    """Maximum number of lines that end at a match."""
    most_lines: int = 400
    """Maximum number of lines, the shortest first."""
    kappa: Kappa = "by_pose"
    """Position of the points in the photo: at `equal` fractions as in the thesis, or, if a pose is known, by
    perspective: odds(s_photo) = kappa odds(s_scan)."""

    def __post_init__(self) -> None:
        spans = (
            ("plane_sigma_m", 0, _LARGEST_M),
            ("plane_sigma_relative", 0, 1),
            ("interval_px", 1, _LARGEST_PX),
            ("shortest_px", 1, _LARGEST_PX),
            ("longest_px", 1, _LARGEST_PX),
            ("most_stretch", 1, _LARGEST_PX),
        )
        for name, least, most in spans:
            value = getattr(self, name)
            require_number(value, f"the lines' {name}", least=least, most=most)
        counts = (
            ("neighbours", _MAX_NEIGHBOURS),
            ("lines_per_match", _MAX_NEIGHBOURS),
            ("most_lines", _MAX_LINES),
        )
        for name, most_whole in counts:
            value = getattr(self, name)
            require_int(value, f"the lines' {name}", least=1, most=most_whole)
        require_choice(self.kappa, get_args(Kappa), "the lines' kappa")


@dataclass(frozen=True, slots=True, eq=False)
class LinePoints:
    """N points along L lines."""

    scan_uv: NDArray[np.float64]
    """(N, 2) view pixels."""
    photo_uv: NDArray[np.float64]
    """(N, 2) working pixels of the photo."""
    ranges: NDArray[np.float64]
    """(N,) m, as measured there."""
    line: NDArray[np.intp]
    """(N,) index of the line."""
    fraction: NDArray[np.float64]
    """(N,) position along the line in the scan's view, between 0 and 1."""
    ends: NDArray[np.intp]
    """(L, 2) indices of the matches at the ends of each line."""

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def weight(self) -> NDArray[np.float64]:
        """(N,) 1 / sqrt of the number of points on the same line, since these are not independent."""
        return np.asarray(1 / np.sqrt(np.bincount(self.line, minlength=len(self.ends))[self.line]))


def lines_between(
    scan: ScanLevels,
    scan_uv: ArrayLike,
    photo_uv: ArrayLike,
    options: DensifyOptions | None = None,
    *,
    photo_camera: Camera,
    pose: Rigid | None = None,
) -> LinePoints:
    """Return points at constant intervals along lines between matches that lie on planar surfaces.

    A line with a hole or a depth edge on it, ends included, is discarded. Of many lines the shortest are kept, and of
    duplicates the shorter one.

    Args:
        scan: the scan's levels.
        scan_uv: (K, 2) view pixels of the matches.
        photo_uv: (K, 2) working pixels of the matches. Matches that are not finite or lie outside either image are
            ignored.
        options: selection and sampling of the lines.
        photo_camera: the photo's working camera.
        pose: `camera_from_scanner`, for `kappa`; None: equal fractions in both images, as in the thesis. The middle of
            a long line is then displaced by several pixels.

    Returns:
        the points without the ends, line by line in the order of their fraction; empty if there is no line.

    Raises:
        ShapeError: if the pixels of the two sides are not (K, 2) each.

    Source: thesis 2.3.2, end, and Figure 2.17.
    """
    o = options or DensifyOptions()
    on_scan = read_only(scan_uv, np.float64, (None, 2), "the matches' scan pixels")
    on_photo = read_only(photo_uv, np.float64, (len(on_scan), 2), "the matches' photo pixels")
    surface = _Surface(scan)
    ends = _select_lines(on_scan, on_photo, surface, photo_camera, o)
    line, fraction = _sample_fractions(_lengths(on_scan, ends), o.interval_px)
    kappa = np.ones(len(ends))
    if pose is not None and o.kappa == "by_pose":
        kappa = _kappa(on_scan, ends, surface, pose)
    on_lines = _along(on_scan, ends[line], fraction)
    return LinePoints(
        scan_uv=on_lines,
        photo_uv=_along(on_photo, ends[line], fraction_in_photo(fraction, kappa[line])),
        ranges=surface.ranges_at(on_lines),
        line=line,
        fraction=fraction,
        ends=ends,
    )


class _Surface:
    """Measured ranges of a view, interpolated between its pixels."""

    def __init__(self, scan: ScanLevels) -> None:
        self.view = scan.view
        self._unbroken = ~scan.edge & np.isfinite(scan.ranges)
        with np.errstate(divide="ignore"):
            self._inverse = np.where(np.isfinite(scan.ranges), 1 / scan.ranges, 0).astype(np.float32)

    def unbroken(self, uv: FloatArray) -> BoolArray:
        """Return a mask (...) of the pixels (..., 2) inside the view, away from holes and depth edges."""
        inside = self.view.camera.contains(uv)
        u, v = np.moveaxis(np.rint(np.where(inside[..., None], uv, 0)).astype(np.intp), -1, 0)
        return np.asarray(inside & self._unbroken[v, u])

    def ranges_at(self, uv: FloatArray) -> NDArray[np.float64]:
        """Return the ranges (..., m) at unbroken pixels (..., 2), bilinear in 1 / range, which is exact on a plane."""
        u, v = uv[..., 0].reshape(1, -1), uv[..., 1].reshape(1, -1)
        if not u.size:
            return np.zeros(uv.shape[:-1])
        inverse = look_up(self._inverse, u.astype(np.float32), v.astype(np.float32)).astype(np.float64)
        with np.errstate(divide="ignore"):
            return np.asarray(1 / inverse.reshape(uv.shape[:-1]))


def _select_lines(
    scan_uv: FloatArray, photo_uv: FloatArray, surface: _Surface, photo_camera: Camera, options: DensifyOptions
) -> NDArray[np.intp]:
    """Return the ends (L, 2) of the lines to sample."""
    with np.errstate(invalid="ignore"):
        usable = np.flatnonzero(surface.unbroken(scan_uv) & photo_camera.contains(photo_uv))
    scan_uv, photo_uv = scan_uv[usable], photo_uv[usable]
    pairs = _neighbour_pairs(scan_uv, options)
    pairs = pairs[_similar_lengths(_lengths(scan_uv, pairs), _lengths(photo_uv, pairs), options)]
    chooser = _LineSelector(scan_uv, options)
    for start in range(0, len(pairs), _LINES_AT_A_TIME):
        some = pairs[start : start + _LINES_AT_A_TIME]
        some = some[chooser.available(some)]
        chooser.add(some[_on_planes(_ends_of(scan_uv, some), surface, options)])
        if chooser.full:
            break
    return usable[chooser.ends]


def _on_planes(lines: FloatArray, surface: _Surface, options: DensifyOptions) -> BoolArray:
    """Return a mask (L,) of the lines (L, 2 ends, 2) that lie on planar surfaces.

    The straight line in space between the ends has an inverse depth that is linear along its image; the mean square
    distance from the measured surface, along the lines of sight, is the thesis's variance.
    """
    result = np.zeros(len(lines), np.bool_)
    for rows, steps in _length_classes(lines):
        s = np.linspace(0, 1, steps)
        uv = lines[rows, :1] + s[:, None] * (lines[rows, 1:] - lines[rows, :1])
        whole = surface.unbroken(uv).all(axis=1)
        rows, uv = rows[whole], uv[whole]
        measured = surface.ranges_at(uv)
        cosine = surface.view.camera.unproject(uv)[..., 2]
        inverse_depth = 1 / (measured * cosine)
        straight = inverse_depth[:, :1] + s * (inverse_depth[:, -1:] - inverse_depth[:, :1])
        off = 1 / (straight * cosine) - measured
        most = np.maximum(options.plane_sigma_m, options.plane_sigma_relative * measured.mean(axis=1))
        result[rows] = np.sqrt((off**2).mean(axis=1)) <= most
    return result


def _length_classes(lines: FloatArray) -> Iterator[tuple[NDArray[np.intp], int]]:
    """Yield groups of lines of similar length with the number of samples for the check, at most a pixel apart."""
    length = np.hypot(*(lines[:, 1] - lines[:, 0]).T)
    class_of = np.ceil(np.log2(np.maximum(length / _CHECK_EVERY_PX, 4))).astype(np.intp)
    for k in np.unique(class_of):
        yield np.flatnonzero(class_of == k), 2 ** int(k) + 1


def _sample_fractions(length: FloatArray, interval_px: float) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return line and fraction of each point: at constant intervals, symmetric about the middle, without the ends."""
    count = np.maximum(np.ceil(length / interval_px).astype(np.intp) - 1, 1)
    line = np.repeat(np.arange(len(length)), count)
    number = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    from_middle = (number - (count[line] - 1) / 2) * interval_px
    return line, 0.5 + from_middle / length[line]


def _neighbour_pairs(uv: FloatArray, options: DensifyOptions) -> NDArray[np.intp]:
    """Return (P, 2) pairs of neighbouring matches, i < j, the shortest first."""
    from scipy.spatial import cKDTree

    if len(uv) < 2:
        return np.zeros((0, 2), np.intp)
    # Neighbours closer than the minimum length are not counted: a cluster of matches must not use up all neighbours.
    reach = min(len(uv), 8 * options.neighbours + 1)
    distance, index = cKDTree(uv).query(uv, k=reach, distance_upper_bound=options.longest_px * (1 + 1e-12))
    far_enough = np.isfinite(distance) & (distance >= options.shortest_px)
    rows, columns = np.nonzero(far_enough & (np.cumsum(far_enough, axis=1) <= options.neighbours))
    pairs = np.unique(np.sort(np.column_stack([rows, index[rows, columns]]), axis=1), axis=0).astype(np.intp)
    return pairs[np.argsort(np.round(_lengths(uv, pairs), 6), kind="stable")]


def _similar_lengths(on_scan: FloatArray, on_photo: FloatArray, options: DensifyOptions) -> BoolArray:
    stretch = options.most_stretch
    return (on_photo >= options.shortest_px) & (on_photo <= stretch * on_scan) & (on_scan <= stretch * on_photo)


class _LineSelector:
    """Selects lines in order, with a limited number at each match and without duplicates."""

    def __init__(self, uv: FloatArray, options: DensifyOptions) -> None:
        from scipy.spatial import cKDTree

        self._options = options
        self._used = np.zeros(len(uv), np.intp)
        self._chosen: list[tuple[int, int]] = []
        self._other_ends: list[set[int]] = [set() for _ in uv]
        self._near: list[list[int]] = []
        if len(uv):
            self._near = list(cKDTree(uv).query_ball_point(uv, options.interval_px, p=np.inf))

    @property
    def ends(self) -> NDArray[np.intp]:
        """(L, 2) indices of the ends."""
        return np.array(self._chosen, np.intp).reshape(-1, 2)

    @property
    def full(self) -> bool:
        """Whether the maximum number of lines is reached."""
        return len(self._chosen) >= self._options.most_lines

    def available(self, pairs: IntArray) -> BoolArray:
        """Return a mask (P,) of the pairs (P, 2) whose ends can take another line."""
        return np.asarray((self._used[pairs] < self._options.lines_per_match).all(axis=1))

    def add(self, pairs: IntArray) -> None:
        """Add the allowed ones of pairs (P, 2)."""
        for i, j in pairs.tolist():
            if self.full:
                return
            if max(self._used[i], self._used[j]) >= self._options.lines_per_match or self._duplicates(i, j):
                continue
            self._chosen.append((i, j))
            self._other_ends[i].add(j)
            self._other_ends[j].add(i)
            self._used[[i, j]] += 1

    def _duplicates(self, i: int, j: int) -> bool:
        """Return whether both ends lie within an interval of another line's ends."""
        return any(not self._other_ends[k].isdisjoint(self._near[j]) for k in self._near[i] if self._other_ends[k])


def _kappa(scan_uv: FloatArray, ends: IntArray, surface: _Surface, pose: Rigid) -> NDArray[np.float64]:
    """Return kappa (L,) of each line; 1 if an end lies behind the camera."""
    view = surface.view
    points = view.rays_at(scan_uv[ends]) * surface.ranges_at(scan_uv[ends])[..., None]
    in_view, in_photo = (view.view_from_scanner @ points)[..., 2], (pose @ points)[..., 2]
    return kappa_of(in_view, in_photo)


def _along(uv: FloatArray, ends: IntArray, fraction: FloatArray) -> NDArray[np.float64]:
    first, last = uv[ends[:, 0]], uv[ends[:, 1]]
    return np.asarray(first + fraction[:, None] * (last - first))


def _ends_of(uv: FloatArray, pairs: IntArray) -> NDArray[np.float64]:
    return np.asarray(uv[pairs.reshape(-1)].reshape(-1, 2, 2))


def _lengths(uv: FloatArray, pairs: IntArray) -> NDArray[np.float64]:
    return np.asarray(np.hypot(*(uv[pairs[:, 1]] - uv[pairs[:, 0]]).T))
