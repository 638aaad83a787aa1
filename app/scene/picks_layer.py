"""The matches in space: points in the colours of their numbers, and the rays on which they were picked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ladarreg_core.export.viser_colors import line_colours_for_viewer
from ladarreg_core.inspection.scene_geometry import Marks, for_both_ends, marks_of_result, rays_to, repeated, spread
from ladarreg_core.palette import BACKGROUND, HIGHLIGHT, MATCHES

if TYPE_CHECKING:
    import viser
    from numpy.typing import ArrayLike

    from ladarreg_core.arrays import FloatArray

    from .subject import Subject

_POINT_SIZE_PER_RANGE = 0.006
_CLICK_RADIUS, _HIGHLIGHTED, _HALO = 1.1, 1.6, 2.4
_OFFSET = 2.0
"""Distance in front of the surface, in point sizes: a marker on the surface would be half hidden in it."""
_MAX_RAYS, _MAX_RESULT_MATCHES = 24, 16
_OFF_SHARE, _RAY_SHARE = 0.65, 0.5


@dataclass(frozen=True)
class Picks:
    """The matches to show."""

    marks: Marks
    """Their points."""
    ids: tuple[str, ...]
    """Pick id of each point."""

    @staticmethod
    def of(points: ArrayLike, colours: ArrayLike, on: ArrayLike, ids: Sequence[str]) -> Picks:
        """Return the picks that have a position; one without a range has none."""
        marks = Marks.of(points, colours, on)
        return Picks(marks, tuple(ids[k] for k in marks.given))


class PicksLayer:
    """Points, rays and clicks; without picks, the matches of the accepted pose are shown."""

    def __init__(self, server: viser.ViserServer, on_click: Callable[[str], None]) -> None:
        self._server = server
        self._on_click = on_click
        self._nodes: list[viser.SceneNodeHandle] = []
        self._points: list[viser.PointCloudHandle] = []
        self._marked: list[viser.SceneNodeHandle] = []
        self._shown: Picks | None = None
        self._centres: tuple[FloatArray, ...] = ()
        self._range_m = 1.0
        self._visible = True
        self._size = 1.0
        server.scene.on_click()(self._clicked)

    def draw(self, subject: Subject | None, picks: Picks | None, *, visible: bool, size: float) -> None:
        """Redraw the matches."""
        self.clear()
        self._visible, self._size = visible, size
        if subject is None:
            return
        accepted = subject.accepted
        if accepted is not None and (picks is None or not picks.ids):
            marks = marks_of_result(accepted, MATCHES, most=_MAX_RESULT_MATCHES)
            picks = Picks(marks, tuple(accepted.matches.pick_ids[k] for k in marks.given))
        if picks is None or not picks.ids:
            return
        self._shown, self._range_m = picks, subject.shown.range_m
        self._centres = (subject.scanner_centre,)
        if accepted is not None:
            self._centres += (accepted.camera_from_scanner.centre,)
        self._draw_rays(picks)
        self._draw_points(picks)
        for node in (*self._nodes, *self._points):
            node.visible = visible

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
        colours = line_colours_for_viewer(for_both_ends(repeated(HIGHLIGHT, len(lines))))
        scene = self._server.scene
        self._marked.append(
            scene.add_line_segments(
                "/highlight/rays", points=lines, colors=colours, thickness=2.2, thickness_units="screen"
            )
        )
        for name, shade, size in (
            ("halo", repeated(HIGHLIGHT, len(marks)), _HALO),
            ("point", marks.colours, _HIGHLIGHTED),
        ):
            self._marked.append(self._add_points(f"/highlight/{name}", marks, shade, size))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        # viser's point clouds are not clickable, and spheres, which are, need a shader that takes seconds to compile
        # without a graphics card.
        shown = self._shown
        if shown is None or not self._visible:
            return
        hit = shown.marks.nearest_to_ray(
            event.ray_origin, event.ray_direction, radius_m=_CLICK_RADIUS * self._point_size
        )
        if hit is not None:
            self._on_click(shown.ids[hit])

    def clear(self) -> None:
        """Remove everything."""
        for node in (*self._nodes, *self._points, *self._marked):
            node.remove()
        self._nodes, self._points, self._marked, self._shown = [], [], [], None

    def _draw_rays(self, picks: Picks) -> None:
        marks = picks.marks.at(spread(len(picks.marks), _MAX_RAYS))
        for name, centre in zip(("scanner", "camera"), self._centres, strict=False):
            lines = rays_to(marks.points, (centre,))
            colours = line_colours_for_viewer(for_both_ends(marks.dimmed(BACKGROUND, on=_RAY_SHARE, off=_OFF_SHARE)))
            self._nodes.append(
                self._server.scene.add_line_segments(
                    f"/matches/{name}_rays", points=lines, colors=colours, thickness=1.0, thickness_units="screen"
                )
            )

    def _draw_points(self, picks: Picks) -> None:
        shades = picks.marks.dimmed(BACKGROUND, on=0.0, off=_OFF_SHARE)
        self._points.append(self._add_points("/matches/points", picks.marks, shades, 1.0))

    @property
    def _point_size(self) -> float:
        return _POINT_SIZE_PER_RANGE * self._range_m * self._size

    def _add_points(self, name: str, marks: Marks, colours: ArrayLike, size: float) -> viser.PointCloudHandle:
        # Of two markers at one position the smaller is nearer to the viewer.
        return self._server.scene.add_point_cloud(
            name,
            marks.before((_OFFSET + _HALO - size) * self._point_size),
            colours,  # type: ignore[arg-type]
            point_size=size * self._point_size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
