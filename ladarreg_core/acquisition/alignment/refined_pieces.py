"""Pieces after their refinement: what is known of each, and the remarks on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.mosaic_piece import PlacedPiece
from ladarreg_core.acquisition.alignment.piece_findings import WEAK_DEG, knocked_pieces, knocked_reason, weak_reasons
from ladarreg_core.acquisition.alignment.run_faults import RunFault
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid

PARAMETERS = ("x", "y", "z", "roll", "pitch", "yaw")
"""Parameters of a mount, in this order."""

_UNDETERMINED_MOUNT = (0.005, float(np.radians(0.1)))  # standard deviations, m and rad
_HELD_WELL = 2.0  # median standard deviations

State = Literal["refined", "no overlap", "not determined", "kept"]
"""`refined`; too little overlap, or surfaces that do not hold it: the unit's angles stay; `kept`: the refinement as a
whole was no better and none of it is used."""


@dataclass(frozen=True, slots=True)
class RefinedPiece:
    """One piece after the refinement."""

    world_from_scanner: Rigid
    """The pose to use."""
    state: State
    """Whether it was refined."""
    turn_deg: tuple[float, float, float]
    """Correction about the pan axis, about the tilt axis, and about the axis ahead, degrees."""
    shift_scanner_mm: tuple[float, float, float]
    """The shift beside it, in the scanner's own frame."""
    sigma_deg: tuple[float, float]
    """Standard deviations of its pan and tilt against the pieces that are held well: what turns all alike is the
    unit's."""
    points: int
    """Points that it shares with other pieces."""
    weak: tuple[str, ...] = ()
    """`pan`, `tilt`: which of its angles are held only weakly."""
    knocked: bool = False
    """It does not lie where the unit carries the others."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """Pieces refined against each other, and how well they then agree."""

    pieces: tuple[RefinedPiece, ...]
    """One a piece."""
    accepted: bool
    """Surfaces that were not fitted to agree better than before."""
    mount: Rigid
    """`unit_from_scanner`: calibrated if that was asked and is `accepted`."""
    mount_covariance: NDArray[np.float64] | None
    """(6, 6) of `PARAMETERS`, m and rad, infinite on the diagonal where not determined; None: not calibrated."""
    held_out_before_m: float
    """RMS distance from planes that were not fitted to, before; NaN without any."""
    held_out_after_m: float
    """The same after."""
    noise_m: float
    """RMS distance from planes fitted to each piece alone: what no pose can remove."""
    planes: int
    """Planes that pieces share."""
    reasons: tuple[str, ...] = field(default=())
    """Sentences for the operator."""

    @property
    def mount_determined(self) -> tuple[bool, ...]:
        """(6,) whether the overlaps show each parameter of the mount."""
        if self.mount_covariance is None:
            return (False,) * 6
        return tuple(bool(value) for value in np.isfinite(np.diag(self.mount_covariance)))


def judged(made: Refinement, spread_rad: FloatArray, fault: RunFault | None) -> Refinement:
    """Return a refinement with the remarks on its pieces."""
    known = np.array([one.state == "refined" for one in made.pieces])
    sigma = np.maximum([one.sigma_deg for one in made.pieces], np.degrees(spread_rad))
    turns = np.array([one.turn_deg for one in made.pieces])
    shifts = np.array([one.shift_scanner_mm for one in made.pieces])
    first = fault.first if fault is not None and fault.kind != "mount" else len(known)
    before = np.arange(len(known)) < first
    knocked = knocked_pieces(turns, shifts, known & before)
    weak = [
        tuple(name for name, value in zip(("pan", "tilt"), of, strict=True) if there and value > WEAK_DEG)
        for of, there in zip(sigma, known, strict=True)
    ]
    reasons = [*made.reasons, *weak_reasons(weak, sigma)]
    if knocked.any():
        reasons.append(knocked_reason(knocked, turns, shifts))
    knocked |= known & ~before
    pieces = tuple(
        replace(one, sigma_deg=(float(of[0]), float(of[1])), weak=names, knocked=bool(off))
        for one, of, names, off in zip(made.pieces, sigma, weak, knocked, strict=True)
    )
    return replace(made, pieces=pieces, reasons=tuple(reasons))


def against_all(covariance: FloatArray) -> NDArray[np.float64]:
    """Return the covariance (V, 3, 3) of each view's turn less the mean turn of those that are held well.

    Otherwise one that nothing holds would make all the others uncertain.
    """
    views = len(covariance) // 6
    turns = covariance.reshape(views, 6, views, 6)[:, :3, :, :3]
    each = np.arange(views)
    share = np.full(views, 1 / views)
    for _ in range(2):
        mixed = np.einsum("aibj,b->aij", turns, share)  # of one view with all
        mean = np.einsum("aij,a->ij", mixed, share)
        own = turns[each, :, each] - mixed - mixed.transpose(0, 2, 1) + mean
        size = np.trace(own, axis1=1, axis2=2)
        strong = size <= _HELD_WELL**2 * np.median(size)
        share = strong / strong.sum()
    return np.asarray(own)


def calibrated_mount(mount: Rigid, moved: FloatArray, covariance: FloatArray) -> tuple[Rigid, NDArray[np.float64]]:
    """Return the mount with what is determined of its correction, and its covariance."""
    limit = np.repeat(_UNDETERMINED_MOUNT, 3)
    known = np.sqrt(np.diag(covariance)) < limit
    # What is not determined is set back to zero, and the rest follows as its correlation says.
    step = np.array(moved, np.float64)
    if not known.all() and known.any():
        lost = ~known
        gain = covariance[np.ix_(known, lost)] @ np.linalg.pinv(covariance[np.ix_(lost, lost)])
        step[known] -= gain @ step[lost]
    step[~known] = 0
    out = np.array(covariance, np.float64)
    out[~known] = 0
    out[:, ~known] = 0
    out[~known, ~known] = np.inf
    return mount @ Rigid.from_rotvec(step[3:], step[:3]), out


def kept(
    pieces: Sequence[PlacedPiece],
    mount: Rigid,
    enough: BoolArray,
    why: str,
    before: float = float("nan"),
    after: float = float("nan"),
) -> Refinement:
    """Return a refinement that changes nothing, and says why."""
    nothing = (0.0, 0.0, 0.0)
    nan = float("nan")
    return Refinement(
        tuple(
            RefinedPiece(one.world_from_scanner, "kept" if there else "no overlap", nothing, nothing, (nan, nan), 0)
            for one, there in zip(pieces, enough, strict=True)
        ),
        accepted=False, mount=mount, mount_covariance=None, held_out_before_m=before, held_out_after_m=after,
        noise_m=nan, planes=0, reasons=(why,),
    )  # fmt: skip
