"""Whether the pieces of a mosaic fit each other where they overlap, and which was the first that does not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_DISAGREEING = 0.05
"""Share of overlapping cells with surfaces apart, above which pieces do not fit; right mosaics have less than .5 %."""
_MAX_OF_ONE = 0.2
"""Of the pairs across one fault, in a mosaic that is right elsewhere."""
_FEWEST_CELLS = 200


@dataclass(frozen=True, slots=True)
class PieceFit:
    """How well pieces agree where they overlap."""

    fits: bool
    """Whether at most 5 % of the cells of overlaps disagree, and 20 % of those across any one fault, or there are too
    few to say."""
    share: float
    """Share of the cells of all overlaps, pair by pair, whose surfaces are clearly apart."""
    first_misfit: int | None = None
    """Place of the first piece that does not fit; None if the pieces fit."""
    alone: bool = False
    """Whether it is the only one; otherwise all from it on lie elsewhere than those before it."""
    share_without: float = 0.0
    """Share among the other pairs: if it is high as well, there are more faults than this one."""

    def sentence(self, index: int) -> str:
        """Return what is wrong and what to do.

        Args:
            index: number of the first piece that does not fit, as the run counts it.
        """
        which = f"piece {index} lies elsewhere" if self.alone else f"from piece {index} on they lie elsewhere"
        more = f"; {self.share_without:.0%} of the others disagree, too" if self.share_without > MAX_DISAGREEING else ""
        return (
            f"pieces do not fit: in {self.share:.0%} of the overlaps two pieces show surfaces that are apart (right "
            f"mosaics: less than .5 %); {which}{more}. Check which file was measured at which angles, and whether the "
            "unit lost steps, the scanner was knocked or the mount is wrong"
        )

    def as_fields(self) -> dict[str, Any]:
        """Return it as `panorama.json` states it."""
        return {"fits": self.fits, "share": self.share, "first_misfit": self.first_misfit, "alone": self.alone}


class Overlaps:
    """Counts, for pairs of pieces, the cells that both show and those where their surfaces are apart."""

    def __init__(self) -> None:
        self._shared: Counter[tuple[int, int]] = Counter()
        self._apart: Counter[tuple[int, int]] = Counter()

    def add(self, pairs: Iterable[tuple[int, int, int, int]]) -> None:
        """Add first piece, second piece, cells that both show, and cells in which they are apart."""
        for first, second, shared, apart in pairs:
            if shared:
                self._shared[first, second] += shared
                self._apart[first, second] += apart

    def fit(self, pieces: int) -> PieceFit:
        """Return how well the pieces agree.

        Of all ways in which one piece, or all from one on, may lie elsewhere, that one is taken under which the counts
        are most likely if pairs across the fault disagree at one rate, and all others at another.

        Args:
            pieces: how many there are, in the order in which they were measured.
        """
        pairs = np.array(sorted(self._shared), np.intp).reshape(-1, 2)
        shared, apart = (
            np.array([counts[first, second] for first, second in pairs.tolist()], float)
            for counts in (self._shared, self._apart)
        )
        total, wrong = float(shared.sum()), float(apart.sum())
        share = wrong / total if total else 0.0
        if total < _FEWEST_CELLS or not wrong:
            return PieceFit(True, share)
        low, high = pairs.min(axis=1), pairs.max(axis=1)
        faults = [
            np.concatenate([_of_each(low, high, counts, pieces), _from_each_on(low, high, counts, pieces)])
            for counts in (shared, apart)
        ]
        across, bad = faults
        with np.errstate(invalid="ignore", divide="ignore"):
            rate, others = bad / across, np.where(total > across, (wrong - bad) / (total - across), 0.0)
        likelihood = _log_likelihood(bad, across) + _log_likelihood(wrong - bad, total - across)
        likelihood[~((across >= _FEWEST_CELLS) & (rate > others))] = -np.inf
        best = int(np.argmax(likelihood))
        if share <= MAX_DISAGREEING and not (np.isfinite(likelihood[best]) and rate[best] > _MAX_OF_ONE):
            return PieceFit(True, share)
        if not np.isfinite(likelihood[best]):
            return PieceFit(False, share, 0, False, share)
        piece = best % pieces
        return PieceFit(False, share, piece, best < pieces or piece == pieces - 1, float(others[best]))


def _of_each(
    low: NDArray[np.intp], high: NDArray[np.intp], counts: NDArray[np.float64], pieces: int
) -> NDArray[np.float64]:
    """Return the counts (P,) of the pairs of each piece."""
    return np.asarray(np.bincount(low, counts, pieces) + np.bincount(high, counts, pieces), np.float64)


def _from_each_on(
    low: NDArray[np.intp], high: NDArray[np.intp], counts: NDArray[np.float64], pieces: int
) -> NDArray[np.float64]:
    """Return for each piece the counts (P,) of the pairs of one before it and one from it on."""
    steps = np.bincount(low + 1, counts, pieces + 1) - np.bincount(high + 1, counts, pieces + 1)
    return np.asarray(np.round(np.cumsum(steps)[:pieces]), np.float64)


def _log_likelihood(count: NDArray[np.float64], total: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithm of the likelihood of counts under one rate, the most likely one."""
    count, rest = np.maximum(count, 0.0), np.maximum(total - count, 0.0)
    terms = [number * np.log(np.maximum(number, 1e-300)) for number in (count, rest, count + rest)]
    return np.asarray(terms[0] + terms[1] - terms[2])
