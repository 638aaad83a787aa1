"""Numbers, lengths, angles and shares as display text, with significant digits only."""

from __future__ import annotations

import math


def format_number(value: float) -> str:
    """Return a number with two significant digits, or as a whole number from 99.5 on."""
    return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"


def format_length(metres: float) -> str:
    """Return a length in millimetres below ten centimetres, in metres above; two digits either way."""
    return f"{metres * 1000:.2g} mm" if metres < 0.0995 else f"{metres:.2f} m"


def format_angle(radians: float) -> str:
    """Return an angle in degrees, as `format_number` writes it."""
    return f"{format_number(math.degrees(radians))} deg"


def format_pixels(pixels: float) -> str:
    """Return a distance in an image, as `format_number` writes it."""
    return f"{format_number(pixels)} px"


def format_percent(share: float) -> str:
    """Return a share, 0 to 1, as a whole number of per cent."""
    return f"{100 * share:.0f} %"
