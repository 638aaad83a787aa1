"""The matches in space: points in the colours of their numbers or residuals, and the rays on which they were picked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.export.models.viser_colors import line_colors_for_viewer
from ladarreg_core.foundations.palette import BACKGROUND, HIGHLIGHT, MATCHES, UNKNOWN, ramp_colors
from ladarreg_core.inspection.scene_geometry import Marks, for_both_ends, marks_of_result, rays_to, repeated, spread

if TYPE_CHECKING:
    import viser
    from numpy.typing import ArrayLike

    from ladarreg_core.foundations.arrays import ByteArray, FloatArray
    from ladarreg_core.results.registration import PoseResult

    from .model_view import ModelChoice
    from .place import Place
    from .subject import Subject

_POINT_SIZE_PER_RANGE = 0.006
_CLICK_RADIUS, _HIGHLIGHTED, _HALO = 1.1, 1.6, 2.4
_OFFSET = 2.0
"""Distance in front of the surface, in point sizes: a marker on the surface would be half hidden in it."""
_MAX_RAYS, _MAX_RESULT_MATCHES = 24, 16
_OFF_SHARE, _RAY_SHARE = 0.65, 0.5
_MIN_RESIDUAL_PX = 1.0
"""The scale of the residuals ends here at least: smaller ones are all good."""


@dataclass(frozen=True)
class Picks:
    """The matches to show."""

    marks: Marks
    """Their points."""
    ids: tuple[str, ...]
    """Pick id of each point."""
    by_residual: ByteArray
    """(N, 3) uint8 RGB, the colours of their residuals."""

    @staticmethod
    def of(
        points: ArrayLike,
        colors: ArrayLike,
        on: ArrayLike,
        ids: Sequence[str],
        *,
        by_residual: ArrayLike | None = None,
    ) -> Picks:
        """Return the picks that have a position; one without a range has none.

        Args:
            points: (N, 3) m, scanner frame; NaN where a match has no position.
            colours: (N, 3) uint8 RGB.
            on: (N,) bool; matches that are off are dimmed.
            ids: pick id of each point; several points may share one.
            by_residual: (N, 3) uint8 RGB; None: there are no residuals.
        """
        marks = Marks.of(points, colors, on)
        shades = np.asarray(colors if by_residual is None else by_residual, dtype=np.uint8).reshape(-1, 3)
        return Picks(marks, tuple(ids[k] for k in marks.given), shades[marks.given])

    def with_colors(self, *, of_residuals: bool) -> Picks:
        """Return the picks with the colours of their residuals instead of those of their numbers."""
        return replace(self, marks=replace(self.marks, colors=self.by_residual)) if of_residuals else self


class PicksLayer:
    """Points and rays; without picks, the matches of the accepted pose are shown."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._nodes: list[viser.SceneNodeHandle] = []
        self._points: list[viser.PointCloudHandle] = []
        self._marked: list[viser.SceneNodeHandle] = []
        self._drawn: tuple[object, ...] = ()
        self._shown: Picks | None = None
        self._centres: tuple[FloatArray, ...] = ()
        self._range_m = 1.0
        self._visible = True

    def draw(self, subject: Subject | None, picks: Picks | None, choice: ModelChoice) -> None:
        """Draw the matches, unless they are drawn already."""
        requested = (subject, picks, choice.matches, choice.rays, choice.residuals)
        if requested == self._drawn:
            return
        self.clear()
        self._drawn, self._visible = requested, choice.matches
        if subject is None:
            return
        accepted = subject.accepted
        if accepted is not None and (picks is None or not picks.ids):
            picks = _picks_of_result(accepted)
        if picks is None or not picks.ids:
            return
        self._shown, self._range_m = picks.with_colors(of_residuals=choice.residuals), subject.shown.range_m
        self._centres = (subject.scanner_centre,)
        if accepted is not None:
            self._centres += (accepted.camera_from_scanner.centre,)
        if choice.rays:
            self._draw_rays(self._shown)
        self._draw_points(self._shown)
        for node in (*self._nodes, *self._points):
            node.visible = choice.matches

    def highlight(self, pick_id: str | None) -> None:
        """Mark one pick, or none."""
        for node in self._marked:
            node.remove()
        self._marked = []
        if self._shown is None or pick_id is None or not self._visible:
            return
        marks = self._shown.marks.chosen([name == pick_id for name in self._shown.ids])
        if not len(marks):
            return
        lines = rays_to(marks.points, self._centres)
        colors = line_colors_for_viewer(for_both_ends(repeated(HIGHLIGHT, len(lines))))
        scene = self._place.scene
        self._marked.append(
            scene.add_line_segments(
                "/highlight/rays", points=lines, colors=colors, thickness=2.2, thickness_units="screen"
            )
        )
        for name, shade, size in (
            ("halo", repeated(HIGHLIGHT, len(marks)), _HALO),
            ("point", marks.colors, _HIGHLIGHTED),
        ):
            self._marked.append(self._add_points(f"/highlight/{name}", marks, shade, size))

    def nearest(self, event: viser.SceneClickEvent) -> str | None:
        """Return the id of the pick that a click hits."""
        # viser's point clouds are not clickable, and spheres, which are, need a shader that takes seconds to compile
        # without a graphics card.
        shown = self._shown
        if shown is None or not self._visible:
            return None
        hit = shown.marks.nearest_to_ray(
            event.ray_origin, event.ray_direction, radius_m=_CLICK_RADIUS * self._point_size
        )
        return None if hit is None else shown.ids[hit]

    def clear(self) -> None:
        """Remove everything."""
        for node in (*self._nodes, *self._points, *self._marked):
            node.remove()
        self._nodes, self._points, self._marked, self._shown, self._drawn = [], [], [], None, ()

    def _draw_rays(self, picks: Picks) -> None:
        marks = picks.marks.at(spread(len(picks.marks), _MAX_RAYS))
        for name, centre in zip(("scanner", "camera"), self._centres, strict=False):
            lines = rays_to(marks.points, (centre,))
            colors = line_colors_for_viewer(for_both_ends(marks.dimmed(BACKGROUND, on=_RAY_SHARE, off=_OFF_SHARE)))
            self._nodes.append(
                self._place.scene.add_line_segments(
                    f"/matches/{name}_rays", points=lines, colors=colors, thickness=1.0, thickness_units="screen"
                )
            )

    def _draw_points(self, picks: Picks) -> None:
        shades = picks.marks.dimmed(BACKGROUND, on=0.0, off=_OFF_SHARE)
        self._points.append(self._add_points("/matches/points", picks.marks, shades, 1.0))

    @property
    def _point_size(self) -> float:
        return _POINT_SIZE_PER_RANGE * self._range_m

    def _add_points(self, name: str, marks: Marks, colors: ArrayLike, size: float) -> viser.PointCloudHandle:
        # Of two markers at one position the smaller is nearer to the viewer.
        return self._place.scene.add_point_cloud(
            name,
            marks.before((_OFFSET + _HALO - size) * self._point_size),
            colors,  # type: ignore[arg-type]
            point_size=size * self._point_size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )


def _picks_of_result(result: PoseResult) -> Picks:
    marks = marks_of_result(result, MATCHES, most=_MAX_RESULT_MATCHES)
    residuals = np.linalg.norm(result.residuals_px, axis=-1)[marks.given]
    return Picks(marks, tuple(result.matches.pick_ids[k] for k in marks.given), residual_colors(residuals))


def residual_colors(residuals_px: ArrayLike) -> ByteArray:
    """Return the colours (N, 3) of residuals (N,), px: from small to the largest, gray where there is none."""
    values = np.asarray(residuals_px, dtype=np.float64).reshape(-1)
    known = np.isfinite(values)
    most = max(float(values[known].max(initial=0.0)), _MIN_RESIDUAL_PX)
    colors = np.array(ramp_colors((np.where(known, values, 0) / most).astype(np.float32)))
    colors[~known] = UNKNOWN
    return colors
