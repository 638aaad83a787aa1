"""Corner matching of the thesis (Figure 2.13): corners, correlation, disparity filter, guided matching, lines."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.features.corners import CornerOptions, find_corners
from ladarreg_core.matching.features.correlation import check_window, correlation_product, unique_matches
from ladarreg_core.matching.images.photo_levels import PhotoLevels
from ladarreg_core.matching.images.scan_levels import ScanLevels
from ladarreg_core.matching.search.roll import Roll, detect_roll
from ladarreg_core.thesis.matching.densify import DensifyOptions, lines_between
from ladarreg_core.thesis.matching.search import (
    FilterSide,
    candidates_near,
    check_filter,
    consistent_displacements,
    disparities,
    matches_near,
    predicted_pixels,
    recentred,
    within_disparity,
)

DepthEdges = Literal["foreground", "left_out"]
GuidedFilter = Literal["prediction", "disparity"]
_MANY_CORNERS = CornerOptions(count=1500)
_MAX_FROM_PREDICTION_PX = 6.0  # of a guided match, from the median displacement from the prediction


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisMatchOptions:
    """Thresholds of thesis 2.3.2."""

    scan_corners: CornerOptions = _MANY_CORNERS
    """Corners of the intensity image."""
    photo_corners: CornerOptions = _MANY_CORNERS
    """Corners of the photo."""
    window_px: int = 15
    """Side of the correlation window."""
    t1: float = 0.2
    """T1: C1 - C2 must exceed it."""
    mutual: bool = False
    """Whether the match must also be the best one of the photo corner (mutual best match); not so in the thesis."""
    depth_edges: DepthEdges = "left_out"
    """Corners at a depth edge take the range of the `foreground`, or are `left_out`."""
    t2_px: float = 20.0
    """T2: largest deviation of a disparity from the median."""
    culling: FilterSide = "two_sided"
    """Side of the disparity filter; `one_sided` is the thesis's Step 5 literally."""
    search_px: float = 15.0
    """Half the side of the search window of guided matching."""
    first_search_px: float = 80.0
    """Half the side of a larger window searched first, whose matches recentre the small windows, because an approximate
    pose is wrong by more than these. Equal to `search_px`: the small windows only, as in the thesis."""
    constrained_t1: float = 0.1
    """T1 of guided matching, where competitors are few."""
    least_score: float = 0.4
    """Lower limit of C2 in guided matching, also for a corner with a single candidate."""
    second_culling: GuidedFilter = "prediction"
    """Filter of guided matches: by displacement from the `prediction`, or by `disparity` as before (`t2_px`)."""
    densify: DensifyOptions = field(default_factory=DensifyOptions)
    """Lines between matches."""

    def __post_init__(self) -> None:
        for name, expected_type in (
            ("scan_corners", CornerOptions),
            ("photo_corners", CornerOptions),
            ("densify", DensifyOptions),
            ("mutual", bool),
        ):
            if not isinstance(getattr(self, name), expected_type):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it must be a {expected_type.__name__}")
        check_window(self.window_px)
        check_filter(self.t2_px, self.culling)
        for name in ("t1", "constrained_t1", "least_score", "search_px", "first_search_px"):
            value, in_pixels = getattr(self, name), name.endswith("_px")
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not (number and np.isfinite(value) and (value > 0 if in_pixels else 0 <= value <= 2)):
                raise OptionError(f"{name} is {value!r}; it must be a number {_ALLOWED[in_pixels]}")
        for name, kind in (("depth_edges", DepthEdges), ("second_culling", GuidedFilter)):
            require_choice(getattr(self, name), get_args(kind), f"{name}")


_MAX_CORNERS = 4000  # all pairs are correlated
_WIDE_T1, _WIDE_SCORE, _WIDE_T2_PX = 0.1, 0.5, 15.0  # stricter, for the large window that recentres the small ones
_ALLOWED = {True: "of pixels above 0", False: "from 0 to 2"}


@dataclass(frozen=True, slots=True, eq=False)
class FoundMatches:
    """K matches of one search, as pixels of both images and as input of the solvers."""

    scan_uv: FloatArray
    """(K, 2) view pixels."""
    photo_uv: FloatArray
    """(K, 2) working pixels of the undistorted photo."""
    score: FloatArray
    """(K,) correlation C1; 1 for points along lines."""
    matches: Matches
    """The same in scanner rays and the photo's own pixels."""
    predicted_uv: FloatArray | None = None
    """(K, 2) working pixels predicted by guided matching; None: unconstrained."""

    def __len__(self) -> int:
        return len(self.scan_uv)

    def subset(self, keep: Any) -> FoundMatches:
        """Return the matches of a mask (K,) or of indices."""
        predicted = None if self.predicted_uv is None else self.predicted_uv[keep]
        return FoundMatches(
            self.scan_uv[keep], self.photo_uv[keep], self.score[keep], self.matches.subset(keep), predicted
        )


