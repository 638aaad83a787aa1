"""What the simulated line scanner sees where no room is needed."""

from __future__ import annotations

import numpy as np


def wall(angles: np.ndarray, times: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """A wall two metres ahead, none behind."""
    with np.errstate(divide="ignore"):
        ranges = np.where(np.cos(angles) > 0.2, 2.0 / np.cos(angles), np.nan)
    return ranges.astype(np.float32), np.full(len(angles), 1000.0 + number, np.float32)
