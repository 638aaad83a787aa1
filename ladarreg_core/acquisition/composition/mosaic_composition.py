"""Mosaics: pieces of a scanner on a pan/tilt unit as one scan on a spherical grid, seen from where the axes cross."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.mosaic_piece import Float32, LoadedPiece, PlacedPiece, SeenSurface
from ladarreg_core.acquisition.composition.panorama_grid import Footprint, footprint_of, grid_around
from ladarreg_core.acquisition.composition.piece_fit import Overlaps, PieceFit
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import IntensityKind, Scan
from ladarreg_core.scanner.grids import SphericalGrid

NO_PIECE = -1
"""Piece of a cell without a return."""
_TILE = (256, 512)
_CACHE_BYTES = 500_000_000
_THREADS = 2
_APART_M, _APART_SHARE = 0.03, 0.01
_MAX_PIECES = 30_000


@dataclass(frozen=True, slots=True)
class PieceCounts:
    """How many returns of one piece were kept, and why others were not."""

    returns: int
    """Its returns."""
    shown: int
    """Cells of the panorama that it fills."""
    outdone: int
    """Cells where another piece shows the surface better."""
    folded: int
    """Returns that a nearer surface hides from where the axes cross."""


@dataclass(frozen=True, slots=True, eq=False)
class MosaicComposition:
    """A scan made of pieces, and the counts of each."""

    scan: Scan
    """In the unit's world: origin where the axes cross, X ahead at pan 0, Z along the pan axis."""
    piece_of_cell: NDArray[np.int16]
    """(H, W) the piece that each return is from; -1 = no return."""
    pieces: tuple[PieceCounts, ...]
    """One for each piece."""
    overlapping: int
    """Cells that more than one piece shows."""
    disagreeing: int
    """Of these, cells where two pieces show surfaces that are clearly apart: something moved, or a depth edge."""
    fit: PieceFit
    """Whether the pieces fit each other, and which was the first that does not."""

    @property
    def folded(self) -> int:
        """Returns dropped because a nearer surface hides them from where the axes cross."""
        return sum(piece.folded for piece in self.pieces)


def compose_mosaic(
    pieces: Sequence[PlacedPiece],
    *,
    grid: SphericalGrid | None = None,
    name: str = "panorama",
    report: Report | None = None,
) -> MosaicComposition:
    """Return the pieces of a mosaic as one scan on a spherical grid.

    Each cell shows one piece: the one that most others agree with and, of these, the one that sees the surface least
    obliquely and farthest from its own border. Ranges and intensities of different pieces are never mixed. Within a
    piece the range at a cell's direction is interpolated on its surface, not across edges. A scanner whose centre is
    not where the axes cross is re-expressed from there; what a nearer surface then hides is dropped. A cell that no
    piece fills keeps its direction. The memory needed is that of the result and of a bounded cache of pieces.

    Args:
        pieces: the pieces, with their poses.
        grid: directions of the result; None: as fine as the finest piece, around all of them.
        name: display name of the scan.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        ShapeError: if there is no piece, none has a return, or the result would have too many cells.
        OptionError: if the intensities of the pieces are of different kinds.
    """
    if not pieces:
        raise ShapeError("there is no piece to compose; a mosaic needs at least one")
    if len(pieces) > _MAX_PIECES:
        raise ShapeError(f"there are {len(pieces):,} pieces; at most {_MAX_PIECES:,} can be composed")
    total = 2 * len(pieces)
    footprints = []
    for number, piece in enumerate(pieces):
        _say(report, number, total, f"reading piece {number + 1} of {len(pieces)}")
        footprints.append(footprint_of(piece.load(), piece.world_from_scanner))
    kinds = {footprint.intensity_is for footprint in footprints}
    if len(kinds) > 1:
        raise OptionError(
            "the intensities of some pieces are raw and those of others range_normalised; a mosaic needs one kind"
        )
    law = grid or grid_around(footprints)
    result = _Result(law, len(pieces), in_color=all(footprint.in_color for footprint in footprints))
    cache = _Cache(pieces, law)
    tiles = list(_tiles(law.shape))
    with ThreadPoolExecutor(_THREADS) as pool:
        try:
            for done, _ in enumerate(pool.map(lambda tile: _fill(tile, law, footprints, cache, result), tiles)):
                _say(report, len(tiles) + done, 2 * len(tiles), "composing the panorama")
        finally:
            pool.shutdown(cancel_futures=True)
    return result.composition(kinds.pop(), cache, name)


