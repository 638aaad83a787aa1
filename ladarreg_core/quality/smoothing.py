"""Range smoothing by stereo: a range that contradicts its match is replaced by the range that the match shows.

Where the laser range and the stereo depth of a match differ a lot, the range is mostly a spike. It is replaced by the
range at which the point on the ray projects nearest to the pixel of the match. Each point is replaced on its own, not
by an average of its neighbours, so that edges are preserved.

The thesis uses "estimates based on their stereo depth", of which Eq 2.19 and 2.20 give two. Their mean has a pole
wherever one of the two disparities vanishes, as along lines through the epipole of a camera in front of the scanner (1
m in front, in a room: 4 m rms instead of .08 m); least squares in pixels weights both by their information and has no
pole.

At a depth edge a range may differ from its neighbourhood and yet be right: what lies there is not a spike, and it is
replaced only where that is asked for.

Source: thesis 3.2, Figure 3.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import CameraModel, require_camera, require_pinhole
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.validation import require_positive
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.pose.diagnostics import diagnose
from ladarreg_core.pose.estimators.bundle import UNSEEN, States, linearise, residuals
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.quality.limits import MAX_SIGMA_Z_OVER_Z
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.spikes import SPIKE_FRACTION, median_range

_UNKNOWN_RANGE_SIGMA_M = 1e6  # so large that the pixel alone determines the range
_MAX_FACTOR = 100.0  # larger than any scanner's error; without a baseline, rounding may yield any range
_UNIT_TOLERANCE = 1e-3
_MAX_RANGE_M, _MAX_PIXEL = 1e7, 1e7
_SIGNIFICANCE = 5.0
"""Standard deviations of the pixel by which the stereo range must fit better than the laser's: of the pixel, since the
range of a small disparity is far from normally distributed."""
_EDGE_CELLS = 3
"""A depth edge through the 5 x 5 cells about a cell cuts off at least as many of the others, here from the corner;
spikes beside it are fewer where one cell in twenty is one (95 %)."""
_ACROSS_SIGMA = 2.58
"""Largest distance of a pixel from its epipolar line, in standard deviations (99 %); beyond it the match is wrong, not
the range."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothOptions:
    """Conditions for replacing a range by stereo."""

    sigma_px: float = 1.0
    """Pixel noise of the matches, px."""
    with_edges: bool = False
    """Whether ranges at depth edges are replaced, too."""

    def __post_init__(self) -> None:
        require_positive(self.sigma_px, "sigma_px")


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRanges:
    """Ranges with the spikes that contradict their matches replaced."""

    ranges: FloatArray
    """(M,) m: measured, or from stereo where replaced."""
    replaced: BoolArray
    """(M,) bool."""
    stereo_ranges: FloatArray
    """(M,) m, at which the point on the ray projects nearest to the pixel; NaN where undetermined."""
    sigma_m: FloatArray
    """(M,) standard deviation of `stereo_ranges`, m; infinite where the disparity does not determine them."""


@dataclass(frozen=True, slots=True, eq=False)
class Replacements:
    """The ranges of a scan that a registration contradicts, with those that replace them; each cell is there once."""

    cells: IntArray
    """(N, 2) row and column."""
    measured: FloatArray
    """(N,) m, as the scan has them."""
    ranges: FloatArray
    """(N,) m, by stereo."""
    sigma_m: FloatArray
    """(N,) standard deviation of `ranges`, m."""
    at_edge: BoolArray
    """(N,) whether the cell lies at a depth edge, where its range may be right; else it is a spike."""

    def __len__(self) -> int:
        return len(self.cells)

    def chosen(self, *, with_edges: bool) -> Replacements:
        """Return those at spikes alone, or all."""
        return self if with_edges else self.at(np.flatnonzero(~self.at_edge))

    def at(self, index: IntArray) -> Replacements:
        """Return those of some indices."""
        return Replacements(
            self.cells[index], self.measured[index], self.ranges[index], self.sigma_m[index], self.at_edge[index]
        )


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedScan:
    """Scan with the range spikes under its matches replaced, and a report on it."""

    scan: Scan
    """The scan to show; the given one where nothing was replaced."""
    cells_replaced: int
    """Number of cells with a new range."""
    sentence: str
    """What was replaced, or why nothing was."""


