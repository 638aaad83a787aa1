"""Textures with the spectrum of natural images: plaster and stone, dense print, foliage.

Amplitudes fall as 1 / f, so that there is detail at every distance, and few long straight edges. Source: Field,
Relations between the statistics of natural images and the response properties of cortical cells (1987).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.simulate.worlds.textures import COARSE_M, Printer
from ladarreg_core.simulate.worlds.world import Picture, Texture

_GAIN = 3.0  # standard deviations of wear, to those of a printer's soft patches
_WALL_CONTRAST, _PICTURE_CONTRAST = 0.22, 0.5
_SHARED = 0.8  # correlation of the patterns that the eye and the laser see
_MIN_GAIN = 0.1


def natural_noise(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Return noise (height, width) with mean 0 and deviation 1, whose amplitudes fall as 1 / f."""
    from scipy import fft

    h, w = fft.next_fast_len(height, real=True), fft.next_fast_len(width, real=True)
    spectrum = fft.rfft2(rng.standard_normal((h, w), dtype=np.float32))
    # Frequencies in cycles per texel, equal in both directions: the spectrum of a narrow picture is not stretched.
    frequency = np.hypot(np.fft.fftfreq(h)[:, None], np.fft.rfftfreq(w)).astype(np.float32)
    frequency[0, 0] = np.inf
    noise = fft.irfft2(spectrum / frequency, s=(h, w))[:height, :width]
    noise -= noise.mean()
    return np.asarray(noise / max(float(noise.std()), 1e-12), dtype=np.float32)


class NaturalPrinter(Printer):
    """Draws the textures of one scene with natural spectra; equal seeds give equal textures in the same order."""

    def grain(self, picture: Picture, strength: float, *, cells: float = 40.0) -> Picture:
        """Return the picture with wear of a natural spectrum, whatever `cells`; the laser sees four fifths of it."""
        return self._worn(picture, _GAIN * strength)

    def wall(self, width_m: float, height_m: float) -> Texture:
        """Return a wall of plaster or stone, overgrown, or papered in print."""
        kind = int(self.rng.integers(3))
        if kind == 0:
            return self._foliage(width_m, height_m)
        picture = self.sheet(width_m, height_m, self.inks.muted(), pitch_m=COARSE_M)
        if kind == 1:
            h, w = picture.shape[:2]
            self.lines(picture, (0, 0, w, h), self.inks.any(), height=int(self.rng.integers(5, 9)))
        return Texture(self._worn(picture, _WALL_CONTRAST))

    def floor(self, width_m: float, height_m: float) -> Texture:
        """Return a floor of stone or earth."""
        return Texture(self._worn(self.sheet(width_m, height_m, self.inks.muted(), pitch_m=COARSE_M), _WALL_CONTRAST))

    def poster(self, width_m: float, height_m: float) -> Texture:
        """Return a picture of clouds, a printed notice or foliage."""
        kind = int(self.rng.integers(3))
        if kind == 0:
            return self._foliage(width_m, height_m)
        picture = self.sheet(width_m, height_m, self.inks.muted() if kind == 1 else self.inks.bright())
        if kind == 1:
            return Texture(self._worn(picture, _PICTURE_CONTRAST))
        self.lines(picture, self._inset(picture, 0.06), self.inks.dark(), height=int(self.rng.integers(5, 12)))
        return Texture(self._worn(picture, _WALL_CONTRAST))

    def _worn(self, picture: Picture, strength: float) -> Picture:
        h, w = picture.shape[:2]
        seen, own = natural_noise(self.rng, h, w), natural_noise(self.rng, h, w)
        by_laser = np.float32(_SHARED) * seen + np.float32(np.sqrt(1 - _SHARED**2)) * own
        gains = [np.maximum(1 + np.float32(strength) * field, np.float32(_MIN_GAIN)) for field in (seen, by_laser)]
        worn = picture * cv2.merge([gains[0]] * 3 + [gains[1]])
        return np.asarray(np.clip(np.rint(worn), 0, 255), dtype=np.uint8)

    def _foliage(self, width_m: float, height_m: float) -> Texture:
        """Return leaves of all sizes, those of the front last, on a worn ground."""
        ground = self.inks.of((38, 66, 36))
        picture = self._worn(self.sheet(width_m, height_m, ground, pitch_m=COARSE_M), _WALL_CONTRAST)
        h, w = picture.shape[:2]
        light = self.rng.uniform(0, 1, 6)
        tones = [self.inks.of((int(35 + 75 * t), int(75 + 110 * t), int(30 + 45 * t))) for t in light]
        count = h * w // 90
        size = 3 / np.sqrt(self.rng.uniform(0.03, 1, count))  # the numbers of leaves of natural pictures: as 1 / size^3
        at = self.rng.integers(0, (w, h), (count, 2))
        turn, tone = self.rng.uniform(0, 180, count), self.rng.integers(0, len(tones), count)
        for k in range(count):
            axes = (max(2, round(size[k])), max(1, round(size[k] / 2.5)))
            centre = (int(at[k, 0]), int(at[k, 1]))
            cv2.ellipse(picture, centre, axes, float(turn[k]), 0, 360, tones[int(tone[k])], -1)
        return Texture(picture)