def _say(report: Report | None, done: int, total: int, label: str) -> None:
    if report is not None:
        report(Progress(done, total, label))


class _Result:
    """The arrays of the panorama; each tile is written by one thread."""

    def __init__(self, law: SphericalGrid, pieces: int, *, in_color: bool) -> None:
        self.law = law
        self.ranges = np.full(law.shape, np.nan, np.float32)
        self.intensity = np.zeros(law.shape, np.float32)
        self.color = np.zeros((*law.shape, 3), np.uint8) if in_color else None
        self.who = np.full(law.shape, NO_PIECE, np.int16)
        self.outdone = np.zeros(pieces, np.int64)
        self.overlapping = self.disagreeing = 0
        self._overlaps = Overlaps()
        self._lock = threading.Lock()

    def count(self, outdone: NDArray[np.int64], shown: _Shown, numbers: NDArray[np.int16]) -> None:
        with self._lock:
            self.outdone += outdone
            self.overlapping += shown.overlapping
            self.disagreeing += shown.disagreeing
            self._overlaps.add(
                (int(numbers[first]), int(numbers[second]), shared, apart)
                for first, second, shared, apart in shown.pairs
            )

    def composition(self, intensity_is: IntensityKind, cache: _Cache, name: str) -> MosaicComposition:
        shown = np.bincount(self.who.ravel() + 1, minlength=len(self.outdone) + 1)[1:]
        counts = tuple(
            PieceCounts(*cache.facts.get(number, (0, 0))[:1], int(shown[number]), int(self.outdone[number]),
                        cache.facts.get(number, (0, 0))[1])
            for number in range(len(self.outdone))
        )  # fmt: skip
        for array in (self.ranges, self.intensity, self.color):
            if array is not None:
                array.flags.writeable = False
        scan = Scan(self.law, self.ranges, self.intensity, color=self.color, intensity_is=intensity_is, name=name)
        return MosaicComposition(
            scan, self.who, counts, self.overlapping, self.disagreeing, self._overlaps.fit(len(counts))
        )


class _Cache:
    """The pieces used last, as many as fit into the memory allowed."""

    def __init__(self, pieces: Sequence[PlacedPiece], law: SphericalGrid) -> None:
        self._pieces, self._law = pieces, law
        self._kept: OrderedDict[int, LoadedPiece] = OrderedDict()
        self._lock = threading.Lock()
        self.facts: dict[int, tuple[int, int]] = {}

    def get(self, number: int) -> LoadedPiece:
        with self._lock:
            loaded = self._kept.pop(number, None)
            if loaded is None:
                piece = self._pieces[number]
                loaded = LoadedPiece(piece.load(), piece.world_from_scanner, self._law)
                self.facts[number] = loaded.valid_cells, loaded.folded
            self._kept[number] = loaded
            while len(self._kept) > 1 and sum(one.bytes for one in self._kept.values()) > _CACHE_BYTES:
                self._kept.popitem(last=False)
            return loaded


