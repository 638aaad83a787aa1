"""What a survey says of its cameras: the ties between them, and ellipses of their positions' uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.export.models.viser_colors import line_colors_for_viewer
from ladarreg_core.foundations.palette import ACCENT, OTHER_CAMERA
from ladarreg_core.inspection.scene_geometry import for_both_ends, repeated

if TYPE_CHECKING:
    import viser

    from ladarreg_core.foundations.arrays import ByteArray, FloatArray

    from .place import Place


@dataclass(frozen=True, slots=True, eq=False)
class SurveyShown:
    """Ties and uncertainties, in the frame of the scan that is shown."""

    ties: FloatArray
    """(N, 2, 3) m, from camera to camera."""
    tie_colors: ByteArray
    """(N, 3) RGB, by residual."""
    rings: FloatArray
    """(M, 2, 3) m: the standard deviations as ellipses, enlarged."""
    moves: FloatArray
    """(K, 2, 3) m: the lines of arrows of how the cameras moved, enlarged alike."""
    factor: int
    """By how much they are enlarged."""
    label_at: FloatArray
    """(3,) where that is said."""


class SurveyLayer:
    """One node for all ties, one for all ellipses."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._drawn: SurveyShown | None = None
        self._nodes: list[viser.SceneNodeHandle] = []

    def draw(self, shown: SurveyShown | None, *, visible: bool) -> None:
        """Draw a survey; None: there is none."""
        if shown is not self._drawn:
            for node in self._nodes:
                node.remove()
            self._nodes, self._drawn = [] if shown is None else self._draw(shown), shown
        for node in self._nodes:
            node.visible = visible

    def _draw(self, shown: SurveyShown) -> list[viser.SceneNodeHandle]:
        scene = self._place.scene
        nodes: list[viser.SceneNodeHandle] = []
        for name, lines, colors, thickness in (
            ("/survey/ties", shown.ties, shown.tie_colors, 1.0),
            ("/survey/ellipses", shown.rings, repeated(ACCENT, len(shown.rings)), 1.6),
            ("/survey/moves", shown.moves, repeated(OTHER_CAMERA, len(shown.moves)), 2.0),
        ):
            if len(lines):
                nodes.append(
                    scene.add_line_segments(
                        name, points=lines.astype(np.float32), colors=line_colors_for_viewer(for_both_ends(colors)),
                        thickness=thickness, thickness_units="screen",
                    )
                )  # fmt: skip
        if len(shown.rings) and shown.factor > 1:
            nodes.append(
                scene.add_label(
                    "/survey/scale", f"1 σ × {shown.factor}", position=shown.label_at, font_screen_scale=0.75,
                    anchor="bottom-center",
                )
            )  # fmt: skip
        return nodes
