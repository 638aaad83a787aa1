"""The thesis's correspondences, as in its Figure 2.13: corners, correlation, culling, the second search, lines."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from ladarreg_core.arrays import FloatArray, IntArray
from ladarreg_core.errors import OptionError
from ladarreg_core.features.corners import CornerOptions, find_corners
from ladarreg_core.features.correlation import check_window, correlation_product, unique_matches
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.pyramid import PhotoLevels, ScanLevels
from ladarreg_core.matching.roll import Turn, seems_turned
from ladarreg_core.matching.thesis.culling import CullingSide, alike, check_culling, disparities
from ladarreg_core.matching.thesis.densify import DensifyOptions, lines_between
from ladarreg_core.matching.thesis.search import (
    alike_displacements,
    candidates_near,
    matches_near,
    predicted_pixels,
    recentred,
)

DepthEdges = Literal["foreground", "left_out"]
SecondCulling = Literal["prediction", "disparity"]
_MANY_CORNERS = CornerOptions(count=1500)


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisMatchOptions:
    """The thresholds of thesis 2.3.2."""

    scan_corners: CornerOptions = _MANY_CORNERS
    """Of the intensity picture."""
    photo_corners: CornerOptions = _MANY_CORNERS
    """Of the photo."""
    window_px: int = 15
    """Side of the correlated neighbourhoods."""
    t1: float = 0.2
    """C1 - C2 must exceed it."""
    mutual: bool = False
    """Whether a scan corner must also be the best of its photo corner; the thesis does not ask."""
    depth_edges: DepthEdges = "left_out"
    """A corner at a depth edge takes the range of the `foreground`, or is `left_out`."""
    t2_px: float = 20.0
    """Largest deviation of a disparity from the median."""
    culling: CullingSide = "two_sided"
    """`one_sided` is the thesis's Step 5 to the letter."""
    search_px: float = 15.0
    """Half the side of the window of the second search."""
    first_search_px: float = 80.0
    """Half the side of a larger window that is searched before: what it finds moves the small windows around it, for
    a rough pose is wrong by more than they reach. As small as `search_px`: only these, as in the thesis."""
    constrained_t1: float = 0.1
    """T1 of the second search, where rivals are few."""
    least_score: float = 0.4
    """C2 counts as at least so much in the second search, also where a corner has no rival."""
    second_culling: SecondCulling = "prediction"
    """The second search is culled by how far matches lie from their `prediction`, or by `disparity` as the first."""
    second_t2_px: float = 6.0
    """Largest deviation from the median displacement from the prediction."""
    densify: DensifyOptions = field(default_factory=DensifyOptions)
    """Lines between matches."""

    def __post_init__(self) -> None:
        for name, wanted in (
            ("scan_corners", CornerOptions),
            ("photo_corners", CornerOptions),
            ("densify", DensifyOptions),
            ("mutual", bool),
        ):
            if not isinstance(getattr(self, name), wanted):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it must be a {wanted.__name__}")
        check_window(self.window_px)
        check_culling(self.t2_px, self.culling)
        check_culling(self.second_t2_px, self.culling)
        for name in ("t1", "constrained_t1", "least_score", "search_px", "first_search_px"):
            value, in_pixels = getattr(self, name), name.endswith("_px")
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not (number and np.isfinite(value) and (value > 0 if in_pixels else 0 <= value <= 2)):
                raise OptionError(f"{name} is {value!r}; it must be a number {_SPAN[in_pixels]}")
        for name, kind in (("depth_edges", DepthEdges), ("second_culling", SecondCulling)):
            if getattr(self, name) not in get_args(kind):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it must be one of {', '.join(get_args(kind))}")


_MOST_CORNERS = 4000  # every one is compared with every other
_SURE_T1, _SURE_SCORE, _SURE_T2_PX = 0.1, 0.5, 15.0  # of the large window, whose matches only move the small ones
_SPAN = {True: "of pixels above 0", False: "from 0 to 2"}