def _tiles(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Yield the tiles column by column, so that the same pieces serve one after another."""
    for left in range(0, shape[1], _TILE[1]):
        for top in range(0, shape[0], _TILE[0]):
            yield slice(top, min(top + _TILE[0], shape[0])), slice(left, min(left + _TILE[1], shape[1]))


def _fill(
    tile: tuple[slice, slice], law: SphericalGrid, footprints: Sequence[Footprint], cache: _Cache, result: _Result
) -> None:
    rows, columns = tile
    cells = np.moveaxis(np.mgrid[rows, columns], 0, -1).reshape(-1, 2)
    rays = law.ray_at(cells).astype(np.float32)
    at = cells.astype(np.float32)
    seen = [
        (number, cache.get(number).seen(rays, at))
        for number, footprint in enumerate(footprints)
        if footprint.may_show(rays)
    ]
    if not seen:
        return
    shape = rows.stop - rows.start, columns.stop - columns.start
    best, shown = _best(seen, shape)
    there = best >= 0
    numbers = np.array([number for number, _ in seen], np.int16)
    result.who[tile] = np.where(there, numbers[best], NO_PIECE).reshape(shape)
    result.ranges[tile] = _taken([surface.ranges for _, surface in seen], best, np.nan).reshape(shape)
    result.intensity[tile] = _taken([surface.intensity for _, surface in seen], best, 0).reshape(shape)
    if result.color is not None:
        for channel in range(3):
            planes = [surface.color[:, channel] for _, surface in seen if surface.color is not None]
            result.color[(*tile, channel)] = _taken(planes, best, 0).reshape(shape)
    outdone = np.zeros(len(footprints), np.int64)
    for place, (number, _) in enumerate(seen):
        outdone[number] = int((shown.visible[place] & (best != place)).sum())
    result.count(outdone, shown, numbers)


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    visible: NDArray[np.bool_]
    overlapping: int
    disagreeing: int
    pairs: list[tuple[int, int, int, int]]
    """Places in `seen` of two pieces, cells that both show, and cells in which they are apart."""


def _best(seen: Sequence[tuple[int, SeenSurface]], shape: tuple[int, int]) -> tuple[NDArray[np.intp], _Shown]:
    """Return the place in `seen` of the best surface (N,), -1 where there is none, for the N cells of a tile."""
    ranges = np.stack([surface.ranges for _, surface in seen])
    visible = np.isfinite(ranges)
    score = np.where(visible, np.stack([surface.score for _, surface in seen]), -1)
    several = visible.sum(axis=0) > 1
    apart = np.zeros(ranges.shape[1], bool)
    pairs = []
    if several.any():
        some = ranges[:, several]
        with np.errstate(invalid="ignore"):
            agrees = np.abs(some[:, None] - some[None]) <= _APART_M + _APART_SHARE * some[None]
        support = agrees.sum(axis=1)
        apart[several] = (support < visible[:, several].sum(axis=0)).any(axis=0, where=visible[:, several])
        score[:, several] += np.where(visible[:, several], support, 0)
        pairs = list(_compared(ranges, shape))
    best = np.where(visible.any(axis=0), score.argmax(axis=0), -1)
    return best, _Shown(visible, int(several.sum()), int(apart.sum()), pairs)


def _compared(ranges: Float32, shape: tuple[int, int]) -> Iterator[tuple[int, int, int, int]]:
    """Yield for each pair of surfaces (K, N) the cells that both show, and those where they are clearly apart.

    They are apart where no range of one in the cells around is near to any of the other: an edge that two pieces show a
    cell apart says nothing about where they are.
    """
    around = np.ones((3, 3), np.uint8)
    planes = ranges.reshape(-1, *shape)
    there = np.isfinite(planes)
    low = np.stack([cv2.erode(plane, around) for plane in np.where(there, planes, np.float32(np.inf))])
    high = np.stack([cv2.dilate(plane, around) for plane in np.where(there, planes, np.float32(-np.inf))])
    for first, second in combinations(range(len(planes)), 2):
        both = there[first] & there[second]
        if (shared := int(both.sum())) == 0:
            continue
        gap = np.maximum(low[first][both] - high[second][both], low[second][both] - high[first][both])
        apart = int((gap > _APART_M + _APART_SHARE * low[first][both]).sum())
        yield first, second, shared, apart


def _taken(planes: Sequence[Float32 | NDArray[np.uint8]], best: NDArray[np.intp], none: float) -> NDArray[np.generic]:
    """Return the value (N,) of the plane that was chosen at each place."""
    out = np.full(len(best), none, planes[0].dtype)
    for place, plane in enumerate(planes):
        mine = best == place
        out[mine] = plane[mine]
    return out
