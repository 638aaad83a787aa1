"""What the corrections of a run's pieces have in common: a mount that is wrong, or a blow between two pieces.

Each is six numbers that move all pieces, or all later ones. Whether they would make the overlaps agree better than the
angles' own errors do is found from the equations of an adjustment that did not know them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.adjustment import Adjustment, Common, RangeView, adjoint
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid

_MIN_GAIN = 60.0
"""Chi^2 of six degrees of freedom beyond which a fault is reported: chance and uneven walls never reach it."""
_MIN_SIZE = (0.001, float(np.radians(0.05)))
_LARGE = (0.003, float(np.radians(0.1)))
_CLEARLY_BETTER = 1.3  # times the gain of the next explanation
_SIGMA_BLOW = (0.005, float(np.radians(0.5)))  # where overlaps show it, it may be many times that

Kind = Literal["mount", "scanner", "unit"]
"""The mount is wrong in all pieces; the scanner was moved on its unit; the unit was moved on its stand."""


@dataclass(frozen=True, slots=True)
class RunFault:
    """A fault that many pieces share."""

    kind: Kind
    first: int
    """The first piece that has it; 0 for a wrong mount."""
    shift_m: float
    """How far the scanner is shifted by it."""
    turn_rad: float
    """How far it is turned."""

    @property
    def is_large(self) -> bool:
        """Whether pieces refined without knowing of it would be misplaced by more than refining them is worth."""
        return self.shift_m > _LARGE[0] or self.turn_rad > _LARGE[1]

    @property
    def sentence(self) -> str:
        """What was found and what to do, for the operator."""
        size = f"{1000 * self.shift_m:.1f} mm and {np.degrees(self.turn_rad):.2f} deg"
        if self.kind == "mount":
            return f"the overlaps show the mount to be off by about {size}; calibrate it with `calibrate_mount`"
        who = "the scanner was moved on its unit" if self.kind == "scanner" else "the unit was moved on its stand"
        return (
            f"between pieces {self.first - 1} and {self.first} {who}, by about {size}; the pieces since then are used "
            "where their surfaces lie, but fasten it and measure again if the panorama shows it"
        )


def blow(first: int, kind: Kind) -> Common:
    """Return the parameters (shift, then turn) of a blow that all pieces from one on have."""

    def moves(poses: Sequence[Rigid]) -> NDArray[np.float64]:
        return _moves(poses, first, kind)

    return Common(moves, np.diag([_SIGMA_BLOW[0] ** -2] * 3 + [_SIGMA_BLOW[1] ** -2] * 3))


def together(first: Common | None, second: Common) -> Common:
    """Return both sets of parameters as one, the first ones first."""
    if first is None:
        return second
    one, count = first, len(first.information)
    both = np.zeros((count + len(second.information),) * 2)
    both[:count, :count], both[count:, count:] = first.information, second.information
    return Common(lambda poses: np.concatenate([one.moves(poses), second.moves(poses)], axis=-1), both)


def fault_of_run(found: Adjustment, views: Sequence[RangeView], common: Common | None) -> RunFault | None:
    """Return the fault that pieces have in common, None if there is none, or one piece alone explains it better.

    Args:
        found: an adjustment of all pieces without such a fault.
        views: what was adjusted, in the order of the run.
        common: the parameters it was adjusted with; with those of a mount, none is searched for.

    Source: the score test of a model with further parameters; Rao 1948.
    """
    count = len(views)
    test = _Test.of(found, views, common)
    alone = max((test.of_moves(_moves(found.poses, k, "scanner", k + 1))[0] for k in range(count)), default=0.0)
    kinds: list[tuple[Kind, int]] = [] if common is not None else [("mount", 0)]
    # A blow before the first or the last piece is a knock of that piece alone.
    kinds += [(kind, first) for first in range(2, count - 1) for kind in ("scanner", "unit")]
    best, fault = max(_MIN_GAIN, _CLEARLY_BETTER * alone), None
    for kind, first in kinds:
        gain, size = test.of_moves(_moves(found.poses, first, kind))
        # That the mount is wrong needs no blow, and two halves of a run explain a little more by chance.
        if gain > best * (_CLEARLY_BETTER if fault is not None and fault.kind == "mount" else 1.0):
            shift, turn = float(np.linalg.norm(size[:3])), float(np.linalg.norm(size[3:]))
            if shift > _MIN_SIZE[0] or turn > _MIN_SIZE[1]:
                best, fault = gain, RunFault(kind, first, shift, turn)
    return fault


@dataclass(frozen=True, slots=True, eq=False)
class _Test:
    data: NDArray[np.float64]
    gradient: NDArray[np.float64]
    own: NDArray[np.float64]
    """(6 V, 6 V + C) moves of the pieces by the parameters that were adjusted."""
    inverse: NDArray[np.float64]

    @staticmethod
    def of(found: Adjustment, views: Sequence[RangeView], common: Common | None) -> _Test:
        size = 6 * len(views)
        extra = 0 if common is None else len(common.information)
        own, prior = np.zeros((size, size + extra)), np.zeros((size + extra, size + extra))
        own[:, :size] = np.eye(size)
        for k, view in enumerate(views):
            prior[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = view.information
        # At the optimum the data pull as strongly as the priors hold.
        gradient = -prior[:size, :size] @ found.moved.ravel()
        if common is not None:
            own[:, size:] = common.moves(found.poses).reshape(size, extra)
            prior[size:, size:] = common.information
        inverse = np.linalg.pinv(own.T @ found.data @ own + prior, hermitian=True)
        return _Test(found.data, gradient, own, np.asarray(inverse, np.float64))

    def of_moves(self, moves: FloatArray) -> tuple[float, NDArray[np.float64]]:
        """Return by how much chi^2 would be less, and the parameters (6,), with moves (V, 6, 6)."""
        J = moves.reshape(-1, 6)
        mixed = self.own.T @ self.data @ J
        scale = np.repeat(_SIGMA_BLOW, 3)
        information = J.T @ self.data @ J - mixed.T @ self.inverse @ mixed
        information = information * scale * scale[:, None] + np.eye(6)
        score = -scale * (J.T @ self.gradient)
        step = np.linalg.solve(information, score)
        return float(score @ step), scale * step


def _moves(poses: Sequence[Rigid], first: int, kind: Kind, end: int | None = None) -> NDArray[np.float64]:
    """Return the (V, 6, 6) derivatives of the pieces' (w, t) by a shift and a turn that those from `first` on have."""
    out = np.zeros((len(poses), 6, 6))
    for k in range(first, len(poses) if end is None else end):
        of = np.eye(6) if kind == "unit" else adjoint(poses[k])
        out[k] = np.hstack([of[:, 3:], of[:, :3]])
    return out
