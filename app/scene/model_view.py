"""What the 3-D scene is to show, as all pages share it."""

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
    """How the model is shown."""

    texture: str = "colour"
    """Wanted; where there is nothing to make it of, `intensity` is shown."""
    z_buffer: bool = True
    """Whether what is hidden from the camera stays uncoloured."""
    light: bool = False
    """Whether slow browsers get a coarser model."""
    cameras: bool = True
    """Whether the scanner and the camera are shown."""
    matches: bool = True
    """Whether the matches are."""

    def changed(self, wanted: Mapping[str, Any]) -> ModelChoice:
        """Return another choice.

        Raises:
            OptionError: if there is no such thing to choose.
        """
        known = asdict(self)
        for name, value in wanted.items():
            if name not in known or type(value) is not type(known[name]):
                raise OptionError(f"the model has no choice {name!r} of this kind")
            if name == "texture":
                usable_texture(value, None)  # which says what there is
        return replace(self, **wanted)

    def slice(self, result: PoseResult | None) -> dict[str, Any]:
        """Return it as the page is told, with what the shown pose leaves to choose from."""
        choices = [
            {"value": choice.kind, "label": choice.label, "usable": choice.usable, "said": choice.description}
            for choice in texture_choices(result)
        ]
        return {**asdict(self), "choices": choices}
