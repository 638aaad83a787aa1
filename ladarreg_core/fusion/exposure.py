"""Exposure and white balance of photographs, solved from what they show together.

A photograph's gain g of a channel turns its linear light L into that of the model, g L. Of cells that two photographs
show, the logarithm of the ratio of their light is the difference of the logarithms of their gains; its median over the
cells is not moved by things that are in one of them only. The gains are the robust least squares solution of all pairs.
Since the photographs determine ratios alone, the geometric mean of the gains is 1 among those that overlaps connect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import ByteArray, FloatArray, IntArray
from ladarreg_core.foundations.linear_light import encoded_codes, encoded_light, linear_light
from ladarreg_core.fusion.samples import PhotoSample
from ladarreg_core.surface.texture.registered_texture import Label

_MAX_SAMPLES = 6_000_000  # of all photographs together
_MAX_CELLS = 200_000
_DARKEST, _BRIGHTEST = 20, 242  # codes between which a picture is neither noise nor clipped
_MIN_CELLS = 40
_ALIKE_CELLS = 50.0  # cells that err together
_FLOOR = 0.01  # of the logarithm of a ratio
_PRIOR = 2.0
_ROUNDS, _CAUCHY = 12, 2.5
_MAX_GAIN = 8.0
_CODES = np.arange(256)


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Gains of photographs in linear light."""

    gains: NDArray[np.float64]
    """(K, 3) red, green, blue; 1 of a photograph that overlaps with none."""
    sigma: NDArray[np.float64]
    """(K, 3) their relative standard deviations; infinite of a photograph that overlaps with none."""
    pairs: int
    """Number of pairs of photographs that were compared."""

    def table(self, k: int) -> NDArray[np.float32]:
        """Return the codes (256, 3) of the model for each code of photograph k; above 255 where they would clip."""
        light = linear_light(_CODES)[:, None] * self.gains[k]
        bright = np.maximum(light, 1.0)
        codes = np.where(light > 1, 255 * bright ** (1 / 2.4), encoded_codes(light))
        return codes.astype(np.float32)

    def developed(self, k: int, pixels: ByteArray) -> ByteArray:
        """Return the pixels (h, w, 3) of photograph k with the exposure of the model; its own where the gain is 1."""
        if np.array_equal(self.gains[k], np.ones(3)):
            return pixels
        import cv2

        table = encoded_light(linear_light(_CODES)[:, None] * self.gains[k])
        return np.asarray(cv2.LUT(np.asarray(pixels), table[None]), dtype=np.uint8)


def solve_gains(
    samples: Sequence[Sequence[PhotoSample]], colors: Sequence[int], shapes: Sequence[tuple[int, int]]
) -> Gains:
    """Return the gains of photographs.

    Args:
        samples: of all photographs, on each scan.
        colors: the indices of those that are solved; the others have the gain 1.
        shapes: of the scans.
    """
    gains, sigma = np.ones((len(samples[0]), 3)), np.full((len(samples[0]), 3), np.inf)
    if len(colors) < 2:
        return Gains(gains, sigma, 0)
    pairs = _compared(np.concatenate([light for light, _ in sampled_light(samples, colors, shapes)], axis=1))
    if pairs is None:
        return Gains(gains, sigma, 0)
    first, second, ratio, deviation = pairs
    for channel in range(3):
        log_gain, spread = _solved(len(colors), first, second, ratio[:, channel], deviation[:, channel])
        gains[list(colors), channel] = np.clip(np.exp(log_gain), 1 / _MAX_GAIN, _MAX_GAIN)
        sigma[list(colors), channel] = spread
    return Gains(gains, sigma, len(first))


def sampled_light(
    samples: Sequence[Sequence[PhotoSample]], colors: Sequence[int], shapes: Sequence[tuple[int, int]]
) -> list[tuple[NDArray[np.float32], int]]:
    """Return the light of photographs at every n-th row and column of each scan, and n.

    Args:
        samples: of all photographs, on each scan.
        colors: the indices of those that are sampled, K.
        shapes: of the scans.

    Returns:
        For each scan logarithms of linear light (K, N, 3), row by row, NaN where a photograph says nothing of a cell;
        and n.
    """
    most = min(_MAX_CELLS, _MAX_SAMPLES // max(1, len(colors))) // len(shapes)
    strides = [max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / most)))) for shape in shapes]
    return [
        (_sampled([some[k] for k in colors], shape, stride), stride)
        for some, shape, stride in zip(samples, shapes, strides, strict=True)
    ]