def smooth_ranges(
    matches: Matches,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    *,
    threshold_m: float | FloatArray,
    covariance: ArrayLike | None = None,
    options: SmoothOptions | None = None,
) -> SmoothedRanges:
    """Replace each range that contradicts its match by the range that the match shows.

    A range is kept where stereo agrees with it within the threshold, where stereo is less certain than the threshold or
    the pixel noise explains the difference, and where the pixel lies off the epipolar line. A false match that happens
    to lie on that line cannot be distinguished from a spike.

    Args:
        matches: M matches; a weight multiplies the information of its pixel.
        camera: the photo's camera.
        camera_from_scanner: the pose.
        threshold_m: largest difference between laser and stereo along the ray that is not a spike, m: one value or
            (M,).
        covariance: (6, 6) of the pose, as in `PoseResult`; None: the pose is exact.
        options: conditions for replacing a range; None: the defaults.

    Returns:
        The ranges, in the order of the matches.

    Raises:
        ShapeError: if a match has a value that is not finite, a range or weight that is not positive, a ray that is not
            a unit vector or a range or pixel beyond 1e7, or if thresholds or covariance have another shape or are not
            finite.
        OptionError: if a threshold is not a positive number, or the pose or the options have another type.
        CameraError: if `camera` is not a `Camera`.

    Source: thesis 3.2, Figure 3.5.
    """
    options = SmoothOptions() if options is None else options
    _check_inputs(matches, camera, camera_from_scanner, options)
    threshold = _checked_threshold(threshold_m, len(matches))
    pose_covariance = _checked_covariance(covariance)
    if len(matches) == 0:
        nothing = np.zeros(0)
        return SmoothedRanges(nothing, nothing.astype(np.bool_), nothing, nothing)
    measured = Measurements.of(matches, camera, sigma_px=options.sigma_px, sigma_range_m=_UNKNOWN_RANGE_SIGMA_M)
    rho = _nearest_on_ray(measured, camera_from_scanner)
    with np.errstate(invalid="ignore"):
        known = (rho > matches.ranges / _MAX_FACTOR) & (rho < matches.ranges * _MAX_FACTOR)
    # Two states of the same pose: with the ranges from stereo, and with the measured ones.
    both = States.of([camera_from_scanner] * 2, measured)
    states = States(both.rotations, both.centres, np.stack([np.where(known, rho, matches.ranges), matches.ranges]))
    seen = residuals(measured, states)
    known &= seen.s[0] < UNSEEN
    lin = linearise(measured, states, seen)
    s = seen.s - measured.range_information * seen.range_error**2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        by_pixel = (lin.j[0] * lin.m[0]).sum(axis=0)  # information on the range, 1/m^2
        by_pose = np.einsum("pxn,xn->np", lin.j_pose[0], lin.m[0]) / by_pixel[:, None]
        sigma = np.sqrt(1 / by_pixel + _quadratic(by_pose, pose_covariance))
        sigma = np.where(known & np.isfinite(sigma), sigma, np.inf)
        # Variance of the length of each residual due to the pose alone, relative to that of the pixel.
        pull = measured.information * seen.e + measured.cross_information * seen.e[:, ::-1]
        by_pose = np.einsum("bpxn,bxn->bnp", lin.j_pose, pull) / np.sqrt(np.maximum(s, 1e-12))[..., None]
        allowed = 1 + _quadratic(by_pose, pose_covariance)
    stereo = np.where(np.isfinite(sigma), rho, np.nan)
    with np.errstate(invalid="ignore"):
        on_line = s[0] <= _ACROSS_SIGMA**2 * allowed[0]
        significant = s[1] - s[0] > _SIGNIFICANCE**2 * allowed[1]
        spike = (np.abs(stereo - matches.ranges) > threshold) & significant
        replaced = spike & on_line & (sigma <= threshold)
    return SmoothedRanges(np.where(replaced, stereo, matches.ranges), replaced, stereo, sigma)


