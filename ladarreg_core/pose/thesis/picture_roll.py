"""By how much a photo is rolled against the scan, read off its matches alone.

The direction from one match to another turns by the roll, whatever the shift and the scale between the two pictures;
mismatches scatter it evenly, and parallax shakes it, but hardly between points of one depth. Its most frequent value
over many such pairs survives both.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import FloatArray

_LEAST_MATCHES = 5
_MOST_PARTNERS = 60
_SMOOTHING_DEG = 6.0
_NEAR_DEG = 20.0
_LEVEL = 0.02
_BEST_SHARE = 0.2
_STANDS_OUT = 0.25  # of the pairs within 20 degrees of the mode; 0.11 by chance


def picture_roll(laser: FloatArray, colour: FloatArray, depth: FloatArray) -> float | None:
    """Return gamma, the roll of the colour camera about its optical axis, rad; None where nothing stands out.

    Args:
        laser: (2, N) coordinates in the scan's picture.
        colour: (2, N) coordinates in the photo, with axes that point the same way.
        depth: (N,) of the scan's points, m.
    """
    count = laser.shape[1]
    if count < _LEAST_MATCHES:
        return None
    shifts = np.unique(np.linspace(1, count - 1, min(count - 1, _MOST_PARTNERS)).astype(np.intp))
    first = np.tile(np.arange(count), len(shifts))
    second = (first + np.repeat(shifts, count)) % count
    l, c = (xy[0] + 1j * xy[1] for xy in (laser, colour))  # noqa: E741 - laser and colour, as complex numbers
    from_laser, from_colour = l[second] - l[first], c[second] - c[first]
    # Short ways turn most with the noise of their ends, steep ones with the parallax.
    length = np.minimum(np.abs(from_laser), np.abs(from_colour))
    long = (length > 0) & (length >= np.median(length))
    inverse = 1 / depth
    worth = np.where(long, length / (np.abs(inverse[second] - inverse[first]) + _LEVEL * np.median(inverse)), 0.0)
    long &= worth >= np.quantile(worth, 1 - _BEST_SHARE)
    if not long.any():
        return None
    turn = np.angle(from_laser[long] * np.conj(from_colour[long]))
    frequency = np.bincount(np.floor(np.degrees(turn)).astype(np.intp) % 360, minlength=360).astype(np.float64)
    offset = np.minimum(np.arange(360), 360 - np.arange(360))
    kernel = np.exp(-0.5 * (offset / _SMOOTHING_DEG) ** 2)
    smooth = np.fft.irfft(np.fft.rfft(frequency) * np.fft.rfft(kernel), 360)
    mode = np.deg2rad(float(np.argmax(smooth)) + 0.5)
    off = np.angle(np.exp(1j * (turn - mode)))
    near = np.abs(off) <= np.deg2rad(_NEAR_DEG)
    if near.mean() < _STANDS_OUT:
        return None
    return float(np.angle(np.exp(1j * (mode + np.median(off[near])))))
