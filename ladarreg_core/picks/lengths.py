"""Lengths that came with matches, such as those of a surveyor's targets, compared with the scan's own ranges.

A match whose scan coordinate is a point keeps its length as its range. The scan is tied to the point only if both
agree, so every length is compared with the scan's own range along the same ray; one beyond its tolerance refuses the
result, whatever the residuals say: a common scale error changes none of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.matches import Pick
from ladarreg_core.pose.options import STATED_SIGMA_RANGE_M
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import EDGE_FRACTION, measured_ranges, range_quality, usual_noise_m

ResultT = TypeVar("ResultT", bound=PoseResult)
Comparability = Literal["compared", "no return", "depth edge", "outside the scan"]
MIN_TOLERANCE_M = 0.05
"""Difference from the scan's own range that is always allowed, m, if no tolerance is given."""
MIN_OFF_SCALE = 0.01
"""Common ratio of the lengths to the scan's ranges, less 1, from which on it is called a scale."""
_SIGMAS = 3.0
_MIN_OF_A_SCALE = 3
_SAME_RATIO = 0.25  # scatter of the ratios, relative to their distance from 1
_MAX_OTHERS = 0.2  # share of the lengths that may have another ratio
_NAMED = 3
_UNITS = {
    1000.0: "They look like millimetres.",
    100.0: "They look like centimetres.",
    3.28084: "They look like feet.",
    39.3701: "They look like inches.",
    0.3048: "The scan may be in feet.",
    0.01: "The scan may be in centimetres.",
    0.001: "The scan may be in millimetres.",
}
_SAME_UNIT = 0.02


@dataclass(frozen=True, slots=True)
class LengthOfMatch:
    """The length of one end of a match, and the scan's own range along the same ray."""

    pick_id: str
    """Id of the match."""
    end: int
    """0, or 1 for the second end of a line."""
    name: str
    """Name of the match; its id if it has none."""
    length_m: float
    """As stated by the source of the match, m from the scanner."""
    scan_range_m: float | None
    """Of the scan along the same ray, m; None: none to compare with."""
    tolerance_m: float
    """Largest difference allowed, m."""
    state: Comparability
    """Whether the scan has a range there."""

    @property
    def difference_m(self) -> float | None:
        """Length minus the scan's range, m; None where there is none."""
        return None if self.scan_range_m is None else self.length_m - self.scan_range_m

    @property
    def is_beyond(self) -> bool:
        """Whether it differs by more than its tolerance."""
        return self.difference_m is not None and abs(self.difference_m) > self.tolerance_m


