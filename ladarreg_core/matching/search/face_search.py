"""Initial poses of a wide photograph: corners of its faces matched with corners of views of the scan, at every roll.

Each pair of a face and a view gives a pose hypothesis from its own matches. The hypothesis with the most inliers over
all pairs is tried first, since the poses of all faces are one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matching.features.correlation import unique_matches
from ladarreg_core.matching.images.faces import Face, FaceSet, icosahedron
from ladarreg_core.matching.images.laser_images import CleanedScan
from ladarreg_core.matching.images.photo_levels import PhotoLevels
from ladarreg_core.matching.images.scan_levels import ChannelSet, ScanLevels, scan_levels
from ladarreg_core.matching.images.views import viewing_directions
from ladarreg_core.matching.search.hypotheses import photo_corners, points_at, view_corners
from ladarreg_core.matching.search.roll import describe_rotated, rotate_pixels
from ladarreg_core.pose.estimators.ransac import ransac_pose
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

_ROLLS = 12
_FEW_VIEWS = 3
_MIN_SHARE = 0.02  # of the scan in a view
_MAX_CORNERS = 500
_MARGIN = 0.02
_SAME_DISPLACEMENT_PX = 30.0
_MIN_AGREEING = 5
_MAX_SOLVED = 48
_RANSAC_PX, _RANSAC_ITERATIONS = 4.0, 400
_MIN_INLIERS = 7
_SUPPORT_RAD = float(np.radians(1.0))
_SAME_ANGLE_RAD, _SAME_M = float(np.radians(6.0)), 0.4


@dataclass(frozen=True, slots=True, eq=False)
class FaceHypothesis:
    """A pose hypothesis of the whole photograph."""

    camera_from_scanner: Rigid
    """The pose."""
    face: Face
    """The face whose matches it was found from."""
    inliers: int
    """Their number."""
    support: int
    """Number of matches of all faces that it explains."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    face: int
    view: int
    scan_index: NDArray[np.intp]
    photo_index: NDArray[np.intp]
    agreeing: int


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    levels: ScanLevels | PhotoLevels
    uv: NDArray[np.float64]
    vectors: FloatArray
    """(N, 3): scan points, m, or rays of the photograph's camera."""


