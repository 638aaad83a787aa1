"""Ranges that would be replaced, in space: where the returns are, where they would be, and how they would move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.export.models.viser_colors import line_colors_for_viewer
from ladarreg_core.foundations.palette import BACKGROUND, BAD, OK, WARN
from ladarreg_core.inspection.scene_geometry import arrows, crosses, for_both_ends

if TYPE_CHECKING:
    import viser

    from ladarreg_core.foundations.arrays import BoolArray, FloatArray

    from ..slices.choices import SmoothingShow
    from .place import Place

_CROSS_PER_RANGE = 0.006


@dataclass(frozen=True, slots=True, eq=False)
class SmoothingShown:
    """The returns of a preview, scanner frame."""

    before: FloatArray
    """(N, 3) m, as the scan has them."""
    after: FloatArray
    """(N, 3) m, as they would be."""
    at_edge: BoolArray
    """(N,) whether each lies at a depth edge."""
    show: SmoothingShow
    """Which of them are drawn, or arrows from one to the other."""

    def lines(self) -> tuple[FloatArray, FloatArray]:
        """Return the lines (K, 2, 3), m, and the colour of each, (K, 3)."""
        if self.show == "difference":
            lines = arrows(self.before, self.after).astype(np.float64)
        else:
            points = self.before if self.show == "before" else self.after
            lines = crosses(points, per_range=_CROSS_PER_RANGE)
        colors = np.where(self.at_edge[:, None], WARN, OK if self.show == "after" else BAD)
        # The lines of all points come one after the other in `arrows`, those of each point in `crosses`.
        repeated = np.tile(colors, (3, 1)) if self.show == "difference" else np.repeat(colors, 3, axis=0)
        return lines, repeated


class SmoothingLayer:
    """Lines with a dark halo, that is two nodes."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._drawn: SmoothingShown | None = None
        self._nodes: list[viser.SceneNodeHandle] = []

    def draw(self, shown: SmoothingShown | None) -> None:
        """Draw a preview; None: there is none."""
        if shown is self._drawn:
            return
        for node in self._nodes:
            node.remove()
        self._nodes, self._drawn = [] if shown is None else self._draw(shown), shown

    def _draw(self, shown: SmoothingShown) -> list[viser.SceneNodeHandle]:
        lines, colors = shown.lines()
        if not len(lines):
            return []
        return [
            self._place.scene.add_line_segments(
                f"/smoothing/{name}", points=lines.astype(np.float32),
                colors=line_colors_for_viewer(for_both_ends(np.broadcast_to(color, colors.shape))),
                thickness=thickness, thickness_units="screen",
            )
            for name, color, thickness in (("halo", np.array(BACKGROUND), 5.0), ("lines", colors, 2.4))
        ]  # fmt: skip
