"""Colours of the scene, as in `static/tokens.css`."""

from __future__ import annotations

from ladarreg_core.inspection.model_textures import Colour

BACKGROUND: Colour = (15, 17, 21)
ACCENT: Colour = (92, 200, 255)
SCANNER: Colour = (255, 211, 77)
REFUSED: Colour = (143, 155, 173)
HIGHLIGHT: Colour = (255, 255, 255)
MATCH_COLOURS: tuple[Colour, ...] = (
    (255, 211, 77), (92, 200, 255), (255, 143, 171), (126, 226, 168), (201, 167, 255), (255, 166, 92),
)  # fmt: skip
"""Colour of match number n at index n - 1, repeating."""


def as_css(colour: Colour) -> str:
    """Return a colour as `#rrggbb`."""
    return f"#{bytes(colour).hex()}"
