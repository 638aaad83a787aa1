"""Display settings of the model in the 3-D scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError
from ladarreg_core.inspection.model_textures import texture_choices, usable_texture

if TYPE_CHECKING:
    from ladarreg_core.results import PoseResult


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """Display settings of the model."""

    texture: str = "colour"
    """Requested texture; `intensity` is shown if it is not available."""
    z_buffer: bool = True
    """True if surfaces hidden from the camera stay uncoloured."""
    light: bool = False
    """True if a coarse mesh is sent, for slow browsers."""
    cameras: bool = True
    """True if the scanner and the camera are shown."""
    matches: bool = True
    """True if the matches are shown."""

    def changed(self, wanted: Mapping[str, Any]) -> ModelChoice:
        """Return a copy with other settings.

        Raises:
            OptionError: if a setting is unknown, or its value is not of its type.
        """
        known = asdict(self)
        for name, value in wanted.items():
            if name not in known or type(value) is not type(known[name]):
                raise OptionError(f"the model has no setting {name!r} of type {type(value).__name__}")
            if name == "texture":
                usable_texture(value, None)  # raises with the list of textures
        return replace(self, **wanted)

    def slice(self, result: PoseResult | None) -> dict[str, Any]:
        """Return the slice `model`, with the textures that the shown pose makes available."""
        choices = [
            {"value": choice.kind, "label": choice.label, "usable": choice.usable, "said": choice.description}
            for choice in texture_choices(result)
        ]
        return {**asdict(self), "choices": choices}
