"""Things that moved between the photographs: in each cell the photographs that are known to see it vote.

The vote of a cell is the median of each channel over at least three photographs, equalised in exposure. A photograph
deviates where it differs from it by more than its own noise and the contrast around the cell, which a pose that is off
by less than a cell turns into differences. One cell alone says little: only regions most of whose cells deviate are
things that moved, and they extend to where the deviation ends.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.fusion.exposure import Gains
from ladarreg_core.fusion.samples import PhotoSample
from ladarreg_core.surface.texture.registered_texture import Label

_BYTES_AT_ONCE = 80_000_000
_MIN_VOTES = 3
_SCALE = 16  # steps of a code
_NONE = np.uint16(65535)
_MIN_CODES, _MAX_CODES, _SIGMAS = 13.0, 40.0, 4.5
_WINDOW = 5  # cells
_MAX_OF = 0.5
_WEAKER = 0.5
_MIN_CELLS = 12
_GROWN = 2  # cells


def find_moved(samples: Sequence[PhotoSample], colors: Sequence[int], shape: tuple[int, int], gains: Gains) -> None:
    """Set `PhotoSample.moved` of photographs.

    Args:
        samples: of all photographs.
        colors: the indices of those that vote.
        shape: of the scan.
        gains: their gains.
    """
    if len(colors) < _MIN_VOTES:
        return
    deviation = _deviations(samples, colors, shape, gains)
    for k in colors:
        samples[k].moved = _regions(samples[k], deviation[k])


def _deviations(
    samples: Sequence[PhotoSample], colors: Sequence[int], shape: tuple[int, int], gains: Gains
) -> dict[int, NDArray[np.uint8]]:
    """Return for each photograph the codes (h, w) by which it differs from the vote; 0 without a vote."""
    found = {k: np.zeros(samples[k].labels.shape, np.uint8) for k in colors}
    tables = {k: np.minimum(gains.table(k) * _SCALE, 65000).astype(np.uint16) for k in colors}
    rows_at_once = max(8, _BYTES_AT_ONCE // (len(colors) * shape[1] * 6 * 2))
    for first in range(0, shape[0], rows_at_once):
        # A row more on each side: the contrast of the vote is that of three by three cells.
        low, high = max(first - 1, 0), min(first + rows_at_once + 1, shape[0])
        here = [k for k in colors if samples[k].rows.start < high and samples[k].rows.stop > low]
        if len(here) < _MIN_VOTES:
            continue
        left = min(samples[k].columns.start for k in here)
        right = max(samples[k].columns.stop for k in here)
        stack = np.full((high - low, right - left, 3, len(here)), _NONE, np.uint16)
        places = []
        for n, k in enumerate(here):
            inner, outer = _shared(samples[k], low, high, left)
            color, seen = samples[k].color[inner], samples[k].labels[inner] == Label.SEEN
            codes = np.stack([tables[k][:, c][color[..., c]] for c in range(3)], axis=-1)
            stack[(*outer, slice(None), n)] = np.where(seen[..., None], codes, _NONE)
            places.append((k, inner, outer, codes))
        vote, voted = _median(stack)
        contrast = cv2.dilate(vote, np.ones((3, 3))) - cv2.erode(vote, np.ones((3, 3)))
        contrast = contrast.max(axis=-1)
        for k, inner, outer, codes in places:
            off = np.abs(codes.astype(np.float32) / _SCALE - vote[outer]).max(axis=-1) - contrast[outer]
            known = voted[outer] & samples[k].colored[inner]
            start = low + outer[0].start
            kept = slice(max(first - start, 0), max(min(first + rows_at_once - start, len(off)), 0))
            target = slice(inner[0].start + kept.start, inner[0].start + kept.stop)
            found[k][target] = np.where(known, np.clip(off, 0, 255), 0).astype(np.uint8)[kept]
    return found


def _shared(sample: PhotoSample, low: int, high: int, left: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the part of a sample in rows low to high, in the sample and in a block that starts at (low, left)."""
    top, bottom = max(sample.rows.start, low), min(sample.rows.stop, high)
    inner = slice(top - sample.rows.start, bottom - sample.rows.start), slice(0, sample.labels.shape[1])
    start = sample.columns.start - left
    return inner, (slice(top - low, bottom - low), slice(start, start + sample.labels.shape[1]))


def _median(stack: NDArray[np.uint16]) -> tuple[NDArray[np.float32], BoolArray]:
    """Return the median (h, w, 3) over the last axis in codes, and where (h, w) there are enough votes."""
    count = (stack[:, :, 0] != _NONE).sum(axis=-1)
    stack.sort(axis=-1)
    low, high = (np.maximum(count - 1, 0) // 2)[..., None, None], (count // 2)[..., None, None]
    high = np.minimum(high, stack.shape[-1] - 1)
    pick = [
        np.take_along_axis(stack, np.broadcast_to(at, (*stack.shape[:3], 1)), axis=-1)[..., 0] for at in (low, high)
    ]
    voted = count >= _MIN_VOTES
    vote = (pick[0].astype(np.float32) + pick[1]) / np.float32(2 * _SCALE)
    return np.where(voted[..., None], vote, np.float32(0)), voted


def _regions(sample: PhotoSample, deviation: NDArray[np.uint8]) -> BoolArray:
    """Return the cells (h, w) of things that moved."""
    colored = sample.colored
    judged = sample.labels == Label.SEEN  # beside depth edges, a pose that is off by a pixel shows another surface
    typical = deviation[judged]
    if not len(typical):
        return np.zeros(colored.shape, np.bool_)
    noise = 1.4826 * float(np.median(typical))
    limit = float(np.clip(_SIGMAS * noise, _MIN_CODES, _MAX_CODES))
    off = (deviation > limit) & judged
    window = (_WINDOW, _WINDOW)
    share = cv2.blur(off.astype(np.float32), window)
    whole = cv2.blur(judged.astype(np.float32), window)
    core = off & (share >= np.float32(_MAX_OF) * whole)
    weak = ((deviation > _WEAKER * limit) & colored).astype(np.uint8)
    closed = cv2.morphologyEx(weak, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, component, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    cores = np.bincount(component[core], minlength=count)
    kept = (cores >= _MIN_CELLS) & (cores >= 0.15 * stats[:count, cv2.CC_STAT_AREA])
    kept[0] = False
    # A component that is mostly weak is a tone of the picture; of such a one the core itself is what moved.
    alone = core & ~kept[component] & (cores[component] >= _MIN_CELLS)
    region = (kept[component] | alone).astype(np.uint8)
    grown = cv2.dilate(region, np.ones((2 * _GROWN + 1, 2 * _GROWN + 1), np.uint8))
    return np.asarray(grown.astype(np.bool_) & colored)
