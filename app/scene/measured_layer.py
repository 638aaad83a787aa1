"""Measurements in space: their lines and points, each with its value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.export.models.viser_colors import line_colors_for_viewer
from ladarreg_core.foundations.palette import BACKGROUND, HIGHLIGHT
from ladarreg_core.inspection.scene_geometry import crosses, for_both_ends, repeated

if TYPE_CHECKING:
    import viser

    from ladarreg_core.foundations.arrays import FloatArray

    from .place import Place

_CROSS_PER_RANGE = 0.008
_TOWARDS_SCANNER = 0.998  # lines on the surface would be half hidden in it


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredShown:
    """What is drawn of all measurements, scanner frame."""

    lines: FloatArray
    """(M, 2, 3) m."""
    points: FloatArray
    """(N, 3) m."""
    labels: tuple[tuple[FloatArray, str], ...]
    """Where each value is written, (3,) m, and its text."""


class MeasuredLayer:
    """One node for all lines and a label for each measurement."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._drawn: MeasuredShown | None = None
        self._nodes: list[viser.SceneNodeHandle] = []

    def draw(self, shown: MeasuredShown | None, *, visible: bool) -> None:
        """Draw measurements; None: there are none."""
        if shown is not self._drawn:
            for node in self._nodes:
                node.remove()
            self._nodes, self._drawn = [] if shown is None else self._draw(shown), shown
        for node in self._nodes:
            node.visible = visible

    def _draw(self, shown: MeasuredShown) -> list[viser.SceneNodeHandle]:
        scene = self._place.scene
        lines = np.concatenate([shown.lines, crosses(shown.points, per_range=_CROSS_PER_RANGE)]) * _TOWARDS_SCANNER
        nodes: list[viser.SceneNodeHandle] = []
        for name, color, thickness in (("halo", BACKGROUND, 4.5), ("lines", HIGHLIGHT, 2.2)):
            nodes.append(
                scene.add_line_segments(
                    f"/measured/{name}", points=lines.astype(np.float32),
                    colors=line_colors_for_viewer(for_both_ends(repeated(color, len(lines)))), thickness=thickness,
                    thickness_units="screen",
                )
            )  # fmt: skip
        for number, (at, text) in enumerate(shown.labels):
            nodes.append(
                scene.add_label(
                    f"/measured/label_{number}", text, position=at * _TOWARDS_SCANNER, font_screen_scale=0.75,
                    anchor="bottom-center",
                )
            )  # fmt: skip
        return nodes