@dataclass(frozen=True, slots=True, eq=False)
class FoundMatches:
    """K matches of one search, as the interface draws them and as a solver eats them."""

    scan_uv: FloatArray
    """(K, 2) view pixels."""
    photo_uv: FloatArray
    """(K, 2) working pixels of the undistorted photo."""
    score: FloatArray
    """(K,) correlation C1; 1 for points along lines."""
    matches: Matches
    """The same in scanner rays and the photo's own pixels."""
    predicted_uv: FloatArray | None = None
    """(K, 2) working pixels where the second search expected them."""

    def __len__(self) -> int:
        return len(self.scan_uv)

    def subset(self, keep: Any) -> FoundMatches:
        """Return those of a mask (K,)."""
        predicted = None if self.predicted_uv is None else self.predicted_uv[keep]
        return FoundMatches(
            self.scan_uv[keep], self.photo_uv[keep], self.score[keep], self.matches.subset(keep), predicted
        )


class ThesisSearch:
    """One view of the scan and one photo; corners and correlations are made once for both searches."""

    def __init__(self, scan: ScanLevels, photo: PhotoLevels, options: ThesisMatchOptions) -> None:
        self.scan = scan
        self.photo = photo
        self.options = options

    @cached_property
    def scan_uv(self) -> FloatArray:
        """(N, 2) view pixels of the intensity picture's corners, those with a range. Source: thesis 2.3.2."""
        usable = np.isfinite(self.scan.ranges)
        if self.options.depth_edges == "left_out":
            usable &= ~self.scan.edge
        return find_corners(self.scan.gray_planes[0], self.options.scan_corners, usable=usable).uv[:_MOST_CORNERS]

    @cached_property
    def photo_uv(self) -> FloatArray:
        """(M, 2) working pixels of the photo's corners. Source: thesis 2.3.2."""
        return find_corners(self.photo.gray, self.options.photo_corners, usable=self.photo.usable[0]).uv[:_MOST_CORNERS]

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
        """Match every scan corner with every photo corner, by the options' T1 or another. Thesis 2.3.2, Step 1."""
        margin = self.options.t1 if t1 is None else t1
        first, second, score = unique_matches(self.correlation, margin=margin, mutual=self.options.mutual)
        return self._found(first, second, score)

    def constrained(self, camera_from_scanner: Rigid) -> FoundMatches:
        """Match every scan corner with the photo corners near where the pose and its range say that it is.

        Source: thesis 2.3.2, Step 7.
        """
        o = self.options
        reach = max(o.search_px, o.first_search_px)
        expected = predicted_pixels(self._points, self.photo.cameras[0], camera_from_scanner, border_px=reach)
        if reach > o.search_px:
            near = candidates_near(expected, self.photo_uv, search_px=reach)
            first, second, _ = matches_near(
                self.correlation, near, margin=_SURE_T1, least_score=_SURE_SCORE, mutual=o.mutual
            )
            shift = self.photo_uv[second] - expected[first]
            sure = alike_displacements(shift, most_px=_SURE_T2_PX)
            expected = recentred(expected, expected[first[sure]], shift[sure])
        near = candidates_near(expected, self.photo_uv, search_px=o.search_px)
        first, second, score = matches_near(
            self.correlation, near, margin=o.constrained_t1, least_score=o.least_score, mutual=o.mutual
        )
        return self._found(first, second, score, expected[first])

    def culled(self, found: FoundMatches) -> FoundMatches:
        """Leave out what moved unlike the others: by disparity, or from where the second search expected it.

        Source: thesis 2.3.2, disparity culling, Steps 2-5.
        """
        o = self.options
        if found.predicted_uv is not None and o.second_culling == "prediction":
            shift = found.photo_uv - found.predicted_uv
            return found.subset(alike_displacements(shift, most_px=o.second_t2_px))
        scan, photo = self.scan.cameras[0], self.photo.cameras[0]
        disparity = disparities(found.scan_uv - (scan.cx, scan.cy), found.photo_uv - (photo.cx, photo.cy))
        return found.subset(alike(disparity, t2_px=o.t2_px, side=o.culling))

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
        assert m.fractions is not None
        assert m.weights is not None
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

    def seems_turned(self) -> Turn | None:
        """Return by how much the photo seems rolled against the view; None where upright fits best. Thesis 3.4."""
        return seems_turned(
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
        """Return the photo's own pixels of working ones (K, 2)."""
        return self.photo.source.project(self.photo.cameras[0].unproject(uv))
