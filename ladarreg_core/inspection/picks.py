"""What a pose says of every pick, those that are switched off included."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.arrays import FloatArray
from ladarreg_core.errors import LadarregError
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lines import along_line, line_on_scan
from ladarreg_core.picks.measure import SAMPLES_PER_LINE, matches_from_picks
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.quality.influence import influence
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import measured_ranges

_MOST_KNOWN = 4_000  # some kilobytes each


@dataclass(frozen=True, slots=True)
class JudgedPick:
    """What a pose says of one pick: of a line the worse of its ends."""

    px: float
    """Length of the pixel residual; NaN: none."""
    mm: float
    """Range residual, mm, signed; NaN: none."""
    depth_m: float
    """Laser minus stereo depth, m, signed; NaN where undefined."""
    inlier: bool | None
    """Whether the solver let it count; None: it was not asked."""
    influence_px: float
    """By how much the picture moves without it, px; NaN where that is not known."""
    photo: FloatArray
    """(1 or 2, 2) where the pose expects the scan side in the photo; NaN: nowhere."""


@dataclass(frozen=True, slots=True, eq=False)
class SampledLine:
    """The rays along a drawn line, and which of them have a range."""

    rays: FloatArray
    """(K, 3) unit, scanner frame."""
    known: tuple[bool, ...]
    """(K,) whether the scan has a range there."""
    sampled: int
    """How many rays the straight edge was looked for along."""
    used: int
    """How many of them lie on it; 0: the surface under the line is not straight."""


@dataclass(slots=True, eq=False)
class Measured:
    """What the scan measures under picks; kept, since a pick seldom changes while its neighbours do."""

    scan: Scan
    """The scan."""
    photo: Photo
    """The photo."""
    _known: dict[tuple[str, bytes, bytes, str, float], tuple[Matches, tuple[str, ...]]] = field(default_factory=dict)

    def of(self, pick: Pick) -> tuple[Matches, tuple[str, ...]]:
        """Return the matches of one pick, switched on or off, and what it lost."""
        key = (pick.id, pick.scan.tobytes(), pick.photo.tobytes(), pick.kind, pick.weight)
        if key not in self._known:
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            self._known[key] = matches_from_picks(self.scan, [replace(pick, on=True)], camera=self.photo.camera)
        return self._known[key]

    def joined(self, picks: Sequence[Pick]) -> Matches:
        """Return the matches of all picks."""
        return Matches.joined([m for m in (self.of(pick)[0] for pick in picks) if len(m)])

    def losses(self, picks: Sequence[Pick]) -> tuple[str, ...]:
        """Return what the picks that are switched on lost, in sentences."""
        return tuple(sentence for pick in picks if pick.on for sentence in self.of(pick)[1])


def judge_picks(measured: Measured, picks: Sequence[Pick], result: PoseResult) -> dict[str, JudgedPick]:
    """Return what a pose says of each pick that has a range.

    Args:
        measured: what the scan measures under picks.
        picks: any, on or off.
        result: the pose with the matches that it was solved from.
    """
    matches = measured.joined(picks)
    if not len(matches):
        return {}
    with np.errstate(all="ignore"):
        said = describe_pose(
            result.camera_from_scanner,
            matches,
            np.ones(len(matches), np.bool_),
            result.camera,
            sigma_px=result.sigma_px,
            sigma_range_m=result.sigma_range_m,
            covariance=result.covariance,
        )
        expected = result.camera.project(result.camera_from_scanner @ matches.points)
    moved, counted = _influences(result), _inliers(result)
    px = np.linalg.norm(said.residuals_px, axis=1)
    worth, mm = np.nan_to_num(px, nan=-1.0).tolist(), (1000 * said.residuals_m).tolist()
    depth_m = said.stereo_depth_error_m.tolist()
    by_pick: dict[str, list[int]] = {}
    for k, name in enumerate(matches.pick_ids):
        by_pick.setdefault(name, []).append(k)
    assert matches.fractions is not None
    ends = np.rint(matches.fractions).astype(int).tolist()
    found = {}
    for pick in picks:
        of_this = by_pick.get(pick.id)
        if not of_this:
            continue
        worst = max(of_this, key=worth.__getitem__)
        photo = np.full((len(pick.photo), 2), np.nan)
        for k in of_this:
            photo[ends[k]] = expected[k]
        found[pick.id] = JudgedPick(
            float(px[worst]),
            _largest([mm[k] for k in of_this]),
            _largest([depth_m[k] for k in of_this]),
            counted.get(pick.id),
            moved.get(pick.id, float("nan")),
            photo,
        )
    return found


def sample_line(scan: Scan, ends: ArrayLike, *, samples: int = SAMPLES_PER_LINE) -> SampledLine:
    """Return the rays along a line drawn on the scan and which of them have a range.

    Args:
        scan: the scan.
        ends: (2, 3) unit rays, scanner frame.
        samples: how many to show.
    """
    ends = np.asarray(ends, dtype=np.float64)
    rays = along_line(ends, np.linspace(0, 1, samples))
    known = np.isfinite(measured_ranges(scan, rays).outline)
    edge = line_on_scan(scan, ends)
    sampled, used = (edge.sampled, edge.used) if edge else (samples, 0)
    return SampledLine(rays, tuple(known.tolist()), sampled, used)


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
    """Return the value that is farthest from 0; NaN where there is none."""
    return max(filter(math.isfinite, values), key=abs, default=math.nan)


def picks_in_space(scan: Scan, picks: Sequence[Pick]) -> tuple[FloatArray, list[str], list[bool]]:
    """Return the points (N, 3) m, scanner frame, of all picks' ends, with pick id and switch of each; NaN: no range."""
    rays = [pick.scan for pick in picks]
    ids = [pick.id for pick in picks for _ in range(len(pick.scan))]
    on = [pick.on for pick in picks for _ in range(len(pick.scan))]
    if not rays:
        return np.zeros((0, 3)), ids, on
    directions = np.concatenate(rays)
    return directions * measured_ranges(scan, directions).outline[:, None], ids, on
