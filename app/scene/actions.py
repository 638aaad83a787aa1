"""What the stage asks of the session when somebody uses its controls."""

from __future__ import annotations

from typing import Literal, Protocol

JobAction = Literal["pause", "resume", "stop", "step", "speed"]


class StageActions(Protocol):
    """Called from viser's own threads, by whoever clicked; the answer comes back as calls of the stage."""

    def set_model(
        self,
        *,
        texture: str | None = None,
        z_buffer: bool | None = None,
        light: bool | None = None,
        cameras: bool | None = None,
        matches: bool | None = None,
    ) -> None:
        """Change what the model shows; None leaves a thing as it is."""

    def job_control(self, action: JobAction, value: float | None = None) -> None:
        """Control the job that runs; the value of `speed` is in steps a second, 0: as fast as it can."""

    def hover(self, pick_id: str | None) -> None:
        """Tell that a match was touched; None: that it was let go of."""
