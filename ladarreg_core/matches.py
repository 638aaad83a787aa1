"""Picks, as a person or a detector put them down, and matches, the input of the solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.validation import require_choice, require_positive

PickKind = Literal["point", "line"]
MIN_LINE_PX = 5.0
"""Length below which a drawn line says too little of its direction: that of ends known to 1 px errs by 16 degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class Pick:
    """A pair of corresponding points or lines, put down by a person or a detector.

    Raises:
        ShapeError: if a point does not have one coordinate on each side, or a line two, or a coordinate is not finite.
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
    """Source: `manual`, `file`, or the name of a detector."""
    lengths_m: FloatArray | None = None
    """(1 or 2,) distances from the scanner that came with the match, m, used as its ranges; None: the scan's are."""
    name: str = ""
    """Name for users, e.g. of a target; empty: none."""

    def __post_init__(self) -> None:
        require_choice(self.kind, get_args(PickKind), f"the kind of match {self.id!r}", error=ShapeError)
        ends = 1 if self.kind == "point" else 2
        scan = read_only(self.scan, np.float64, (ends, 3), f"the scan side of match {self.id!r}")
        photo = read_only(self.photo, np.float64, (ends, 2), f"the photo side of match {self.id!r}")
        if not (np.isfinite(scan).all() and np.isfinite(photo).all() and scan.any(axis=-1).all()):
            raise ShapeError(f"match {self.id!r} has a coordinate that is not finite, or a ray of length zero")
        require_positive(self.weight, f"the weight of match {self.id!r}", error=ShapeError)
        if self.lengths_m is not None:
            lengths = read_only(self.lengths_m, np.float64, (ends,), f"the lengths of match {self.id!r}")
            if not (np.isfinite(lengths).all() and (lengths > 0).all()):
                raise ShapeError(f"match {self.id!r} has a length that is not a positive number")
            object.__setattr__(self, "lengths_m", lengths)
        object.__setattr__(self, "scan", read_only(unit_rays(scan), np.float64, (ends, 3), "rays"))
        object.__setattr__(self, "photo", photo)


def picks_of_arrays(
    uv: ArrayLike,
    *,
    rays: ArrayLike | None = None,
    points: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    origin: str = "array",
) -> list[Pick]:
    """Return point picks of arrays, e.g. the matches of a matcher of one's own; their ids are '1', '2', ...

    Args:
        uv: (M, 2) photo pixels; (0, 0) is the centre of the top-left one.
        rays: (M, 3) directions in the scanner frame, of any length: the ranges are the scan's own.
        points: instead, (M, 3) measured points in the scanner frame, m: their lengths are used and compared with the
            scan's ranges.
        weights: (M,) relative weights, > 0; None: 1.
        origin: source of the matches.

    Raises:
        ShapeError: unless exactly one of rays and points is given, the arrays match and all numbers are finite.
    """
    directions = points if rays is None else rays
    if directions is None or (rays is not None and points is not None):
        raise ShapeError("the scan side of the matches needs either rays or points; give one of them")
    side = read_only(directions, np.float64, (None, 3), "the scan side of the matches")
    pixels = read_only(uv, np.float64, (len(side), 2), "the photo side of the matches")
    weight = _column(weights, 1.0, len(side), "the weights of the matches")
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(side, axis=1)
    return [
        Pick(
            str(k + 1), "point", side[k][None], pixels[k][None], weight=float(weight[k]), origin=origin,
            lengths_m=None if points is None else lengths[k : k + 1],
        )
        for k in range(len(side))
    ]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, init=False, repr=False)
