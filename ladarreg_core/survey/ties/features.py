"""Features of photographs, and which of them show the same thing in two photographs.

Source: Lowe 2004 (SIFT, ratio test); Arandjelovic and Zisserman 2012 (RootSIFT); Barath et al. 2020 (MAGSAC++).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import ByteArray, FloatArray, IntArray

MAX_FEATURES = 4000
"""Of a photograph: those with the highest contrast are kept."""
_MAX_PIXELS = 2_500_000  # a larger photograph is reduced: its finest features are noise and cost most of the time
_RATIO = 0.8  # Lowe's, of the distances to the nearest and the second nearest descriptor
_EPIPOLAR_PX = 2.0  # of a photograph 1000 px wide; lenses are not known yet
_MIN_PAIR = 16  # matches that one epipolar geometry explains; photographs of different rooms reach 13
_COARSE = 600  # features of the largest scale, by which partners are proposed
_MIN_VOTES = 5
_SAME_PX = 0.1
_ROWS_AT_ONCE = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The N features of a photograph."""

    uv: NDArray[np.float32]
    """(N, 2) photo pixels."""
    descriptors: NDArray[np.float32]
    """(N, 128) RootSIFT, unit length."""
    scale_px: NDArray[np.float32]
    """(N,) diameter of what they show, photo pixels."""

    def __len__(self) -> int:
        return len(self.uv)

    def extended(self, uv: FloatArray) -> Features:
        """Return these and further places (M, 2), px, behind them, which resemble nothing."""
        count = len(uv)
        return Features(
            np.concatenate([self.uv, np.asarray(uv, np.float32).reshape(-1, 2)]),
            np.concatenate([self.descriptors, np.zeros((count, 128), np.float32)]),
            np.concatenate([self.scale_px, np.zeros(count, np.float32)]),
        )


def detect(pixels: ByteArray, *, limit: int = MAX_FEATURES) -> Features:
    """Return the features of a picture (H, W, 3) uint8, at most `limit`."""
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    height, width = gray.shape
    reduction = min(1.0, float(np.sqrt(_MAX_PIXELS / (height * width))))
    if reduction < 1:
        size = (max(1, round(width * reduction)), max(1, round(height * reduction)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    by = np.array([width / gray.shape[1], height / gray.shape[0]])
    # Without precise upscaling all features lie a quarter of a pixel aside.
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=0.02, enable_precise_upscale=True)
    points, found = sift.detectAndCompute(gray, None)
    if found is None or not len(points):
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
    uv = (np.array([point.pt for point in points]) + 0.5) * by - 0.5
    root = np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-9))
    scale = np.array([point.size for point in points]) * by[0]
    order = np.lexsort((uv[:, 1], uv[:, 0], -scale))[:limit]
    return Features(uv[order].astype(np.float32), root[order].astype(np.float32), scale[order].astype(np.float32))


def matches_between(first: Features, second: Features) -> IntArray:
    """Return the matches (M, 2), indices of features of both: mutual, distinct, of one epipolar geometry.

    Photographs that share nothing have none.
    """
    found = _mutual(first.descriptors, second.descriptors)
    found = _one_of_each_place(found, first, second)
    if len(found) < _MIN_PAIR:
        return found[:0]
    a, b = (side.uv[found[:, k]].astype(np.float64) for k, side in enumerate((first, second)))
    allowed = _EPIPOLAR_PX * max(float(np.ptp(a, axis=0).max()), float(np.ptp(b, axis=0).max()), 1000.0) / 1000
    _, inlier = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, allowed, 0.9999, 20_000)
    if inlier is None or int(inlier.sum()) < _MIN_PAIR:
        return found[:0]
    return np.asarray(found[inlier.ravel().astype(bool)])


def propose_pairs(photos: Sequence[Features], *, partners: int = 8) -> list[tuple[int, int]]:
    """Return the pairs of photographs that are worth matching: for each photograph its most similar ones.

    Args:
        photos: the features of each.
        partners: most partners that a photograph proposes; others may propose it as well.
    """
    coarse = [photo.descriptors[:_COARSE] for photo in photos]
    votes = np.zeros((len(photos), len(photos)), np.int64)
    for i in range(len(photos)):
        for j in range(i):
            votes[i, j] = votes[j, i] = len(_mutual(coarse[i], coarse[j]))
    pairs = set()
    for i, row in enumerate(votes):
        for j in np.argsort(-row, kind="stable")[:partners].tolist():
            if row[j] >= _MIN_VOTES:
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def _mutual(first: NDArray[np.float32], second: NDArray[np.float32]) -> IntArray:
    """Return the pairs (M, 2) that are each other's nearest and pass the ratio test."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    best = np.empty(len(first), np.int64)
    distinct = np.empty(len(first), np.bool_)
    back, back_at = np.full(len(second), -np.inf, np.float32), np.full(len(second), -1, np.int64)
    for start in range(0, len(first), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        cosine = first[rows] @ second.T
        two = np.partition(cosine, -2, axis=1)[:, -2:]
        best[rows] = cosine.argmax(axis=1)
        nearest, next_one = np.maximum(2 - 2 * two[:, 1], 0), np.maximum(2 - 2 * two[:, 0], 0)
        distinct[rows] = nearest < _RATIO**2 * next_one
        top, at = cosine.max(axis=0), cosine.argmax(axis=0)
        better = top > back
        back[better], back_at[better] = top[better], at[better] + start
    one = np.flatnonzero(distinct & (back_at[best] == np.arange(len(first))))
    return np.stack([one, best[one]], axis=1)


def _one_of_each_place(found: IntArray, first: Features, second: Features) -> IntArray:
    """Drop matches of features that differ from others in their orientation only."""
    for column, side in enumerate((first, second)):
        places = np.rint(side.uv[found[:, column]] / _SAME_PX).astype(np.int64)
        _, kept = np.unique(places, axis=0, return_index=True)
        found = found[np.sort(kept)]
    return found
