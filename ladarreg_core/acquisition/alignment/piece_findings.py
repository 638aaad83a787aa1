"""What a refinement of pieces shows about the run: pieces that were knocked out of place, and pieces held weakly."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray

WEAK_DEG = 0.01
"""Standard deviation of an angle beyond which a piece is reported as weak."""
_KNOCKED_MM, _KNOCKED_ROLL_DEG, _KNOCKED_DEG = 1.0, 0.05, 0.5
_MANY_MADS = 8.0
_MAD = 1.4826


def knocked_pieces(turns_deg: FloatArray, shifts_mm: FloatArray, known: BoolArray) -> BoolArray:
    """Return the pieces (V,) that do not lie where the unit carries the others.

    A wrong mount moves the scanner alike in every piece, in its own frame; what differs from piece to piece is the
    error of the angles, which cannot shift the scanner nor roll it.

    Args:
        turns_deg: (V, 3) corrections about the pan axis, the tilt axis and the axis ahead.
        shifts_mm: (V, 3) corrections of the place, in each scanner's own frame.
        known: (V,) the pieces that were refined.
    """
    out = np.zeros(len(known), np.bool_)
    if known.sum() < 3:
        return out
    shift = shifts_mm - np.median(shifts_mm[known], axis=0)
    turn = turns_deg - np.median(turns_deg[known], axis=0)
    usual = _MAD * np.median(np.abs(turn[known, :2]))
    out |= np.linalg.norm(shift, axis=-1) > _KNOCKED_MM
    out |= np.abs(turn[:, 2]) > _KNOCKED_ROLL_DEG
    out |= np.abs(turn[:, :2]).max(axis=-1) > max(_KNOCKED_DEG, _MANY_MADS * usual)
    return np.asarray(out & known, np.bool_)


def knocked_reason(knocked: BoolArray, turns_deg: FloatArray, shifts_mm: FloatArray) -> str:
    """Return the sentence about pieces that were knocked."""
    farthest = float(np.linalg.norm(shifts_mm[knocked], axis=-1).max())
    widest = float(np.abs(turns_deg[knocked]).max())
    who, do = _pieces(np.flatnonzero(knocked)), "does" if knocked.sum() == 1 else "do"
    return (
        f"{who} {do} not lie where the unit carries the others (up to {farthest:.1f} mm and {widest:.2f} deg off): the "
        "scanner or the unit was knocked, or the unit lost steps; they are used where their surfaces lie, but measure "
        "again if the panorama shows it"
    )


def weak_reasons(weak: Sequence[Sequence[str]], sigma_deg: FloatArray) -> list[str]:
    """Return a sentence for each angle in which some pieces are held weakly, (V, 2) the standard deviations."""
    out = []
    for axis, name in enumerate(("pan", "tilt")):
        those = [k for k, names in enumerate(weak) if name in names]
        if those:
            most = float(np.max(sigma_deg[those, axis]))
            out.append(
                f"{_pieces(those)}: held weakly in {name} (up to {most:.3f} deg, one sigma): little in the overlaps "
                "shows it"
            )
    return out


def _pieces(numbers: Sequence[int] | IntArray) -> str:
    """Return `piece 3`, or `pieces 1, 4 to 7`."""
    listed = [int(number) for number in numbers]
    starts = [0, *(k + 1 for k, (a, b) in enumerate(pairwise(listed)) if b > a + 1), len(listed)]
    parts = []
    for first, last in pairwise(starts):
        run = listed[first:last]
        parts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else [str(number) for number in run]
    return f"piece{'s' * (len(listed) > 1)} {', '.join(parts)}"