def smooth_scan(scan: Scan, result: PoseResult, *, options: SmoothOptions | None = None) -> Scan:
    """Replace the range spikes of a scan that lie under matches.

    A cell is a spike only if its range differs from its neighbourhood by more than 5 %, and it is replaced only by a
    range that does not; both use the threshold of `surface.spikes`.

    Args:
        scan: the scan.
        result: pose, camera and matches, possibly with outliers.
        options: conditions for replacing a range; None: the defaults, with the pixel noise of the result.

    Returns:
        The scan with a note on what was replaced, or the same scan where nothing was.

    Raises:
        LadarregError: as `smooth_ranges`; also OptionError if `scan` or `result` has another type.

    Source: thesis 3.2.
    """
    found = find_replacements(scan, result, options=options)
    chosen = found.chosen(with_edges=options is not None and options.with_edges)
    return with_ranges(scan, chosen.cells, chosen.ranges)


def find_replacements(
    scan: Scan, result: PoseResult, *, picks: Sequence[Pick] = (), options: SmoothOptions | None = None
) -> Replacements:
    """Find the ranges under the matches of a registration that it contradicts, at spikes and at depth edges.

    Args:
        scan: the scan, which is not changed.
        result: pose, camera and matches, possibly with outliers.
        picks: what was drawn. Where a spike lies under a point, it has no match, since it seems to be at a depth edge;
            its ray and pixel show the range nevertheless. Lines and disabled points are left out.
        options: conditions for replacing a range; None: the defaults, with the pixel noise of the result.

    Returns:
        All of them, in the order of the cells; `Replacements.chosen` leaves out those at edges.

    Raises:
        LadarregError: as `smooth_scan`.

    Source: thesis 3.2.
    """
    if not isinstance(scan, Scan) or not isinstance(result, PoseResult):
        raise OptionError(
            f"smoothing was given a {type(scan).__name__} and a {type(result).__name__}; give a Scan and its "
            "PoseResult or Registration"
        )
    every = _with_points(result.matches, picks)
    cells = np.asarray(scan.geometry.cell_of(every.rays), dtype=np.float64)
    with np.errstate(invalid="ignore"):
        within = ((cells >= -0.5) & (cells <= np.array(scan.shape) - 0.5)).all(axis=1)
    index = np.flatnonzero(within)
    rows, columns = np.clip(np.rint(cells[index]).astype(np.intp), 0, np.array(scan.shape) - 1).T
    measured, around = scan.ranges[rows, columns], median_range(scan.ranges)[rows, columns]
    with np.errstate(invalid="ignore"):
        spike = np.abs(measured - around) > SPIKE_FRACTION * around
    index, rows, columns, measured, around = (v[spike] for v in (index, rows, columns, measured, around))
    if not len(index):
        nothing = np.zeros(0)
        return Replacements(np.zeros((0, 2), np.intp), nothing, nothing, nothing, nothing.astype(np.bool_))
    # Ray and pixel of the match, but the range of the cell: a match may have taken its range from a neighbour.
    matches = replace(every.subset(index), ranges=measured)
    chosen = options or SmoothOptions(sigma_px=result.sigma_px)
    smoothed = smooth_ranges(
        matches,
        result.camera,
        result.camera_from_scanner,
        threshold_m=SPIKE_FRACTION * around,
        covariance=result.covariance if np.isfinite(result.covariance).all() else None,
        options=chosen,
    )
    good = smoothed.replaced & (np.abs(smoothed.ranges - around) <= SPIKE_FRACTION * around)
    # Of several matches in a cell the most certain one counts.
    order = np.lexsort((smoothed.sigma_m, columns, rows))
    order = order[good[order]]
    cells = np.stack([rows, columns], axis=1)[order]
    _, first = np.unique(cells, axis=0, return_index=True)
    order = order[first]
    at_edge = _lies_at_edge(scan.ranges, rows[order], columns[order], around[order])
    return Replacements(
        np.stack([rows, columns], axis=1)[order], measured[order], smoothed.ranges[order], smoothed.sigma_m[order],
        at_edge,
    )  # fmt: skip


