"""`find_targets`: survey targets of a known size, looked for in a whole scan.

Around a cell in the middle of a target, the ranges on a ring rise as on a sphere of that radius, or they are flat and
the intensities on the ring go up and down twice, as on four quadrants. Cells around which that is so are tried as
picks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.foundations.validation import require_positive, require_type
from ladarreg_core.registration.stations.flat_targets import fit_flat_target
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.targets import fit_target
from ladarreg_core.scan import Scan

Array = NDArray[np.float64]

_MIN_CELLS = 2.3  # half the width of a target: with less, fewer than the 12 cells of a fit are on its face
_COARSE_CELLS = 6.0  # up to twice which every cell is tried, then every second, and so on
_RING_OF_RADIUS, _RIM_OF_RADIUS, _RING_OF_SIDE = 0.5, 0.8, 0.28  # radii of the rings that are compared
_AROUND = 16
_RISE, _MEAN_RISE = (0.25, 2.0), (0.7, 1.4)  # of opposite places of the ring, and of all, over that on the sphere
_RIM_RISE = (0.6, 1.5)  # the lower quartile of those near the rim, where some places are already beside it
_RIM_CELLS = 8.0  # half the width below which the rim is not told from what is beside it
_MAX_TILT = 1.4  # difference of opposite places over the rise: more is beside the middle
_FLAT_OF_SIDE = 0.03  # mean of the ring less the middle, of the side: more is bent
_OTHER_RINGS_OF_SIDE = 0.16, 0.38  # where a corner of a print seldom goes on as the quadrants of a plate do
_MIN_EXPLAINED = 0.9  # of the intensities of a plate that is found; prints among those tried explain .82 to .98
_MIN_SECOND, _MIN_CONTRAST = 0.6, 0.25  # share of the second harmonic; standard deviation over the mean
_MAX_FITS = 400  # at up to .05 s each
_BLOCK_CELLS = 1 << 19


@dataclass(frozen=True, slots=True)
class _Candidate:
    cell: tuple[int, int]
    score: float


def find_targets(scan: Scan, *, radius_m: float | None = None, side_m: float | None = None) -> list[SurveyTarget]:
    """Find all spheres of a radius, or all flat targets of four quadrants of a side, in a scan.

    What looks like a target is among them, such as a lamp of that radius: `name_targets` tells them apart.

    Args:
        scan: the scan; with intensities for flat targets.
        radius_m: radius of the spheres, m.
        side_m: side of the four quadrants together, m.

    Returns:
        the targets, as by `fit_target`, the best seen first.

    Raises:
        OptionError: if an argument is of a wrong type, or not one of `radius_m` and `side_m` is given.
    """
    require_type(scan, Scan, "the scan")
    if (radius_m is None) == (side_m is None):
        raise OptionError("targets are spheres or flat; give either their radius or their side", field="radius_m")
    size = require_positive(
        radius_m if side_m is None else side_m, "radius_m" if side_m is None else "side_m", most=5.0
    )
    reach = size if side_m is None else size / 2
    candidates = [one for found in _candidates(scan, reach, is_sphere=side_m is None) for one in found]
    found: list[SurveyTarget] = []
    for one in _apart(scan, candidates, reach)[:_MAX_FITS]:
        point = scan.rays[one.cell] * scan.ranges[one.cell]
        if any(np.linalg.norm(point - other.center) < 1.5 * reach for other in found):
            continue
        try:
            part, pick = _around(scan, one.cell, reach)
            if side_m is not None:
                target = fit_flat_target(part, pick, side_m=side_m, least_explained=_MIN_EXPLAINED)
            else:
                target = fit_target(part, pick, radius_m=radius_m)
        except DegenerateGeometryError:
            continue
        if all(np.linalg.norm(target.center - other.center) > reach for other in found):
            found.append(target)
    return sorted(found, key=lambda one: -one.cells)


def _candidates(scan: Scan, reach: float, *, is_sphere: bool) -> Iterator[list[_Candidate]]:
    """Yield cells that may be in the middle of a target, where it is up to twice as many cells wide at a time."""
    rows, columns = scan.shape
    middle = columns // 2
    down = _between(scan.rays[:-1, middle], scan.rays[1:, middle])
    down = np.append(down, down[-1:]) if len(down) else np.full(rows, scan.geometry.step_rad[0])
    across = _between(scan.rays[:, middle - 1], scan.rays[:, middle]) if columns > 1 else down
    with np.errstate(invalid="ignore"):
        half = np.arcsin(np.minimum(reach / (scan.ranges + (reach if is_sphere else 0)), 1)).astype(np.float32)
    width = half / np.maximum(down, across).astype(np.float32)[:, None]
    level, least, most = 0, _MIN_CELLS, 2 * _COARSE_CELLS
    while np.nanmax(width, initial=0.0) >= least:
        stride = 2**level
        lattice = np.zeros(scan.shape, np.bool_)
        lattice[stride // 2 :: stride, stride // 2 :: stride] = True
        row, column = np.nonzero(lattice & (width >= least) & (width < most))
        ranges, light = _averaged(scan, level)
        for begin in range(0, len(row), _BLOCK_CELLS):
            part = slice(begin, begin + _BLOCK_CELLS)
            at = row[part], column[part]
            ring = _Ring(scan, ranges, at, half[at], down[at[0]], across[at[0]])
            score = ring.as_sphere(reach) if is_sphere else ring.as_quadrants(light, reach * 2)
            yield [_Candidate((int(at[0][k]), int(at[1][k])), float(score[k])) for k in np.flatnonzero(score > 0)]
        level, least, most = level + 1, most, 2 * most


def _between(first: NDArray[np.floating], second: NDArray[np.floating]) -> Array:
    """Return the angles between unit vectors (N, 3), rad."""
    return np.asarray(np.linalg.norm(np.asarray(first, np.float64) - second, axis=-1)).clip(1e-9)


def _averaged(scan: Scan, level: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return ranges and intensities, averaged over as many cells as a level is coarse; NaN where many are missing."""
    valid = scan.valid.astype(np.float32)
    side = 1 if level == 0 else 2**level + 1
    share = cv2.blur(valid, (side, side), borderType=cv2.BORDER_REFLECT)
    averaged = []
    for values in (scan.ranges, scan.intensity):
        known = np.where(scan.valid & np.isfinite(values), values, 0).astype(np.float32)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = cv2.blur(known, (side, side), borderType=cv2.BORDER_REFLECT) / share
        averaged.append(np.where(share > 0.5, mean, np.float32(np.nan)))
    return averaged[0], averaged[1]