@dataclass(frozen=True, slots=True)
class LengthCheck:
    """All lengths that came with matches, compared with the scan."""

    lengths: tuple[LengthOfMatch, ...]
    """In the order of the matches."""
    tolerance_m: float | None
    """The tolerance given, m; None: the default."""
    scale: float | None
    """Common ratio of the lengths to the scan's ranges if they have one that is not 1."""
    fits_world: bool = False
    """Whether the points would agree with the scan if they were coordinates of the world."""

    @property
    def compared(self) -> tuple[LengthOfMatch, ...]:
        """Those that the scan has a range for."""
        return tuple(one for one in self.lengths if one.scan_range_m is not None)

    @property
    def beyond(self) -> tuple[LengthOfMatch, ...]:
        """Those beyond their tolerance, the worst first."""
        return tuple(
            sorted((one for one in self.lengths if one.is_beyond), key=lambda one: -abs(one.difference_m or 0))
        )

    @property
    def refusal(self) -> tuple[str, ...]:
        """Return the reasons to refuse a result on these lengths, as sentences; empty: there are none."""
        found = []
        outside = sum(one.state == "outside the scan" for one in self.lengths)
        if not self.compared and outside > len(self.lengths) / 2:
            found.append(
                f"None of the {len(self.lengths)} points can be compared with the scan, {outside} of them lie outside "
                "of what it saw: check their frame and where the scanner stood."
            )
        if self.beyond and self.scale is not None:
            same = "All lengths" if len(self.beyond) == len(self.compared) else "Most lengths"
            unit = next((words for k, words in _UNITS.items() if abs(self.scale / k - 1) < _SAME_UNIT), "")
            found.append(f"{same} are {_shown_scale(self.scale)} x the scan's: unit or scale? {unit}".rstrip())
        if self.beyond:
            worst = "; ".join(
                f"{one.name} {one.difference_m:+.3f} m ({one.length_m:.3f} m, the scan {one.scan_range_m:.3f} m)"
                for one in self.beyond[:_NAMED]
            )
            more = f" and {len(self.beyond) - _NAMED} more" if len(self.beyond) > _NAMED else ""
            given = self.tolerance_m is not None
            limit = "" if self.tolerance_m is None else f"{format_length(self.tolerance_m)}"
            least = f"{format_length(MIN_TOLERANCE_M)} or {_SIGMAS:g} sigma of the scan's range"
            verb = "differs" if len(self.beyond) == 1 else "differ"
            found.append(
                f"{len(self.beyond)} of {len(self.compared)} lengths {verb} from the scan's own range by more than "
                f"{limit if given else least}: {worst}{more}. Correct or remove these matches, or allow more "
                "by `match_tolerance_m`."
            )
        if found and self.fits_world:
            found.insert(0, "The points agree with the scan as coordinates of the world: state the frame 'world'.")
        return tuple(found)

    @property
    def note(self) -> str:
        """A sentence on the lengths that the scan has no range for; empty: there are none."""
        alone = list(dict.fromkeys(one.name for one in self.lengths if one.scan_range_m is None))
        if not alone:
            return ""
        named = f"{', '.join(alone[:_NAMED])}" + (f" and {len(alone) - _NAMED} more" if len(alone) > _NAMED else "")
        own = "its own length is" if len(alone) == 1 else "their own lengths are"
        return f"The scan has no range to compare with at {named}: {own} used."

    def as_dict(self) -> dict[str, Any]:
        """Return the check, JSON-ready."""
        differences = [abs(one.difference_m) for one in self.compared if one.difference_m is not None]
        return {
            "matches": [
                {**asdict(one), "difference_m": one.difference_m, "beyond": one.is_beyond} for one in self.lengths
            ],
            "compared": len(differences),
            "largest_m": max(differences, default=None),
            "scale": self.scale,
            "tolerance_m": self.tolerance_m,
            "refusal": list(self.refusal),
        }


def check_lengths(scan: Scan, picks: Sequence[Pick], *, tolerance_m: float | None = None) -> LengthCheck | None:
    """Compare the lengths that came with the enabled picks with the scan's own ranges.

    Args:
        scan: the scan.
        picks: points and lines, with lengths or without.
        tolerance_m: largest difference allowed, m; None: three standard deviations of the scan's range there (of its
            noise or 15 mm for a usual return; more for weak and grazing ones, up to 4 % of it), and 5 cm at least.

    Returns:
        the check; None if no enabled pick has a length.
    """
    ends = [(pick, end) for pick in picks if pick.on and pick.lengths_m is not None for end in range(len(pick.scan))]
    if not ends:
        return None
    rays = np.array([pick.scan[end] for pick, end in ends])
    lengths = np.array([pick.lengths_m[end] for pick, end in ends if pick.lengths_m is not None])
    ranges, states = _scan_ranges(scan, rays, lengths)
    tolerances = np.full(len(ends), tolerance_m)
    if tolerance_m is None:
        sigma = max(STATED_SIGMA_RANGE_M, usual_noise_m(scan)) / np.sqrt(range_quality(scan, rays))
        with np.errstate(invalid="ignore"):
            widest = np.fmax(EDGE_FRACTION * ranges, MIN_TOLERANCE_M)
        tolerances = np.clip(_SIGMAS * sigma, MIN_TOLERANCE_M, widest)
    found = tuple(
        LengthOfMatch(
            pick.id, end, pick.name or pick.id, float(lengths[k]),
            float(ranges[k]) if np.isfinite(ranges[k]) else None, float(tolerances[k]), states[k],
        )
        for k, (pick, end) in enumerate(ends)
    )  # fmt: skip
    check = LengthCheck(found, tolerance_m, _common_scale(lengths, ranges))
    return replace(check, fits_world=bool(check.refusal) and _fit_world(scan, rays * lengths[:, None], tolerances))


