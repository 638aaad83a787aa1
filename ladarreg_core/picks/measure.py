"""Matches from picks: ranges of picked points and drawn lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.validation import require_choice, require_int
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.picks.lines import along_line, fraction_in_photo, kappa_of, line_on_scan
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import measured_ranges, range_quality, usual_noise_m

LineUse = Literal["ends", "equal", "kappa"]
"""`ends`: the two ends, with ranges from the whole line; `equal`: samples at constant intervals in both images, as in
the thesis; `kappa`: samples at constant intervals on the scan, placed in the photo by a pose."""
SAMPLES_PER_LINE = 9
"""Default number of samples along a drawn line."""
_MAX_SAMPLES = 1000
_COARSE_RAD, _COARSE_PX = 2e-3, 1.7  # least step of the coarser direction of a coarse scan: as an angle, in the photo
_OUTLINE_SIGMA = 0.03  # of the range, of a point on an outline


def check_samples(samples_per_line: object) -> None:
    """Raise an OptionError if the number of samples per line is invalid."""
    require_int(samples_per_line, "samples_per_line", least=2, most=_MAX_SAMPLES)


def check_line_use(lines: object) -> None:
    """Raise an OptionError if the use of lines is unknown."""
    require_choice(lines, get_args(LineUse), "the use of lines")


def matches_from_picks(
    scan: Scan,
    picks: Sequence[Pick],
    *,
    camera: CameraModel | None = None,
    lines: LineUse = "ends",
    samples_per_line: int = SAMPLES_PER_LINE,
    pose: Rigid | None = None,
) -> tuple[Matches, tuple[str, ...]]:
    """Return the matches of picks, and a sentence for everything left out.

    A pick that came with lengths keeps them; see `lengths` for their comparison with the scan. Of the others, a point
    gets the range of the surface under it; the ends of a line get theirs from the straight edge under it. A
    line without such an edge counts as two points. Samples of one line are not independent, so each has the weight
    1 / sqrt of their number. There is no match without a return, or if a depth edge runs under a point; of a scan much
    coarser than the photo, in which little but outlines can be picked, such a point belongs to the nearer surface.
    Ranges are weighted by the returned light, the incidence angle and the distance from depth edges.

    Args:
        scan: the scan.
        picks: points and lines; disabled ones are skipped, lines of length zero left out.
        camera: the photo's camera; matches outside its image are left out.
        lines: use of lines.
        samples_per_line: samples along each line, ends included.
        pose: `camera_from_scanner`, used by `kappa` to place the samples; None: constant intervals.

    Raises:
        OptionError: if `samples_per_line` is not a whole number from 2 to 1000, or `lines` is unknown.

    Source: thesis 2.3.1.
    """
    check_samples(samples_per_line)
    check_line_use(lines)
    builder = _MatchBuilder(outlines=camera is not None and _is_coarse(scan, camera))
    for pick in picks:
        if not pick.on:
            continue
        if pick.kind == "point":
            builder.points(scan, pick, np.zeros(1), pick.photo, pick.weight)
        elif (pick.scan[0] == pick.scan[1]).all() or (pick.photo[0] == pick.photo[1]).all():
            builder.notes.append(f"Match {pick.id} is a line of length zero and is left out; draw it again.")
        elif lines != "ends":
            along = np.linspace(0, 1, samples_per_line)
            in_photo = fraction_in_photo(along, _kappa(scan, pick, pose)) if lines == "kappa" and pose else along
            uv = pick.photo[0] + in_photo[:, None] * (pick.photo[1] - pick.photo[0])
            builder.points(scan, pick, along, uv, pick.weight / np.sqrt(samples_per_line))
        else:
            builder.line(scan, pick)
    return builder.matches(camera)


def _is_coarse(scan: Scan, camera: CameraModel) -> bool:
    step = max(scan.geometry.step_rad)
    return bool(step >= _COARSE_RAD and step * camera.focal_px >= _COARSE_PX)


@dataclass(slots=True)
class _MatchBuilder:
    """Collects the columns of the matches, pick by pick."""

    outlines: bool = False
    """Whether a point at a depth edge, or at the rim of a hole, is taken as one of the nearer surface's outline."""
    rays: list[FloatArray] = field(default_factory=list)
    ranges: list[FloatArray] = field(default_factory=list)
    edges: list[BoolArray] = field(default_factory=list)
    uv: list[FloatArray] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    fractions: list[FloatArray] = field(default_factory=list)
    weights: list[FloatArray] = field(default_factory=list)
    range_weights: list[FloatArray] = field(default_factory=list)
    ends: list[FloatArray] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def points(self, scan: Scan, pick: Pick, along: FloatArray, uv: FloatArray, weight: float) -> None:
        """Add points at fractions of a pick, each with the range of the surface under it."""
        rays = pick.scan if pick.kind == "point" else along_line(pick.scan, along)
        if pick.lengths_m is not None:
            self._stated(pick, rays, along, uv, weight)
            return
        found = measured_ranges(scan, rays)
        quality = range_quality(scan, rays, found)
        if not self.outlines:
            self._add(pick, rays, found.ranges, found.edge, uv, along, weight, quality)
            return
        on_outline = np.isnan(found.ranges) & np.isfinite(found.outline)
        ranges = np.where(on_outline, found.outline, found.ranges)
        sigma = usual_noise_m(scan) / (_OUTLINE_SIGMA * np.where(on_outline, ranges, 1))
        quality = np.where(on_outline, np.minimum(quality, sigma**2), quality)
        self._add(pick, rays, ranges, found.edge & ~on_outline, uv, along, weight, quality)

    def line(self, scan: Scan, pick: Pick) -> None:
        """Add both ends of a line with the ranges of the edge under it."""
        if pick.lengths_m is not None:
            self._stated(pick, pick.scan, np.array([0.0, 1.0]), pick.photo, pick.weight)
            return
        edge = line_on_scan(scan, pick.scan)
        if edge is None:
            self.notes.append(
                f"Match {pick.id}: the surface under the line is not straight, or has too few returns; only its ends "
                "are used, as points. Draw along a straight edge."
            )
            self.points(scan, pick, np.array([0.0, 1.0]), pick.photo, pick.weight)
            return
        no_edge = np.zeros(2, dtype=np.bool_)
        along = np.array([0.0, 1.0])
        self._add(pick, edge.rays, edge.ranges, no_edge, pick.photo, along, pick.weight, edge.range_weights)

    def _stated(self, pick: Pick, rays: FloatArray, along: FloatArray, uv: FloatArray, weight: float) -> None:
        """Add points with the lengths that came with the pick; between the ends of a line, those of a straight edge."""
        lengths = pick.lengths_m
        assert lengths is not None
        if pick.kind == "line":
            shares = rays @ np.linalg.pinv(pick.scan)  # of the two ends' directions, (K, 2)
            lengths = 1 / (shares / lengths).sum(axis=1)
        no_edge = np.zeros(len(rays), dtype=np.bool_)
        self._add(pick, rays, lengths, no_edge, uv, along, weight, np.ones(len(rays)))

    def _add(
        self,
        pick: Pick,
        rays: FloatArray,
        ranges: FloatArray,
        edge: BoolArray,
        uv: FloatArray,
        along: FloatArray,
        weight: float,
        range_weights: FloatArray,
    ) -> None:
        self.rays.append(rays)
        self.ranges.append(ranges)
        self.edges.append(edge)
        self.uv.append(uv)
        self.ids += [pick.id] * len(rays)
        self.fractions.append(along)
        self.weights.append(np.full(len(rays), weight))
        self.range_weights.append(range_weights)
        line = pick.photo if pick.kind == "line" else np.zeros((2, 2))
        self.ends.append(np.tile(line, (len(rays), 1, 1)))

    def matches(self, camera: CameraModel | None) -> tuple[Matches, tuple[str, ...]]:
        """Return the matches that have a range and are in the photo, and a sentence for every pick that lost points."""
        if not self.ids:
            return Matches.none(), (tuple(self.notes) or ("No match is enabled.",))
        uv, ranges, edge = np.concatenate(self.uv), np.concatenate(self.ranges), np.concatenate(self.edges)
        outside = np.zeros(len(uv), np.bool_) if camera is None else ~camera.contains(uv, border=-0.5)
        found = np.isfinite(ranges) & ~outside
        matches = Matches(
            np.concatenate(self.rays),
            np.where(found, ranges, 1),
            uv,
            tuple(self.ids),
            np.concatenate(self.fractions),
            np.concatenate(self.weights),
            np.concatenate(self.range_weights),
            _directions(np.concatenate(self.ends), uv, camera),
        )
        return matches.subset(found), (*self.notes, *_losses(self.ids, found, edge & ~outside, outside))