def with_ranges(scan: Scan, cells: IntArray, ranges: FloatArray) -> Scan:
    """Return a scan with some ranges replaced, and a note on it; the same scan without any.

    Args:
        scan: the scan.
        cells: (N, 2) row and column of each.
        ranges: (N,) m.

    Raises:
        ShapeError: if a cell is not one of the scan's, or a range is not a positive number.
    """
    cells = np.asarray(cells, dtype=np.intp).reshape(-1, 2)
    if not len(cells):
        return scan
    if not ((cells >= 0) & (cells < np.array(scan.shape))).all():
        raise ShapeError(
            f"a replaced range lies outside the scan's {scan.shape[0]} x {scan.shape[1]} cells: its file has changed "
            "since its ranges were smoothed; go back in the history to before that, or open the scan again"
        )
    if not ((np.asarray(ranges) > 0) & np.isfinite(ranges)).all():
        raise ShapeError("a replaced range is not a positive number of metres; smooth the ranges again")
    changed = np.array(scan.ranges)
    changed[tuple(cells.T)] = ranges
    return replace(scan, ranges=changed, notes=(*scan.notes, _replaced_sentence(len(cells))))


def smooth_with_report(scan: Scan, result: PoseResult, *, picks: Sequence[Pick] = ()) -> SmoothedScan:
    """Replace the range spikes under the matches of a registration, and report what was replaced.

    Args:
        scan: the scan.
        result: an accepted registration of it.
        picks: what was drawn, see `find_replacements`.

    Raises:
        LadarregError: as `smooth_scan`.

    Source: thesis 3.2 and 3.5.
    """
    found = find_replacements(scan, result, picks=picks)
    spikes = found.chosen(with_edges=False)
    left = len(found) - len(spikes)
    words = f"Nothing was replaced: {nothing_found(result)}."
    if len(spikes):
        words = _replaced_sentence(len(spikes))
    if left:
        words += f" {left} more at depth edges were left, since what stands out there need not be a spike."
    return SmoothedScan(with_ranges(scan, spikes.cells, spikes.ranges), len(spikes), words)


def nothing_found(result: PoseResult) -> str:
    """Return why a registration contradicts no range, without a full stop."""
    if not _has_parallax(result):
        return "scanner and camera are nearly at the same position, so that stereo gives no range"
    return "no match lies on a range spike that stereo contradicts"


def _has_parallax(result: PoseResult) -> bool:
    """Return whether stereo ranges are certain enough to be compared with the laser's."""
    figures = diagnose(
        result.camera_from_scanner, result.matches, result.inliers, result.camera, sigma_px=result.sigma_px
    )
    return bool(figures.get("stereo_sigma_z_over_z", np.inf) <= MAX_SIGMA_Z_OVER_Z)


def _with_points(matches: Matches, picks: Sequence[Pick]) -> Matches:
    """Return matches with drawn points, whose ranges, 1 m, have yet to be filled in."""
    points = [pick for pick in picks if pick.on and pick.kind == "point"]
    if not points:
        return matches
    ones = np.ones(len(points))
    return Matches(
        np.concatenate([matches.rays, [pick.scan[0] for pick in points]]),
        np.concatenate([matches.ranges, ones]),
        np.concatenate([matches.uv, [pick.photo[0] for pick in points]]),
        weights=np.concatenate([matches.weights, [pick.weight for pick in points]]),
    )


