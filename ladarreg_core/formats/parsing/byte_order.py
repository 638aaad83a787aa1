"""Range counts that were read in the wrong byte order: they look like noise, and are smooth in the other one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError

_FEWEST_PAIRS = 1000
_MAX_ROWS = 200
_SMOOTHER = 4.0
_MAX_OF_A_LADAR = 4095


def require_byte_order(counts: NDArray[Any], swapped: NDArray[Any], *, what: str, wanted: str) -> None:
    """Refuse counts that are smooth only in the other byte order.

    Neighbours along a row of a scan differ by little, compared with the spread of all counts; with the bytes of each
    word swapped the fastest byte becomes the slowest, and they differ as noise does.

    Args:
        counts: (H, W) as they were read; 0 = no return.
        swapped: (H, W) as the other byte order has them.
        what: where they are from, for the message.
        wanted: what is to be done.

    Raises:
        FormatError: if the other order is right.
    """
    here, there = _roughness(counts), _roughness(swapped)
    if here is None or there is None:
        return
    too_large = counts.max() > _MAX_OF_A_LADAR >= swapped.max()
    if here > _SMOOTHER * there or (too_large and here > there):
        raise FormatError(
            f"{what} reach {int(counts.max()):,} and look like noise; in the other byte order they reach "
            f"{int(swapped.max()):,} and are {here / max(there, 1e-9):.0f} times smoother: {wanted}"
        )


def _roughness(counts: NDArray[Any]) -> float | None:
    """Return the median step from column to column against the spread of the counts; None if there are too few."""
    rows = counts[:: max(1, len(counts) // _MAX_ROWS)].astype(np.float64)
    left, right = rows[:, :-1], rows[:, 1:]
    both = (left > 0) & (right > 0)
    if both.sum() < _FEWEST_PAIRS:
        return None
    spread = float(np.subtract(*np.quantile(rows[rows > 0], [0.9, 0.1])))
    return float(np.mean(np.minimum(np.abs(right - left)[both], spread))) / max(spread, 1.0)