def with_lengths_checked(
    result: ResultT, scan: Scan, picks: Sequence[Pick], *, tolerance_m: float | None = None
) -> ResultT:
    """Return a result with the figures of `check_lengths` in its diagnostics; refused if a length is beyond tolerance.

    A result of picks without lengths is returned as it is.
    """
    check = check_lengths(scan, picks, tolerance_m=tolerance_m)
    if check is None:
        return result
    return refused_by_lengths(
        replace(
            result,
            diagnostics={**result.diagnostics, "lengths": check.as_dict()},
            reasons=tuple(dict.fromkeys((*result.reasons, *filter(None, [check.note])))),
        )
    )


def refused_by_lengths(result: ResultT) -> ResultT:
    """Return a result as it is, or refused for the lengths in its diagnostics; the reasons are stated once."""
    refusal = tuple((result.diagnostics.get("lengths") or {}).get("refusal") or ())
    if not refusal:
        return result
    reasons = tuple(dict.fromkeys((*refusal, *result.reasons)))
    return replace(result, accepted=False, evidence="none", reasons=reasons)


def lengths_by_end(diagnostics: Mapping[str, Any]) -> dict[tuple[str, int], Mapping[str, Any]]:
    """Return the figures of `with_lengths_checked` by the id and the end of their match; empty if there are none."""
    listed = (diagnostics.get("lengths") or {}).get("matches") or ()
    return {(str(one["pick_id"]), int(one["end"])): one for one in listed}


def _scan_ranges(scan: Scan, rays: FloatArray, lengths: FloatArray) -> tuple[FloatArray, list[Comparability]]:
    """Return the scan's ranges (K,) along rays, NaN where there is none to compare with, and why.

    At a depth edge a length between the two surfaces may be right. Beyond both it is not, and is compared with the
    nearer one of them.
    """
    found = measured_ranges(scan, rays)
    cells = np.asarray(scan.geometry.cell_of(rays), dtype=np.float64)
    with np.errstate(invalid="ignore"):
        outside = ~np.all((cells >= -0.5) & (cells <= np.array(scan.shape) - 0.5), axis=1)
    corners = scan.ranges.reshape(-1)[found.cells].astype(np.float64)
    ranges, states = found.ranges.copy(), []
    for k, length in enumerate(lengths):
        if outside[k]:
            ranges[k] = np.nan
            states.append("outside the scan")
        elif np.isfinite(ranges[k]):
            states.append("compared")
        elif found.edge[k]:
            nearest = float(corners[k][np.argmin(np.abs(corners[k] - length))])
            between = corners[k].min() - MIN_TOLERANCE_M <= length <= corners[k].max() + MIN_TOLERANCE_M
            ranges[k] = np.nan if between else nearest
            states.append("depth edge")
        else:
            states.append("no return")
    return ranges, states  # type: ignore[return-value]  # of literals


def _fit_world(scan: Scan, points: FloatArray, tolerances: FloatArray) -> bool:
    """Return whether points (K, 3) lie on the scan's surfaces if they are taken as coordinates of the world."""
    pose = scan.world_from_scanner
    if pose is None or len(points) < _MIN_OF_A_SCALE:
        return False
    there = (points - pose.translation) @ pose.rotation
    lengths = np.linalg.norm(there, axis=1)
    if not (lengths > 0).all():
        return False
    ranges, _ = _scan_ranges(scan, there / lengths[:, None], lengths)
    with np.errstate(invalid="ignore"):
        near = np.abs(lengths - ranges) <= np.maximum(tolerances, MIN_TOLERANCE_M)
    return bool(np.mean(near) >= 1 - _MAX_OTHERS)


def _shown_scale(scale: float) -> str:
    return f"{scale:.3g}" if scale < 0.1 else f"{scale:.2f}" if scale < 100 else f"{scale:.0f}"


def _common_scale(lengths: FloatArray, ranges: FloatArray) -> float | None:
    known = np.isfinite(ranges)
    if np.count_nonzero(known) < _MIN_OF_A_SCALE:
        return None
    ratios = lengths[known] / ranges[known]
    scale = float(np.median(ratios))
    off = np.abs(ratios / scale - 1) > _SAME_RATIO * abs(scale - 1)
    return scale if abs(scale - 1) >= MIN_OFF_SCALE and np.mean(off) <= _MAX_OTHERS else None