class ThesisSearch:
    """Matches one view of the scan with one photo; corners and correlations are computed once for both searches."""

    def __init__(self, scan: ScanLevels, photo: PhotoLevels, options: ThesisMatchOptions) -> None:
        self.scan = scan
        self.photo = photo
        self.options = options

    @cached_property
    def scan_uv(self) -> FloatArray:
        """(N, 2) view pixels of the intensity image's corners that have a range. Source: thesis 2.3.2."""
        usable = np.isfinite(self.scan.ranges)
        if self.options.depth_edges == "left_out":
            usable &= ~self.scan.edge
        return find_corners(self.scan.gray_planes[0], self.options.scan_corners, usable=usable).uv[:_MAX_CORNERS]

    @cached_property
    def photo_uv(self) -> FloatArray:
        """(M, 2) working pixels of the photo's corners. Source: thesis 2.3.2."""
        return find_corners(self.photo.gray, self.options.photo_corners, usable=self.photo.usable[0]).uv[:_MAX_CORNERS]

    @cached_property
    def correlation(self) -> FloatArray:
        """(N, M) mean of gray and edge correlation of every pair. Source: thesis 2.3.2, m_ij."""
        return correlation_product(
            self.scan.gray_planes[0], self.scan_uv, self.photo.gray, self.photo_uv, side_px=self.options.window_px
        )

    @cached_property
    def _points(self) -> FloatArray:
        """(N, 3) m, scanner frame, of the scan's corners."""
        pixel = np.rint(self.scan_uv).astype(np.intp)
        return self.scan.view.rays_at(self.scan_uv) * self.scan.ranges[pixel[:, 1], pixel[:, 0], None]

    def unconstrained(self, *, t1: float | None = None) -> FoundMatches:
        """Match all scan corners with all photo corners, with the options' T1 or another. Thesis 2.3.2, Step 1."""
        margin = self.options.t1 if t1 is None else t1
        first, second, score = unique_matches(self.correlation, margin=margin, mutual=self.options.mutual)
        return self._found(first, second, score)

    def constrained(self, camera_from_scanner: Rigid) -> FoundMatches:
        """Match every scan corner with the photo corners near its prediction by pose and range (guided matching).

        Source: thesis 2.3.2, Step 7.
        """
        o = self.options
        reach = max(o.search_px, o.first_search_px)
        expected = predicted_pixels(self._points, self.photo.cameras[0], camera_from_scanner, border_px=reach)
        if reach > o.search_px:
            near = candidates_near(expected, self.photo_uv, search_px=reach)
            first, second, _ = matches_near(
                self.correlation, near, margin=_WIDE_T1, least_score=_WIDE_SCORE, mutual=o.mutual
            )
            shift = self.photo_uv[second] - expected[first]
            sure = consistent_displacements(shift, most_px=_WIDE_T2_PX)
            expected = recentred(expected, expected[first[sure]], shift[sure])
        near = candidates_near(expected, self.photo_uv, search_px=o.search_px)
        first, second, score = matches_near(
            self.correlation, near, margin=o.constrained_t1, least_score=o.least_score, mutual=o.mutual
        )
        return self._found(first, second, score, expected[first])

    def filtered(self, found: FoundMatches) -> FoundMatches:
        """Return the matches without those of deviating disparity, or of deviating displacement from the prediction.

        Source: thesis 2.3.2, disparity culling, Steps 2-5.
        """
        o = self.options
        if found.predicted_uv is not None and o.second_culling == "prediction":
            shift = found.photo_uv - found.predicted_uv
            return found.subset(consistent_displacements(shift, most_px=_MAX_FROM_PREDICTION_PX))
        scan, photo = self.scan.cameras[0], self.photo.cameras[0]
        disparity = disparities(found.scan_uv - (scan.cx, scan.cy), found.photo_uv - (photo.cx, photo.cy))
        return found.subset(within_disparity(disparity, t2_px=o.t2_px, side=o.culling))

    def densified(self, found: FoundMatches, camera_from_scanner: Rigid | None = None) -> FoundMatches:
        """Add points along lines between matches on planar surfaces. Source: thesis 2.3.2, Figure 2.17."""
        lines = lines_between(
            self.scan,
            found.scan_uv,
            found.photo_uv,
            self.options.densify,
            pose=camera_from_scanner,
            photo_camera=self.photo.cameras[0],
        )
        if not len(lines.ranges):
            return found
        m = found.matches
        both = Matches(
            np.concatenate([m.rays, self.scan.view.rays_at(lines.scan_uv)]),
            np.concatenate([m.ranges, lines.ranges]),
            np.concatenate([m.uv, self._own_pixels(lines.photo_uv)]),
            (*m.pick_ids, *(f"l{k + 1}" for k in lines.line.tolist())),
            np.concatenate([m.fractions, lines.fraction]),
            np.concatenate([m.weights, lines.weight]),
        )
        return FoundMatches(
            np.concatenate([found.scan_uv, lines.scan_uv]),
            np.concatenate([found.photo_uv, lines.photo_uv]),
            np.concatenate([found.score, np.ones(len(lines.ranges))]),
            both,
        )

    def detect_roll(self) -> Roll | None:
        """Return the roll of the camera relative to the view; None if none is detected. Thesis 3.4."""
        return detect_roll(
            self.scan.gray_planes[0],
            self.scan_uv,
            self.photo.gray,
            self.photo_uv,
            window_px=self.options.window_px,
        )

    def _found(
        self, scan_index: IntArray, photo_index: IntArray, score: FloatArray, expected: FloatArray | None = None
    ) -> FoundMatches:
        scan_uv, photo_uv = self.scan_uv[scan_index], self.photo_uv[photo_index]
        points = self._points[scan_index]
        ranges = np.linalg.norm(points, axis=-1)
        matches = Matches(
            points / ranges[:, None],
            ranges,
            self._own_pixels(photo_uv),
            tuple(f"c{k + 1}" for k in scan_index.tolist()),
        )
        own = np.isfinite(matches.uv).all(axis=-1)
        found = FoundMatches(scan_uv, photo_uv, score, matches, expected)
        return found if own.all() else found.subset(own)

    def _own_pixels(self, uv: FloatArray) -> FloatArray:
        """Convert working pixels (K, 2) to the photo's own pixels."""
        return self.photo.source.project(self.photo.cameras[0].unproject(uv))