class Matches:
    """M correspondences between the scan and the photo; read-only."""

    rays: FloatArray
    """(M, 3) unit, scanner frame."""
    ranges: FloatArray
    """(M,) m along the ray."""
    uv: FloatArray
    """(M, 2) photo pixels."""
    pick_ids: tuple[str, ...]
    """The pick that each match was made from."""
    fractions: FloatArray
    """(M,) position of each match along the line of its pick, 0 to 1; 0 for points."""
    weights: FloatArray
    """(M,) relative weights of the whole match."""
    range_weights: FloatArray
    """(M,) relative weights of the ranges alone, on top of `weights`: below 1 for weak returns, above for means of
    many."""
    directions: FloatArray
    """(M, 2) unit vector along the drawn line, photo pixels; 0 for points."""
    across: BoolArray
    """(M,) bool: only the position across the line is known, e.g. where the two ends were not drawn at corresponding
    points."""

    def __init__(
        self,
        rays: ArrayLike,
        ranges: ArrayLike,
        uv: ArrayLike,
        pick_ids: Sequence[str] = (),
        fractions: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        range_weights: ArrayLike | None = None,
        directions: ArrayLike | None = None,
        across: ArrayLike | None = None,
    ) -> None:
        """Check the arrays and fill in those left out.

        Args:
            rays: (M, 3) unit, scanner frame.
            ranges: (M,) m.
            uv: (M, 2) photo pixels.
            pick_ids: one per match; empty: '1', '2', ...
            fractions: (M,); None: 0, all are points.
            weights: (M,); None: 1.
            range_weights: (M,); None: 1.
            directions: (M, 2); None: 0, all are points.
            across: (M,) bool; None: False, both coordinates are known.

        Raises:
            ShapeError: if the arrays disagree.
        """
        checked_rays = read_only(rays, np.float64, (None, 3), "the matches' rays")
        count = len(checked_rays)
        ids = tuple(map(str, pick_ids)) or _numbered(count)
        if len(ids) != count:
            raise ShapeError(f"there are {len(ids)} pick ids for {count} matches; give one each, or none")
        columns = {
            "rays": checked_rays,
            "ranges": read_only(ranges, np.float64, (count,), "the matches' ranges"),
            "uv": read_only(uv, np.float64, (count, 2), "the matches' pixels"),
            "pick_ids": ids,
            "fractions": _column(fractions, 0.0, count, "the matches' fractions"),
            "weights": _column(weights, 1.0, count, "the matches' weights"),
            "range_weights": _column(range_weights, 1.0, count, "the matches' range weights"),
            "directions": read_only(
                np.zeros((count, 2)) if directions is None else directions, np.float64, (count, 2),
                "the lines' directions",
            ),
            "across": read_only(
                np.zeros(count, np.bool_) if across is None else across, np.bool_, (count,), "the matches' 'across'"
            ),
        }  # fmt: skip
        for name, value in columns.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        if not len(self):
            return "Matches(none)"
        lines = f", {int(self.across.sum())} known only across a line" if self.across.any() else ""
        return f"Matches({len(self)}: {self.ranges.min():.2f} to {self.ranges.max():.2f} m from the scanner{lines})"

    @staticmethod
    def none() -> Matches:
        """Return no matches."""
        return Matches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)))

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
        ids = tuple(map(self.pick_ids.__getitem__, index.tolist()))
        if not ids:
            return Matches.none()
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
        """Return the matches of all parts together, e.g. of drawn lines and detected corners."""
        if not parts:
            return Matches.none()
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
    def has_lines(self) -> bool:
        """True if some matches are of drawn lines."""
        return bool((self.directions != 0).any())

    @property
    def distinct_picks(self) -> bool:
        """True if every match is of a pick of its own, so that none is of a line."""
        return self.pick_ids is _numbered(len(self)) or len(set(self.pick_ids)) == len(self)

    def numbered_picks(self) -> tuple[tuple[str, ...], IntArray]:
        """Return the ids of the P picks, in the order of their first matches, and the index of each match's pick (M,).

        If all are distinct, the index is that of the match.
        """
        if self.distinct_picks:
            return self.pick_ids, np.arange(len(self))
        number: dict[str, int] = {}
        pick = np.array([number.setdefault(name, len(number)) for name in self.pick_ids], dtype=np.intp)
        return tuple(number), pick

    @property
    def dimensions(self) -> IntArray:
        """(M,) number of image coordinates known: 2, or 1 across a line."""
        return np.where(self.across, 1, 2)


@lru_cache(maxsize=8)
def _numbered(count: int) -> tuple[str, ...]:
    return tuple(map(str, range(1, count + 1)))


def _column(values: ArrayLike | None, filler: float, count: int, name: str) -> FloatArray:
    return read_only(np.full(count, filler) if values is None else values, np.float64, (count,), name)


def unit_rays(vectors: FloatArray) -> NDArray[np.float64]:
    """Return the unit vectors (..., 3) of finite vectors (..., 3) other than zero, of any length.

    Vectors are first scaled by a power of two, which is exact: squares of 1e308 overflow, those of 1e-308 vanish.
    """
    _, exponent = np.frexp(np.abs(vectors).max(axis=-1, keepdims=True))
    scaled = np.ldexp(vectors, -exponent)
    return np.asarray(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True))


def across_lines(matches: Matches, vectors: FloatArray, members: Any = slice(None)) -> FloatArray:
    """Return vectors (M, 2), photo pixels; where only `across` is known, without their component along the line.

    Args:
        matches: M matches.
        vectors: of the members.
        members: mask or indices of some of the matches; by default all.
    """
    across, directions = matches.across[members], matches.directions[members]
    if not across.any():
        return vectors
    along = (vectors * directions).sum(axis=1, keepdims=True) * directions
    return np.where(across[:, None], vectors - along, vectors)


def count_picks(matches: Matches, inliers: BoolArray) -> tuple[int, int]:
    """Return how many picks are inliers with all their parts, and how many there are.

    A line is one match to whoever counts, though solvers use its ends, or samples along it, one by one.
    """
    if matches.distinct_picks:
        return int(np.count_nonzero(inliers)), len(matches)
    agrees: dict[str, bool] = {}
    for name, inlier in zip(matches.pick_ids, inliers.tolist(), strict=True):
        agrees[name] = agrees.get(name, True) and inlier
    return sum(agrees.values()), len(agrees)