def _directions(ends: FloatArray, uv: FloatArray, camera: CameraModel | None) -> NDArray[np.float64]:
    """Return the unit directions (M, 2) of lines at their points; 0 for points.

    Args:
        ends: (M, 2, 2) pixels of each match's line, both the same for a point.
        uv: (M, 2) the points, pixels.
        camera: with distortion a straight edge is curved; the direction is that of the curve at the point.
    """
    along = ends[:, 1] - ends[:, 0]
    pinhole = None if camera is None else camera.as_pinhole
    if pinhole is not None and pinhole.distortion:
        ideal = pinhole.without_distortion()
        ends_there, here = ideal.project(pinhole.unproject(ends)), ideal.project(pinhole.unproject(uv))
        step = ends_there[:, 1] - ends_there[:, 0]
        step = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
        curved = pinhole.project(ideal.unproject(here + step)) - pinhole.project(ideal.unproject(here - step))
        along = np.where(np.isfinite(curved), curved, along)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(np.divide(along, length, out=np.zeros_like(along), where=length > 0))


def _kappa(scan: Scan, pick: Pick, pose: Rigid) -> NDArray[np.float64]:
    """Return kappa (1,) of a line by a pose; 1 if an end has no range."""
    edge = line_on_scan(scan, pick.scan)
    if edge is None:
        return np.ones(1)
    points = edge.rays * edge.ranges[:, None]
    forward = look_along(pick.scan.sum(axis=0))[2]
    return kappa_of((points @ forward)[None], (pose @ points)[None, :, 2])


def _losses(
    ids: list[str], found: NDArray[np.bool_], edge: NDArray[np.bool_], outside: NDArray[np.bool_]
) -> tuple[str, ...]:
    """Return a sentence for every pick that lost points, with the cause."""
    total = Counter(ids)
    at_edge = Counter(name for name, lost in zip(ids, (~found & edge).tolist(), strict=True) if lost)
    empty = Counter(name for name, lost in zip(ids, (~found & ~edge & ~outside).tolist(), strict=True) if lost)
    beyond = Counter(name for name, lost in zip(ids, outside.tolist(), strict=True) if lost)
    sentences = []
    for name in dict.fromkeys(ids):
        causes = [
            f"{count[name]} {words}"
            for count, words in (
                (beyond, "outside the photo"),
                (empty, "without a return"),
                (at_edge, "at a depth edge"),
            )
            if count[name]
        ]
        if causes:
            lost = at_edge[name] + empty[name] + beyond[name]
            sentences.append(f"Match {name}: {lost} of {total[name]} points are left out, {' and '.join(causes)}.")
    return tuple(sentences)
