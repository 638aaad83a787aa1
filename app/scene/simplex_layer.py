"""The moving simplex in space: the best camera, the other vertices, and the initial pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ladarreg_core.export.models.viser_colors import line_colors_for_viewer
from ladarreg_core.foundations.palette import ACCENT, BACKGROUND, REFUSED
from ladarreg_core.inspection.scene_geometry import (
    camera_outline,
    camera_outlines,
    dashed,
    faded,
    for_both_ends,
    repeated,
)

from .cameras_layer import add_camera, viser_pose

if TYPE_CHECKING:
    import viser

    from ladarreg_core.camera import CameraModel
    from ladarreg_core.foundations.arrays import FloatArray
    from ladarreg_core.foundations.palette import Color
    from ladarreg_core.frames import Rigid

    from .place import Place
    from .simplex_frame import SimplexFrame
    from .subject import Subject

_FADED_SHARE, _DASHES = 0.45, 9


class SimplexLayer:
    """The best vertex in the accent colour, the others faint, the initial pose dashed."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._best: viser.CameraFrustumHandle | None = None
        self._others: viser.LineSegmentsHandle | None = None
        self._start: viser.LineSegmentsHandle | None = None
        self._camera: CameraModel | None = None
        self._depth_m = 1.0

    def draw(self, subject: Subject | None, frame: SimplexFrame) -> None:
        """Draw a frame; the first one after `clear` is the initial pose."""
        camera = None if subject is None else subject.camera
        if subject is None or camera is None:
            return
        if camera is not self._camera:
            self.clear()
            self._camera, self._depth_m = camera, subject.shown.frustum_depth_m
        outlines = camera_outlines(camera, frame.others, depth_m=self._depth_m)
        if self._best is None:
            self._best = add_camera(
                self._place, "/simplex/best", camera, frame.best, ACCENT, self._depth_m, thickness=2.6
            )
            start = dashed(camera_outline(camera, frame.best, depth_m=self._depth_m), dashes=_DASHES)
            self._start = self._lines("/simplex/start", start, REFUSED, 1.2)
        if self._others is None or len(self._others.points) != len(outlines):
            faint = faded(repeated(ACCENT, 1), BACKGROUND, share=_FADED_SHARE)[0].tolist()
            self._others = self._lines("/simplex/vertices", outlines, tuple(faint), 1.0) if len(outlines) else None
        with self._place.atomic():
            if self._others is not None:
                self._others.points = outlines
            self._move(self._best, frame.best)

    def end(self, subject: Subject | None, best: SimplexFrame | None) -> None:
        """Keep only the best vertex, or nothing."""
        if best is not None:
            self.draw(subject, best)
        for node in (self._others, self._start, *([] if best is not None else [self._best])):
            if node is not None:
                node.remove()
        self._others = self._start = None
        if best is None:
            self._best = self._camera = None

    def clear(self) -> None:
        """Remove everything."""
        self.end(None, None)

    def _move(self, frustum: viser.CameraFrustumHandle, pose: Rigid) -> None:
        placement = viser_pose(pose)
        frustum.wxyz, frustum.position = placement["wxyz"], placement["position"]

    def _lines(self, name: str, lines: FloatArray, color: Color, thickness: float) -> viser.LineSegmentsHandle:
        shades = line_colors_for_viewer(for_both_ends(repeated(color, len(lines))))
        return self._place.scene.add_line_segments(
            name,
            points=lines,
            colors=shades,
            thickness=thickness,
            thickness_units="screen",
        )
