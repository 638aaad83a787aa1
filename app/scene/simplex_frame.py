"""One moment of the simplex, as the stage draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.pose.thesis.stereo import pose_of

if TYPE_CHECKING:
    from ladarreg_core.pose.thesis.stereo_simplex import DescentStep


@dataclass(frozen=True, slots=True, eq=False)
class SimplexFrame:
    """The simplex after one move."""

    iteration: int
    """Steps so far, those of earlier descents counted."""
    best: Rigid
    """camera_from_scanner of the best vertex."""
    others: tuple[Rigid, ...]
    """Those of the other vertices."""
    cost: float
    """The best vertex's."""
    said: str = ""
    """What to say of it beside the numbers, e.g. the round and how many matches count."""

    @property
    def parameters(self) -> ThesisParameters:
        """The best vertex as the thesis's six numbers."""
        return ThesisParameters.from_pose(self.best)

    @staticmethod
    def of(step: DescentStep, *, iteration: int | None = None) -> SimplexFrame:
        """Return the moment of a descent's step.

        Args:
            step: the step.
            iteration: its number over all descents; None: its own.
        """
        best, *others = (pose_of(vertex, step.frame_from_scanner) for vertex in step.simplex.vertices)
        kept, round_ = int(step.inliers.sum()), step.round
        said = f"{kept} of {len(step.inliers)} matches" + (f", rejection {round_}" if round_ else "")
        number = step.simplex.iteration if iteration is None else iteration
        return SimplexFrame(number, best, tuple(others), step.simplex.cost, said)
