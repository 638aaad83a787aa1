"""Inks: visible colour and laser albedo of materials."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Ink = tuple[int, int, int, int]
"""Red, green, blue (gamma-encoded) and laser albedo (linear), 0..255 each."""
Rgb = tuple[int, int, int]

GAMMA = 2.2
_DYES = (0.0, 0.03, 0.08, 0.13, 0.3, 0.42, 0.52, 0.58, 0.63, 0.75, 0.95)  # hues
_BLACK = 0.08  # linear luminance


class InkMixer:
    """Mixes inks at random; equal seeds give equal inks in the same order.

    The laser albedo differs from the visible colour: 30 % of the inks are transparent to the laser, which then sees the
    paper beneath, and most but not all blacks are black to it. With `independent`, albedo and colour are unrelated.
    """

    def __init__(self, rng: np.random.Generator, *, independent: bool = False) -> None:
        self._rng = rng
        self._independent = independent

    def of(self, rgb: Rgb) -> Ink:
        """Return an ink of this colour with a random laser albedo."""
        draw = self._rng.random(3)
        linear = [(value / 255) ** GAMMA for value in rgb]
        if self._independent:
            laser = 0.05 + 0.8 * draw[0]
        elif 0.21 * linear[0] + 0.72 * linear[1] + 0.07 * linear[2] < _BLACK and max(rgb) - min(rgb) < 60:
            laser = 0.04 + 0.06 * draw[1] if draw[0] < 0.7 else 0.45 + 0.25 * draw[1]
        elif draw[0] < 0.3:
            laser = 0.6 + 0.2 * draw[1]
        else:
            laser = 0.6 * linear[0] + 0.4 * (0.1 + 0.7 * draw[1])
        return (*rgb, round(255 * laser))

    def bright(self) -> Ink:
        """Return a light paper or paint."""
        base = int(self._rng.integers(185, 245))
        tint = self._rng.integers(-18, 19, 3)
        return self.of(_rgb(base + tint))

    def dark(self) -> Ink:
        """Return a near-black."""
        base = int(self._rng.integers(12, 55))
        return self.of(_rgb(base + self._rng.integers(-6, 7, 3)))

    def vivid(self) -> Ink:
        """Return a saturated colour of a hue common in dyes and prints."""
        hue = float(self._rng.choice(_DYES) + 0.025 * self._rng.standard_normal())
        saturation, value = self._rng.uniform(0.35, 0.78), self._rng.uniform(0.35, 0.9)
        return self.of(hsv(hue, saturation, value))

    def muted(self) -> Ink:
        """Return a grayish colour of any hue, as of walls, clothes and furniture."""
        return self.of(hsv(self._rng.random(), self._rng.uniform(0.05, 0.35), self._rng.uniform(0.3, 0.85)))

    def wood(self) -> tuple[Ink, Ink]:
        """Return the two tones of a wood."""
        hue, value = self._rng.uniform(0.05, 0.1), self._rng.uniform(0.4, 0.85)
        saturation = self._rng.uniform(0.3, 0.65)
        return self.of(hsv(hue, saturation, value)), self.of(hsv(hue - 0.01, min(1, saturation + 0.1), value * 0.72))

    def skin(self) -> Ink:
        """Return a skin tone."""
        value = self._rng.uniform(0.4, 0.95)
        return self.of(hsv(self._rng.uniform(0.04, 0.08), self._rng.uniform(0.3, 0.5), value))

    def any(self) -> Ink:
        """Return an ink of any kind, as found in print."""
        kind = self._rng.random()
        return (
            self.vivid()
            if kind < 0.5
            else self.dark()
            if kind < 0.65
            else self.bright()
            if kind < 0.8
            else self.muted()
        )


def hsv(hue: float, saturation: float, value: float) -> Rgb:
    """Return the colour of hue, saturation and value, 0..1 each; the hue wraps."""
    sector, fraction = divmod((hue % 1.0) * 6, 1.0)
    low, falling = value * (1 - saturation), value * (1 - saturation * fraction)
    rising = value * (1 - saturation * (1 - fraction))
    table = [
        (value, rising, low),
        (falling, value, low),
        (low, value, rising),
        (low, falling, value),
        (rising, low, value),
        (value, low, falling),
    ]
    return _rgb(255 * np.array(table[int(sector) % 6]))


def _rgb(values: NDArray[Any]) -> Rgb:
    r, g, b = (int(v) for v in np.clip(np.rint(values), 0, 255))
    return r, g, b
