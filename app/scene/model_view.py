"""How a person looks at the 3-D model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError
from ladarreg_core.inspection.model_textures import usable_texture

if TYPE_CHECKING:
    from ..slices.choices import ModelDetail
    from ..slices.project import ModelDisplay

_MAX_HIDDEN = 100
DETAILS: tuple[ModelDetail, ...] = ("coarse", "standard", "dense")
LAYERS = {
    "fused": ("Fused", "the colours of all photographs: exposures equalised, and what moved left out"),
    "photo_id": ("Photograph used", "which photograph colours each place, when all are fused"),
    "seen_by": ("Seen by", "how many photographs show each place"),
    "temperature_k": ("Temperature", "apparent temperature by the thermal photographs, kelvin"),
}
"""Textures made of all accepted photographs, as layers of `fusion.layers`: label and description."""


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """Display settings of the model."""

    texture: str = "colour"
    """Requested texture; the page shows `intensity` if it is not available."""
    z_buffer: bool = True
    """True if surfaces hidden from the camera stay uncoloured."""
    detail: ModelDetail = "standard"
    """The finest mesh and texture that are sent: `coarse` for slow computers and links, `dense` on demand."""
    cameras: bool = True
    """True if the scanner and the camera are shown."""
    matches: bool = True
    """True if the matches are shown."""
    rays: bool = False
    """True if the rays on which the matches were picked are shown."""
    residuals: bool = False
    """True if the matches have the colours of their residuals instead of those of their numbers."""
    hidden_stations: tuple[str, ...] = ()
    """Ids of the stations whose points are hidden."""

    def changed(self, wanted: Mapping[str, Any]) -> ModelChoice:
        """Return a copy with other settings.

        Raises:
            OptionError: if a setting is unknown, or its value is not of its type.
        """
        known = asdict(self)
        hidden = wanted.get("hidden_stations")
        if isinstance(hidden, list) and len(hidden) <= _MAX_HIDDEN and all(isinstance(name, str) for name in hidden):
            wanted = {**wanted, "hidden_stations": tuple(hidden)}
        for name, value in wanted.items():
            if name not in known or type(value) is not type(known[name]):
                raise OptionError(f"the model has no setting {name!r} of type {type(value).__name__}")
            if name == "texture" and value not in LAYERS:
                usable_texture(value, None)  # raises with the list of textures
            if name == "detail" and value not in DETAILS:
                raise OptionError(f"the detail is {value[:20]!r}; it must be one of {', '.join(DETAILS)}")
        return replace(self, **wanted)

    def slice(self) -> ModelDisplay:
        """Return what the slice `model` states of it."""
        return {
            "texture": self.texture,
            "z_buffer": self.z_buffer,
            "detail": self.detail,
            "cameras": self.cameras,
            "matches": self.matches,
            "rays": self.rays,
            "residuals": self.residuals,
            "hidden_stations": list(self.hidden_stations),
        }
