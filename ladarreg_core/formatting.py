"""Lengths as people say them."""

from __future__ import annotations


def length_in_words(metres: float) -> str:
    """Return a length in millimetres below ten centimetres, in metres above; two digits either way."""
    return f"{metres * 1000:.2g} mm" if metres < 0.0995 else f"{metres:.2f} m"
