"""Landmarks, the points and lines that photographs show, eliminated from the normal equations of poses and cameras.

With H the normal matrix, y the poses and cameras, x the landmarks, which are independent of each other, the reduced
system is S = H_yy - H_yx H_xx^-1 H_xy.

Source: Triggs et al. 2000, 'Bundle adjustment - a modern synthesis' (Schur complement).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, IntArray
from ladarreg_core.survey.least_squares.problem import Matrix

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """N observations of landmarks with R residuals each, whitened, with the roots of their weights."""

    residual: Matrix
    """(N, R) observed minus predicted."""
    by_unknowns: Matrix
    """(N, R, C) derivatives of the prediction by the unknowns that it depends on."""
    columns: IntArray
    """(N, C) columns of these; the number of all unknowns for what is fixed."""
    by_landmark: Matrix
    """(N, R, W) derivatives by the landmark."""
    landmark: IntArray
    """(N,) its index."""


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """P landmarks of one kind, with W unknowns each, and what is left of them for Y poses and cameras."""

    whole: Matrix
    """(Y, Y) H_yy."""
    right: Matrix
    """(Y,) right-hand side of the reduced system."""
    mixed: csr_matrix
    """(Y, W P) H_yx."""
    inverse: Matrix
    """(P, W, W) H_xx^-1."""
    right_landmarks: Matrix
    """(P, W)."""
    rows: tuple[tuple[csr_matrix, Matrix, IntArray], ...]
    """Of all observations the derivatives (R N, Y), residuals (R N,) and landmarks (R N,)."""

    @staticmethod
    def of(observed: Sequence[Observations], count: int, width: int, size: int) -> Eliminated:
        """Eliminate `count` landmarks of `width` unknowns from the equations of `size` poses and cameras."""
        H_xx, b_x = np.zeros((count, width, width)), np.zeros((count, width))
        rows, mixed, whole, b_y = [], _empty(size, width * count), np.zeros((size, size)), np.zeros(size)
        for one in observed:
            each = one.residual.shape[1]
            np.add.at(H_xx, one.landmark, np.einsum("nra,nrb->nab", one.by_landmark, one.by_landmark))
            np.add.at(b_x, one.landmark, np.einsum("nra,nr->na", one.by_landmark, one.residual))
            J = one.by_unknowns.reshape(-1, one.by_unknowns.shape[2])
            derivatives = _sparse(J, np.repeat(one.columns, each, axis=0), size)
            off = one.residual.ravel()
            rows.append((derivatives, off, np.repeat(one.landmark, each)))
            cross = np.einsum("nra,nrb->nab", one.by_unknowns, one.by_landmark)
            mixed = mixed + _mixed(cross, one.columns, one.landmark, size, count)
            whole += (derivatives.T @ derivatives).toarray()
            b_y += derivatives.T @ off
        trace = np.trace(H_xx, axis1=1, axis2=2)
        H_xx += (1e-9 * trace + 1e-12)[:, None, None] * np.eye(width)
        inverse = np.linalg.inv(H_xx)
        right = b_y - mixed @ (_block_diagonal(inverse) @ b_x.ravel())
        return Eliminated(whole, right, mixed, inverse, b_x, tuple(rows))

    @property
    def reduced(self) -> Matrix:
        """(Y, Y) what the landmarks say of poses and cameras: H_yy - H_yx H_xx^-1 H_xy."""
        return np.asarray(self.whole - (self.mixed @ _block_diagonal(self.inverse) @ self.mixed.T).toarray())

    def step(self, of_unknowns: Matrix) -> Matrix:
        """Return the step of the landmarks (P, W) for one of poses and cameras (Y,)."""
        back = self.right_landmarks - (self.mixed.T @ of_unknowns).reshape(self.right_landmarks.shape)
        return np.asarray(np.einsum("pij,pj->pi", self.inverse, back))

    def of_some(self, chosen: BoolArray) -> tuple[Matrix, Matrix]:
        """Return the information (Y, Y) of some landmarks (P,) and their observations, and their score (Y,)."""
        at, width = np.flatnonzero(chosen), self.right_landmarks.shape[1]
        mixed = self.mixed[:, (width * at[:, None] + np.arange(width)).ravel()]
        own = -(mixed @ _block_diagonal(self.inverse[at]) @ mixed.T)
        score = np.zeros(len(self.right))
        for derivatives, off, landmark in self.rows:
            seen = chosen[landmark]
            J = derivatives[seen]
            own = own + J.T @ J
            score += J.T @ off[seen]
        return np.asarray(own.toarray()), score


def _empty(rows: int, columns: int) -> csr_matrix:
    from scipy.sparse import csr_matrix

    return csr_matrix((rows, columns))


def _sparse(rows: Matrix, columns: IntArray, size: int) -> csr_matrix:
    """Return rows (N, C) at columns (N, C) of a matrix (N, size); the column `size` is dropped."""
    from scipy.sparse import csr_matrix

    at = np.repeat(np.arange(len(rows)), rows.shape[1])
    whole = csr_matrix((rows.ravel(), (at, columns.ravel())), shape=(len(rows), size + 1))
    return whole[:, :size]


def _mixed(blocks: Matrix, columns: IntArray, landmark: IntArray, size: int, count: int) -> csr_matrix:
    """Return blocks (N, C, W) at rows (N, C) and the columns of landmarks (N,), of (size, W count)."""
    from scipy.sparse import csr_matrix

    (n, c), width = columns.shape, blocks.shape[2]
    rows = np.repeat(columns.ravel(), width)
    at = (width * landmark[:, None, None] + np.arange(width)).repeat(c, axis=1).ravel()
    return csr_matrix((blocks.reshape(n * c * width), (rows, at)), shape=(size + 1, width * count))[:size]


def _block_diagonal(blocks: Matrix) -> csr_matrix:
    from scipy.sparse import csr_matrix

    count, width = blocks.shape[:2]
    rows = np.repeat(np.arange(width * count), width)
    columns = (width * np.arange(count)[:, None, None] + np.arange(width)).repeat(width, axis=1).ravel()
    return csr_matrix((blocks.ravel(), (rows, columns)), shape=(width * count, width * count))