def _sampled(samples: Sequence[PhotoSample], shape: tuple[int, int], stride: int) -> NDArray[np.float32]:
    rows, columns = (len(range(0, n, stride)) for n in shape)
    table = np.log(np.maximum(linear_light(_CODES), 1e-6)).astype(np.float32)
    found = np.full((len(samples), rows, columns, 3), np.nan, np.float32)
    for k, sample in enumerate(samples):
        begin = [-part.start % stride for part in sample.here]
        color = sample.color[begin[0] :: stride, begin[1] :: stride]
        good = sample.labels[begin[0] :: stride, begin[1] :: stride] == Label.SEEN
        good &= ~sample.moved[begin[0] :: stride, begin[1] :: stride]
        good &= (color.min(axis=-1) >= _DARKEST) & (color.max(axis=-1) <= _BRIGHTEST)
        top, left = ((part.start + at) // stride for part, at in zip(sample.here, begin, strict=True))
        height, width = good.shape
        found[k, top : top + height, left : left + width] = np.where(good[..., None], table[color], np.float32(np.nan))
    return found.reshape(len(samples), -1, 3)


def _compared(light: NDArray[np.float32]) -> tuple[IntArray, IntArray, FloatArray, FloatArray] | None:
    """Return indices (P,) of photographs with enough in common, log ratios (P, 3) and their standard deviations."""
    known = np.isfinite(light[..., 0])
    rows: list[tuple[int, int, FloatArray, FloatArray]] = []
    for i in range(len(light)):
        for j in range(i + 1, len(light)):
            both = np.flatnonzero(known[i] & known[j])
            if len(both) < _MIN_CELLS:
                continue
            difference = light[i, both] - light[j, both]
            middle = np.median(difference, axis=0)
            spread = 1.4826 * np.median(np.abs(difference - middle), axis=0)
            deviation = np.hypot(spread * 1.2533 / np.sqrt(max(len(both) / _ALIKE_CELLS, 1.0)), _FLOOR)
            rows.append((i, j, middle, deviation))
    if not rows:
        return None
    first, second, ratio, spread = (list(column) for column in zip(*rows, strict=True))
    return np.array(first), np.array(second), np.array(ratio, np.float64), np.array(spread, np.float64)


def _solved(
    count: int, first: IntArray, second: IntArray, ratio: FloatArray, deviation: FloatArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return log gains (K,) and their standard deviations: robust least squares with a weak prior at 0.

    The prior, whose weight is the same for all, makes their mean 0 wherever overlaps connect them.
    """
    design = np.zeros((len(first), count))
    design[np.arange(len(first)), first], design[np.arange(len(first)), second] = -1, 1
    weight, solution = 1 / deviation**2, np.zeros(count)
    normal = np.eye(count)
    for _ in range(_ROUNDS):
        residual = (ratio - design @ solution) / deviation
        robust = weight / (1 + np.square(residual / _CAUCHY))
        normal = design.T @ (robust[:, None] * design) + np.eye(count) / _PRIOR**2
        solution = np.linalg.solve(normal, design.T @ (robust * ratio))
    alone = ~np.abs(design).any(axis=0)
    spread = np.sqrt(np.maximum(np.diag(np.linalg.inv(normal)), 0))
    # The prior's own uncertainty is common to all that are connected: what is stated is that of the ratios.
    connected = _components(count, first, second)
    for part in np.unique(connected):
        rows = np.flatnonzero(connected == part)
        covariance = np.linalg.pinv(normal)[np.ix_(rows, rows)]
        centred = np.eye(len(rows)) - 1 / len(rows)
        spread[rows] = np.sqrt(np.maximum(np.diag(centred @ covariance @ centred), 0))
    return np.where(alone, 0.0, solution), np.where(alone, np.inf, spread)


def _components(count: int, first: IntArray, second: IntArray) -> NDArray[np.intp]:
    """Return for each of `count` photographs the least index of those that pairs connect it with."""
    part = np.arange(count)
    for _ in range(count):
        before = part.copy()
        np.minimum.at(part, first, part[second])
        np.minimum.at(part, second, part[first])
        if np.array_equal(before, part):
            break
    return part
