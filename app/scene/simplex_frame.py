"""One iteration of the simplex, as the scene draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.thesis.estimators.stereo import pose_of

if TYPE_CHECKING:
    from ladarreg_core.thesis.estimators.stereo_simplex import DescentStep


@dataclass(frozen=True, slots=True, eq=False)
class SimplexFrame:
    """The simplex after one iteration."""

    iteration: int
    """Iterations so far, including those of earlier descents."""
    best: Rigid
    """camera_from_scanner of the best vertex."""
    others: tuple[Rigid, ...]
    """camera_from_scanner of the other vertices."""
    cost: float
    """Cost of the best vertex."""
    note: str = ""
    """Text beside the numbers, e.g. the rejection round and how many matches are inliers."""

    @property
    def parameters(self) -> ThesisParameters:
        """The best vertex as the thesis's six parameters."""
        return ThesisParameters.from_pose(self.best)

    @staticmethod
    def of(step: DescentStep, *, iteration: int | None = None) -> SimplexFrame:
        """Return the frame of a step of a descent.

        Args:
            step: the step.
            iteration: its iteration over all descents; None: its own.
        """
        best, *others = (pose_of(vertex, step.frame_from_scanner) for vertex in step.simplex.vertices)
        inliers, round_ = int(step.inliers.sum()), step.round
        note = f"{inliers} of {len(step.inliers)} inliers" + (f", rejection {round_}" if round_ else "")
        number = step.simplex.iteration if iteration is None else iteration
        return SimplexFrame(number, best, tuple(others), step.simplex.cost, note)