class _Ring:
    """The surroundings of n cells: `_AROUND` places on a circle about each.

    Args:
        scan: the scan.
        ranges: its ranges, averaged.
        at: rows and columns (n,) of the cells.
        half: half of the angle under which a target appears there, rad.
        down: angle between the rows there, rad.
        across: angle between the columns there, rad.
    """

    def __init__(
        self, scan: Scan, ranges: NDArray[np.float32], at: tuple[NDArray[np.intp], NDArray[np.intp]],
        half: NDArray[np.float32], down: Array, across: Array,
    ) -> None:  # fmt: skip
        self._scan, self._ranges, self._at = scan, ranges, at
        self._half, self._down, self._across = half, down, across
        self._front = ranges[at].astype(np.float64)
        self._turns = abs(scan.shape[1] * scan.geometry.step_rad[1] - 2 * np.pi) < 2 * scan.geometry.step_rad[1]

    def _cells(self, share: float) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]]:
        """Yield rows and columns (n,) of each place of the ring, and whether they are in the scan."""
        rows, columns = self._scan.shape
        for angle in np.arange(_AROUND) * (2 * np.pi / _AROUND):
            row = self._at[0] + np.rint(share * self._half * np.sin(angle) / self._down).astype(np.intp)
            column = self._at[1] + np.rint(share * self._half * np.cos(angle) / self._across).astype(np.intp)
            if self._turns:
                column %= columns
            inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            yield np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1), inside

    def as_sphere(self, radius: float) -> Array:
        """Return how well the ranges rise as on a sphere, (n,), 1 at best; 0 where they do not."""
        both, tilt = self._rises(radius, _RING_OF_RADIUS)
        with np.errstate(invalid="ignore"):
            mean = both.mean(axis=0)
            fits = (both > _RISE[0]).all(axis=0) & (both < _RISE[1]).all(axis=0)
            fits &= (mean > _MEAN_RISE[0]) & (mean < _MEAN_RISE[1]) & (tilt < _MAX_TILT).all(axis=0)
            score = np.where(fits, 1 / (1 + tilt.max(axis=0) + both.std(axis=0) + np.abs(mean - 1)), 0.0)
        fine = self._half > _RIM_CELLS * np.maximum(self._down, self._across)
        left = np.flatnonzero((score > 0) & fine)
        near_rim = np.quantile(self._of_cells(left)._rises(radius, _RIM_OF_RADIUS)[0], 0.25, axis=0)
        score[left] *= (near_rim > _RIM_RISE[0]) & (near_rim < _RIM_RISE[1])
        return score

    def _of_cells(self, chosen: NDArray[np.intp]) -> _Ring:
        at = self._at[0][chosen], self._at[1][chosen]
        return _Ring(self._scan, self._ranges, at, self._half[chosen], self._down[chosen], self._across[chosen])

    def _rises(self, radius: float, share: float) -> tuple[Array, Array]:
        """Return how much opposite places rise above the middle, and one above the other, over what a sphere does."""
        distance, own = self._front + radius, self._scan.rays[self._at].astype(np.float64)
        rise, expected = np.empty((_AROUND, len(own))), np.empty((_AROUND, len(own)))
        for k, (row, column, inside) in enumerate(self._cells(share)):
            cos = np.einsum("ni,ni->n", own, self._scan.rays[row, column].astype(np.float64))
            root = np.sqrt(np.maximum(radius**2 - distance**2 * (1 - cos**2), 0))
            expected[k] = distance * cos - root - self._front
            rise[k] = np.where(inside, self._ranges[row, column] - self._front, np.nan)
        pair, opposite = slice(_AROUND // 2), slice(_AROUND // 2, None)
        with np.errstate(invalid="ignore", divide="ignore"):
            both = (rise[pair] + rise[opposite]) / (expected[pair] + expected[opposite])
            tilt = np.abs(rise[pair] - rise[opposite]) / (expected[pair] + expected[opposite])
        return both, tilt

    def as_quadrants(self, light: NDArray[np.float32], side: float) -> Array:
        """Return how well flat cells go from bright to dark twice around, (n,), 1 at best; 0 where they do not."""
        rise = np.empty((_AROUND, len(self._front)))
        for k, (row, column, _) in enumerate(self._cells(2 * _RING_OF_SIDE)):
            rise[k] = self._ranges[row, column] - self._front
        second, contrast = self._second(light, _RING_OF_SIDE)
        with np.errstate(invalid="ignore", divide="ignore"):
            fits = np.abs(rise.mean(axis=0)) < _FLAT_OF_SIDE * side
            fits &= (np.abs(second) ** 2 > _MIN_SECOND) & (contrast > _MIN_CONTRAST)
        score = np.zeros(len(fits))
        left = np.flatnonzero(fits)
        some = self._of_cells(left)
        rings = [second[left], *(some._second(light, share)[0] for share in _OTHER_RINGS_OF_SIDE)]
        # Edges that are straight through all rings have one phase; nothing is refused by the other two.
        score[left] = np.abs(np.nan_to_num(np.array(rings)).mean(axis=0)) + 1e-6
        return score

    def _second(self, light: NDArray[np.float32], share_of_side: float) -> tuple[NDArray[np.complex128], Array]:
        """Return the second harmonic of the light on a ring, (n,), of length 1 if there is no other, and its contrast.

        The contrast is the standard deviation over the mean.
        """
        seen = np.empty((_AROUND, len(self._front)))
        for k, (row, column, inside) in enumerate(self._cells(2 * share_of_side)):
            seen[k] = np.where(inside, light[row, column], np.nan)
        wave = np.exp(2j * np.arange(_AROUND) * (2 * np.pi / _AROUND))
        with np.errstate(invalid="ignore", divide="ignore"):
            deviation = seen - seen.mean(axis=0)
            energy = (deviation**2).sum(axis=0)
            second = np.sqrt(2 / _AROUND) * (wave @ deviation) / np.sqrt(energy)
            return second, np.sqrt(energy / _AROUND) / np.abs(seen.mean(axis=0))


def _apart(scan: Scan, candidates: list[_Candidate], reach: float) -> list[_Candidate]:
    """Return the best of the candidates that are within a target of each other, the best first."""
    best: dict[tuple[int, ...], _Candidate] = {}
    for one in candidates:
        point = scan.rays[one.cell].astype(np.float64) * float(scan.ranges[one.cell])
        voxel = tuple(np.floor(point / reach).astype(int).tolist())
        if voxel not in best or one.score > best[voxel].score:
            best[voxel] = one
    return sorted(best.values(), key=lambda one: -one.score)


def _around(scan: Scan, cell: tuple[int, int], reach: float) -> tuple[Scan, tuple[int, int]]:
    """Return the part of a scan around a cell that a target there lies in, and the cell in it."""
    row, column = cell
    at = float(scan.ranges[cell])
    half = np.arcsin(min(1.0, 3 * reach / max(at, 3 * reach)))
    ray = scan.rays[cell]
    rows = np.flatnonzero(scan.rays[:, column] @ ray >= np.cos(half))
    first, last = int(rows[0]), int(rows[-1])
    near = (scan.rays[[first, row, last]] @ ray >= np.cos(half)).any(axis=0)
    columns = np.flatnonzero(near)
    begin, end = int(columns[0]), int(columns[-1])
    if begin == 0 or end == scan.shape[1] - 1 or last - first + 1 != len(rows):
        return scan, cell  # across the seam of a full turn, or at a pole
    return scan.window(slice(first, last + 1), slice(begin, end + 1)), (row - first, column - begin)
