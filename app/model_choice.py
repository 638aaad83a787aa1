"""What the 3-D scene is to show, as all pages share it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from ladarreg_core.errors import OptionError

TEXTURES = {
    "colour": ("Colour", True),
    "intensity": ("Intensity", False),
    "range": ("Range", False),
    "residual": ("Residual", True),
    "uncertainty": ("Uncertainty", True),
    "label": ("Seen or hidden", True),
}
"""Value, what to call it, and whether it needs an accepted pose."""


@dataclass(frozen=True, slots=True)
class ModelShown:
    """The choice."""

    texture: str = "colour"
    z_buffer: bool = True
    light: bool = False
    cameras: bool = True
    matches: bool = True

    def changed(self, wanted: Mapping[str, Any]) -> ModelShown:
        """Return another choice.

        Raises:
            OptionError: if there is no such thing to choose.
        """
        known = asdict(self)
        for name, value in wanted.items():
            if name not in known or type(value) is not type(known[name]):
                raise OptionError(f"the model has no choice {name!r} of this kind")
            if name == "texture" and value not in TEXTURES:
                raise OptionError(f"the model has no texture {value!r}; choose of {', '.join(TEXTURES)}")
        return replace(self, **wanted)

    def slice(self, accepted: bool) -> dict[str, Any]:
        """Return it as the page is told."""
        choices = [
            {
                "value": name,
                "label": label,
                "usable": accepted or not needs,
                "said": "" if accepted or not needs else "needs an accepted pose",
            }
            for name, (label, needs) in TEXTURES.items()
        ]
        return {**asdict(self), "choices": choices}