class FaceSearch:
    """Searches pose hypotheses of a wide photograph.

    Args:
        scan: the scan.
        cleaned: its images.
        faces: the faces of the photograph.
        working: the ideal camera of the search.
        channel_set: channels to compare.
        seed: random seed of RANSAC.
    """

    def __init__(
        self,
        scan: Scan,
        cleaned: CleanedScan,
        faces: FaceSet,
        working: Camera,
        *,
        channel_set: ChannelSet,
        seed: int,
    ) -> None:
        self._faces = faces
        self._working = working
        self._seed = seed
        self._views = [self._corners_of_view(scan, cleaned, d, channel_set) for d in _directions(scan, working)]
        self._pictures = [self._corners_of_face(face) for face in faces.faces]
        self._described = [
            describe_rotated(view.levels.channels[0], view.uv, 0.0) if len(view.uv) else None for view in self._views
        ]

    @property
    def views(self) -> int:
        """Number of views of the scan."""
        return len(self._views)

    def hypotheses(self, *, rolled: bool) -> list[FaceHypothesis]:
        """Return hypotheses, likeliest first, with distinct poses: upright ones, or those of rolled faces."""
        turns = np.arange(1, _ROLLS) if rolled else np.arange(1)
        angles = [float(2 * np.pi * k / _ROLLS) for k in turns]
        return self._ranked([pair for angle in angles for pair in self._matched(angle)])

    def _ranked(self, pairs: list[_Pair]) -> list[FaceHypothesis]:
        likely = sorted(pairs, key=lambda pair: -pair.agreeing)[:_MAX_SOLVED]
        found = []
        for pair in likely:
            view, picture, face = self._views[pair.view], self._pictures[pair.face], self._faces.faces[pair.face]
            result = ransac_pose(
                view.vectors[pair.scan_index],
                picture.uv[pair.photo_index],
                self._working,
                threshold_px=_RANSAC_PX,
                iterations=_RANSAC_ITERATIONS,
                seed=self._seed,
            )
            if result is None or int(result.inliers.sum()) < _MIN_INLIERS:
                continue
            whole = face.face_from_camera.inverse @ result.camera_from_scanner
            found.append(FaceHypothesis(whole, face, int(result.inliers.sum()), self._support(whole, pairs)))
        found.sort(key=lambda item: -item.support)
        distinct: list[FaceHypothesis] = []
        for item in found:
            pose = item.camera_from_scanner
            if not any(
                pose.angle_to(o.camera_from_scanner) < _SAME_ANGLE_RAD
                and pose.distance_to(o.camera_from_scanner) < _SAME_M
                for o in distinct
            ):
                distinct.append(item)
        return distinct

    def _support(self, pose: Rigid, pairs: Sequence[_Pair]) -> int:
        """Return the number of corners of the photograph with a match that a pose explains."""
        by_face: dict[int, set[int]] = {}
        for pair in pairs:
            rays = pose @ self._views[pair.view].vectors[pair.scan_index]
            rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
            near = (rays * self._pictures[pair.face].vectors[pair.photo_index]).sum(axis=-1) > np.cos(_SUPPORT_RAD)
            by_face.setdefault(pair.face, set()).update(pair.photo_index[near].tolist())
        return sum(len(corners) for corners in by_face.values())

    def _matched(self, angle: float) -> list[_Pair]:
        """Return the unique matches of every pair of a view and a face rolled by an angle, rad."""
        pairs = []
        for k, picture in enumerate(self._pictures):
            if len(picture.uv) < _MIN_AGREEING:
                continue
            described = describe_rotated(picture.levels.channels[0], picture.uv, angle)
            for j, (view, rows) in enumerate(zip(self._views, self._described, strict=True)):
                if rows is None:
                    continue
                first, second, _ = unique_matches(rows @ described.T, margin=_MARGIN)
                if len(first) < _MIN_AGREEING:
                    continue
                agreeing = _agreeing(view.uv[first], picture.uv[second], angle)
                if agreeing >= _MIN_AGREEING:
                    pairs.append(_Pair(k, j, first, second, agreeing))
        return pairs

    def _corners_of_view(self, scan: Scan, cleaned: CleanedScan, direction: Rigid, channel_set: ChannelSet) -> _Corners:
        view = perspective_view(scan, self._working, view_from_scanner=direction)
        levels = scan_levels(scan, view, channel_set=channel_set, cleaned=cleaned)
        uv = view_corners(levels)
        points = points_at(levels, uv)
        known = np.isfinite(points).all(axis=-1)
        return _Corners(levels, uv[known][:_MAX_CORNERS], points[known][:_MAX_CORNERS])

    def _corners_of_face(self, face: Face) -> _Corners:
        levels = self._faces.levels(face, self._working, own=False)
        uv = photo_corners(levels)[:_MAX_CORNERS]
        return _Corners(levels, uv, self._working.unproject(uv) @ face.face_from_camera.rotation)


def _directions(scan: Scan, working: Camera) -> list[Rigid]:
    """Return the views (view from scanner) that cover the scan."""
    few = viewing_directions(scan, working)
    if len(few) <= _FEW_VIEWS:
        return few
    rays, cosine = scan.sampled_directions, np.cos(np.arctan(0.5 * working.width / working.fx))
    axes = icosahedron(np.array([0.0, 0.0, 1.0]))
    share = (rays @ axes.T > cosine).mean(axis=0)
    return [Rigid(look_along(axis), np.zeros(3)) for axis in axes[share >= _MIN_SHARE]]


def _agreeing(scan_uv: NDArray[np.float64], photo_uv: NDArray[np.float64], angle: float) -> int:
    """Return the largest number of matches with similar displacements, the view being rotated by the angle."""
    displacement = photo_uv - rotate_pixels(scan_uv, angle)
    between = displacement[:, None] - displacement[None]
    return int((np.hypot(between[..., 0], between[..., 1]) <= _SAME_DISPLACEMENT_PX).sum(axis=1).max())
