"""Picks are what was put down; matches are what a solver eats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.errors import ShapeError
from ladarreg_core.validation import require_choice, require_positive

PickKind = Literal["point", "line"]


@dataclass(frozen=True, slots=True, eq=False)
class Pick:
    """One pair of features, put down by a person or a detector.

    Raises:
        ShapeError: if a point has not one coordinate on each side or a line not two, or a coordinate is not finite.
    """

    id: str
    """Stable name."""
    kind: PickKind
    """`point` or `line`."""
    scan: FloatArray
    """(1 or 2, 3) unit rays, scanner frame."""
    photo: FloatArray
    """(1 or 2, 2) pixels."""
    on: bool = True
    """Whether a solver may use it."""
    weight: float = 1.0
    """Relative weight, > 0."""
    origin: str = "manual"
    """Who put it down: `manual`, `file`, or the name of a detector."""

    def __post_init__(self) -> None:
        require_choice(self.kind, get_args(PickKind), f"the kind of match {self.id!r}", error=ShapeError)
        ends = 1 if self.kind == "point" else 2
        scan = read_only(self.scan, np.float64, (ends, 3), f"the scan side of match {self.id!r}")
        photo = read_only(self.photo, np.float64, (ends, 2), f"the photo side of match {self.id!r}")
        if not (np.isfinite(scan).all() and np.isfinite(photo).all() and scan.any(axis=-1).all()):
            raise ShapeError(f"match {self.id!r} has a coordinate that is not finite, or a ray of no length")
        require_positive(self.weight, f"the weight of match {self.id!r}", error=ShapeError)
        object.__setattr__(self, "scan", read_only(unit_rays(scan), np.float64, (ends, 3), "rays"))
        object.__setattr__(self, "photo", photo)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """M correspondences between the scan and the photo.

    Raises:
        ShapeError: if the arrays disagree.
    """

    rays: FloatArray
    """(M, 3) unit, scanner frame."""
    ranges: FloatArray
    """(M,) m along the ray."""
    uv: FloatArray
    """(M, 2) photo pixels."""
    pick_ids: tuple[str, ...] = ()
    """The pick that each came from; one per match, or none at all."""
    fractions: FloatArray | None = None
    """(M,) where along its pick's line each lies, 0 to 1; 0 for points. None: all points."""
    weights: FloatArray | None = None
    """(M,) relative weights of the whole match. None: all 1."""
    range_weights: FloatArray | None = None
    """(M,) relative weights of the ranges alone, beside `weights`: weak returns less, means of many more. None: 1."""
    directions: FloatArray | None = None
    """(M, 2) unit vector along the drawn line, photo pixels; 0 for points. None: all points."""
    across: BoolArray | None = None
    """(M,) bool: known across its line only, as where the ends were not drawn at the same places. None: none."""

    def __post_init__(self) -> None:
        rays = read_only(self.rays, np.float64, (None, 3), "the matches' rays")
        count = len(rays)
        object.__setattr__(self, "rays", rays)
        object.__setattr__(self, "ranges", read_only(self.ranges, np.float64, (count,), "the matches' ranges"))
        object.__setattr__(self, "uv", read_only(self.uv, np.float64, (count, 2), "the matches' pixels"))
        for name, empty in (("fractions", 0.0), ("weights", 1.0), ("range_weights", 1.0)):
            value: ArrayLike | None = getattr(self, name)
            filled = np.full(count, empty) if value is None else value
            words = f"the matches' {name.replace('_', ' ')}"
            object.__setattr__(self, name, read_only(filled, np.float64, (count,), words))
        directions = np.zeros((count, 2)) if self.directions is None else self.directions
        across = np.zeros(count, np.bool_) if self.across is None else self.across
        object.__setattr__(self, "directions", read_only(directions, np.float64, (count, 2), "the lines' directions"))
        object.__setattr__(self, "across", read_only(across, np.bool_, (count,), "the matches' 'across'"))
        ids = tuple(map(str, self.pick_ids)) or tuple(str(k + 1) for k in range(count))
        if len(ids) != count:
            raise ShapeError(f"there are {len(ids)} pick ids for {count} matches; give one each, or none")
        object.__setattr__(self, "pick_ids", ids)

    def __len__(self) -> int:
        return len(self.rays)

    @property
    def points(self) -> FloatArray:
        """(M, 3) points, scanner frame, m."""
        return self.rays * self.ranges[:, None]

    def subset(self, keep: IntArray | ArrayLike) -> Matches:
        """Return the matches of a mask (M,) or of indices, in that order."""
        chosen = np.asarray(keep)
        index = np.arange(len(self))[chosen if chosen.size else chosen.astype(np.intp)]
        assert self.fractions is not None
        assert self.weights is not None
        assert self.range_weights is not None
        assert self.directions is not None
        assert self.across is not None
        ids = tuple(self.pick_ids[k] for k in index)
        if not ids:
            return Matches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)))
        return Matches(
            self.rays[index],
            self.ranges[index],
            self.uv[index],
            ids,
            self.fractions[index],
            self.weights[index],
            self.range_weights[index],
            self.directions[index],
            self.across[index],
        )

    @staticmethod
    def joined(parts: Sequence[Matches]) -> Matches:
        """Return the matches of all parts in one, as drawn lines and points beside corners found by machine."""
        if not parts:
            return Matches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)))
        ids = tuple(name for part in parts for name in part.pick_ids)
        columns = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("fractions", "weights", "range_weights", "directions", "across")
        )
        rays, ranges, uv = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("rays", "ranges", "uv")
        )
        return Matches(rays, ranges, uv, ids, *columns)

    @property
    def dimensions(self) -> IntArray:
        """(M,) how many coordinates each is known in: 2, or 1 across a line."""
        assert self.across is not None
        return np.where(self.across, 1, 2)


def unit_rays(vectors: FloatArray) -> NDArray[np.float64]:
    """Return the directions (..., 3) of vectors (..., 3), float64, finite and not zero, whatever their length.

    The vectors are scaled by a power of two first, which is exact: squares of 1e308 overflow, those of 1e-308 vanish.
    """
    _, exponent = np.frexp(np.abs(vectors).max(axis=-1, keepdims=True))
    scaled = np.ldexp(vectors, -exponent)
    return np.asarray(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True))


def across_lines(matches: Matches, vectors: FloatArray) -> FloatArray:
    """Return vectors (M, 2), photo pixels, without the part along its line of what is known across it only."""
    assert matches.across is not None
    assert matches.directions is not None
    if not matches.across.any():
        return vectors
    along = (vectors * matches.directions).sum(axis=1, keepdims=True) * matches.directions
    return np.where(matches.across[:, None], vectors - along, vectors)
