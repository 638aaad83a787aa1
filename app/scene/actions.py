"""The actions that the scene's controls trigger in the workbench."""

from __future__ import annotations

from typing import Literal, Protocol

JobAction = Literal["pause", "resume", "stop", "step", "speed"]


class SceneActions(Protocol):
    """Called from viser's own threads; the outcome comes back as calls of the scene's methods."""

    def set_model(
        self,
        *,
        texture: str | None = None,
        z_buffer: bool | None = None,
        light: bool | None = None,
        cameras: bool | None = None,
        matches: bool | None = None,
    ) -> None:
        """Change how the model is shown; None leaves a setting unchanged."""

    def job_control(self, action: JobAction, value: float | None = None) -> None:
        """Control the running job; the value of `speed` is in steps per second, 0: unlimited."""

    def hover(self, pick_id: str | None) -> None:
        """Report that the pointer is on a match; None: on none."""