def _lies_at_edge(ranges: FloatArray, rows: IntArray, columns: IntArray, around: FloatArray) -> BoolArray:
    """Return which cells (N,) have others about them that are as far from their median `around` (N,) as a spike is."""
    padded = np.pad(ranges, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[rows, columns]
    with np.errstate(invalid="ignore"):
        off = np.abs(windows - around[:, None, None]) > SPIKE_FRACTION * around[:, None, None]
    off[:, 2, 2] = False
    return np.asarray(off.sum(axis=(1, 2)) >= _EDGE_CELLS)


def _replaced_sentence(count: int) -> str:
    return f"{count} range spikes under matches were replaced by their stereo range."


def _nearest_on_ray(measured: Measurements, pose: Rigid) -> FloatArray:
    """Return the range (N,) at which the image of each ray comes nearest to its pixel; not finite without a baseline.

    The image of a ray is the epipolar line through its vanishing point and the epipole. The pixel is projected onto
    that line by the shortest Mahalanobis distance, and the range is computed there.
    """
    far, near = pose.rotation @ measured.rays, np.broadcast_to(pose.translation[:, None], measured.rays.shape)
    line = np.cross(far, near, axis=0)
    pixel = np.vstack([measured.xy, np.ones(len(measured))])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        off = (line * pixel).sum(axis=0) / (line[:2] ** 2).sum(axis=0) * line[:2]
        along = np.stack([line[1], -line[0]])
        weighted = measured.information * along + measured.cross_information * along[::-1]
        foot = pixel[:2] - off + along * ((weighted * off).sum(axis=0) / (weighted * along).sum(axis=0))
        foot = np.vstack([foot, np.ones(len(measured))])
        a, b = np.cross(foot, far, axis=0), np.cross(foot, near, axis=0)
        return np.asarray(-(a * b).sum(axis=0) / (a * a).sum(axis=0))


def _quadratic(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...k,kl,...l->...", rows, matrix, rows))


def _check_inputs(matches: object, camera: object, pose: object, options: object) -> None:
    if not isinstance(matches, Matches):
        raise ShapeError(f"the matches are a {type(matches).__name__}; give Matches")
    require_pinhole(require_camera(camera, "the camera"), "Smoothing")
    if not isinstance(pose, Rigid):
        raise OptionError(f"the pose is a {type(pose).__name__}; give a Rigid (camera_from_scanner)")
    if not isinstance(options, SmoothOptions):
        raise OptionError(f"options is a {type(options).__name__}; give SmoothOptions")
    values = np.column_stack([matches.rays, matches.ranges, matches.uv, matches.weights])
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.linalg.norm(matches.rays, axis=1) - 1) <= _UNIT_TOLERANCE
    good = np.isfinite(values).all(axis=1) & (matches.ranges > 0) & (matches.weights > 0) & unit
    good &= (matches.ranges <= _MAX_RANGE_M) & (np.abs(matches.uv) <= _MAX_PIXEL).all(axis=1)
    if not good.all():
        raise ShapeError(
            f"{int((~good).sum())} of {len(matches)} matches have NaN or infinity, a range or weight that is not "
            f"positive, a ray that is not of length 1, or a range or pixel beyond {_MAX_RANGE_M:g}; remove them"
        )


def _checked_threshold(threshold: object, count: int) -> FloatArray:
    if isinstance(threshold, np.ndarray) and threshold.ndim:
        per_match: FloatArray = read_only(threshold, np.float64, (count,), "the thresholds")
        if not ((per_match > 0) & (per_match < np.inf)).all():
            raise OptionError("the thresholds contain values that are not positive numbers; give metres along the ray")
        return per_match
    require_positive(threshold, "threshold_m")
    return np.full(count, float(threshold))  # type: ignore[arg-type]


def _checked_covariance(covariance: ArrayLike | None) -> FloatArray:
    matrix = read_only(np.zeros((6, 6)) if covariance is None else covariance, np.float64, (6, 6), "the covariance")
    if not np.isfinite(matrix).all():
        raise ShapeError("the covariance of the pose is not finite; omit it, or estimate the pose from more matches")
    return matrix
