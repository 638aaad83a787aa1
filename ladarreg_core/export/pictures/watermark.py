"""Watermarks: words across a picture that must not be taken for a registered one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.palette import Color

_FONT = cv2.FONT_HERSHEY_DUPLEX
_SHARE = 0.86  # of the picture's diagonal that the words take
_STEEPEST = 35.0  # deg
_OPACITY, _OUTLINE_OPACITY = 0.72, 0.6
_PX_PER_LINE = 420  # a tall picture bears the words several times, so that a part of it bears them, too


def watermarked(picture: ByteArray, words: str, color: Color) -> NDArray[np.uint8]:
    """Return a picture with large words written diagonally across it; its size stays.

    Args:
        picture: (H, W, 3) uint8 RGB.
        words: the words, ASCII.
        colour: their colour; they have a black outline, so that they show on any ground.
    """
    height, width = picture.shape[:2]
    lines = max(1, round(height / _PX_PER_LINE)) if height > width / 2 else 1
    outline, letters = np.zeros((2, height, width), np.float32)
    for k in range(lines):
        _write(words, (width, height / lines), (width / 2, (k + 0.5) * height / lines), outline, letters)
    ground = picture.astype(np.float32) * (1 - _OUTLINE_OPACITY * outline[..., None])
    ink = _OPACITY * letters[..., None]
    found: NDArray[np.uint8] = np.rint(ground * (1 - ink) + np.array(color, np.float32) * ink).astype(np.uint8)
    return found


def _write(
    words: str, room: tuple[float, float], centre: tuple[float, float], outline: NDArray[np.float32],
    letters: NDArray[np.float32],
) -> None:  # fmt: skip
    """Write words into a part of the masks, rotated so that they rise to the right."""
    width, height = room
    angle = min(float(np.degrees(np.arctan2(height, width))), _STEEPEST)
    (text_width, text_height), _ = cv2.getTextSize(words, _FONT, 1.0, 2)
    turn = np.radians(angle)
    across = (
        text_width * np.cos(turn) + text_height * np.sin(turn),
        text_width * np.sin(turn) + text_height * np.cos(turn),
    )
    scale = _SHARE * min(width / across[0], height / across[1])
    thick = max(1, round(2.2 * scale))
    pad = 4 * thick + 2
    (text_width, text_height), base = cv2.getTextSize(words, _FONT, scale, thick)
    size = text_width + 2 * pad, text_height + base + 2 * pad
    matrix = np.array(cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), angle, 1.0), np.float64)
    matrix[:, 2] += np.array(centre) - np.array(size) / 2
    for mask, weight in ((outline, 3 * thick), (letters, thick)):
        flat = np.zeros((size[1], size[0]), np.uint8)
        cv2.putText(flat, words, (pad, pad + text_height), _FONT, scale, 255, weight, cv2.LINE_AA)
        turned = cv2.warpAffine(
            flat.astype(np.float32) / 255, matrix, (mask.shape[1], mask.shape[0]), flags=cv2.INTER_LINEAR
        )
        np.maximum(mask, turned, out=mask)
