"""Which photograph colours each cell: one a cell, in coherent regions, mixed only narrowly where they meet.

The weights of a photograph are averaged over neighbouring cells, and a cell joins what most of its neighbours have
where the weights differ little (iterated conditional modes of a Potts model on the filtered weights). A picture that is
a mean of several would be blurred by the errors of their poses; so each cell has one, but for a band along the seams.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.fusion.exposure import Gains
from ladarreg_core.fusion.samples import PhotoSample
from ladarreg_core.surface.texture.best_photo import NO_PHOTO
from ladarreg_core.surface.texture.registered_texture import Label

_FILTER, _NEIGHBOURS, _BAND = 9, 7, 5  # cells
_ROUNDS = 4
_ROWS_AT_ONCE = 256
_SMOOTHNESS = 2.5  # log2 of a weight, for a cell all of whose neighbours have the photograph
_MOVED = -16.0  # log2: what moved colours a cell only where nothing else does
_WORST = np.float32(-1e4)


def chosen_photos(samples: Sequence[PhotoSample], colors: Sequence[int], shape: tuple[int, int]) -> NDArray[np.uint16]:
    """Return the photograph that colours each cell, (H, W) uint16; `NO_PHOTO` where none shows it."""
    scores = {k: _filtered(samples[k]) for k in colors}
    label = np.full(shape, NO_PHOTO, np.uint16)
    for _ in range(_ROUNDS if len(colors) > 1 else 1):
        best = np.full(shape, _WORST, np.float32)
        after = np.full(shape, NO_PHOTO, np.uint16)
        for k in colors:
            here = samples[k].here
            score = scores[k]
            share = cv2.blur((label[here] == k).astype(np.float32), (_NEIGHBOURS, _NEIGHBOURS))
            score = score + np.float32(_SMOOTHNESS) * share
            better = (score > best[here]) & samples[k].colored
            best[here][better] = score[better]
            after[here][better] = k
        if np.array_equal(after, label):
            break
        label = after
    return label


def _filtered(sample: PhotoSample) -> NDArray[np.float32]:
    """Return the weights (h, w), averaged over neighbours; `_WORST` where the photograph shows nothing."""
    shown = sample.colored
    merit = np.where(shown, sample.merit.astype(np.float32), 0)
    window = (_FILTER, _FILTER)
    mean = cv2.blur(merit, window) / np.maximum(cv2.blur(shown.astype(np.float32), window), np.float32(1e-3))
    # The label of the cell itself counts fully: neighbours do not make a cell at a depth edge certain.
    own = np.minimum(mean, merit + np.float32(1))
    return np.where(shown, own + np.where(sample.moved, np.float32(_MOVED), 0), _WORST)


def blended(
    samples: Sequence[PhotoSample],
    colors: Sequence[int],
    photo: NDArray[np.uint16],
    gains: Gains,
    background: tuple[int, int, int],
) -> NDArray[np.uint8]:
    """Return the colours (H, W, 3) of cells by their photographs, mixed within a few cells of a seam.

    Args:
        samples: of all photographs.
        colors: the indices of those that colour.
        photo: (H, W) what colours each cell.
        gains: of the photographs.
        background: RGB of cells that none shows.
    """
    total = np.zeros((*photo.shape, 3), np.float32)
    weight = np.zeros(photo.shape, np.float32)
    for k in colors:
        sample = samples[k]
        here, table = sample.here, gains.table(k)
        own = photo[here] == k
        if not own.any():
            continue
        share = cv2.blur(own.astype(np.float32), (_BAND, _BAND))
        share *= own | (sample.usable & (sample.labels == Label.SEEN))
        share[own] = np.maximum(share[own], np.float32(0.04))
        weight[here] += share
        part = total[here]
        for first in range(0, len(share), _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            for c in range(3):
                part[rows, :, c] += share[rows] * table[:, c][sample.color[rows, :, c]]
    none = photo == NO_PHOTO
    image = np.empty(total.shape, np.uint8)
    for first in range(0, len(total), _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        mean = total[rows] / np.maximum(weight[rows], np.float32(1e-6))[..., None]
        image[rows] = np.rint(np.clip(mean, 0, 255))
    image[none] = background
    return image
