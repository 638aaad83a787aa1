"""What a client looks at in the 3-D scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from ladarreg_core.frames import Rigid

from .model_view import ModelChoice
from .smoothing_layer import SmoothingShown

ANYBODY = ""
"""Id of a client that has not said who it is."""
ViewpointName = Literal["start", "overview", "scanner", "camera"]
VIEWPOINTS: tuple[ViewpointName, ...] = get_args(ViewpointName)


@dataclass(frozen=True, slots=True)
class Person:
    """What a client looks at."""

    photo: str | None = None
    """Id of the photograph."""
    model: ModelChoice = field(default_factory=ModelChoice)
    """Its display settings."""
    highlighted: str | None = None
    """Id of a match."""
    draft: Rigid | None = None
    """Pose of the camera that it places by hand."""
    smoothing: SmoothingShown | None = None
    """Ranges whose replacement it previews."""
