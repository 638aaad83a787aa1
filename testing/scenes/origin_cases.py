"""Drawn clouds whose scanner's place is known: scanners, rooms and streets, offsets of the coordinates, turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.origin import OriginEstimate
from testing.scenes.simulated_clouds import dome, in_room, in_street, of_elevations, rosette, spinning

OFFSETS = (
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 1.8),
    (14.0, 5.0, 1.0),
    (60.0, -80.0, 3.0),
    (2_500.0, -1_200.0, 40.0),
    (691_234.567, 5_334_321.125, 519.25),
)
UNEVEN_DEG = np.r_[np.linspace(-25, -6, 10, endpoint=False), np.linspace(-6, 2, 48, endpoint=False),
                   np.linspace(2, 15, 6)]  # fmt: skip
"""Elevations of 64 rings that are .17 degrees apart in the middle, as of a Pandar64."""
_RAYS = {
    "terrestrial": lambda: dome(1.0),
    "16 rings": lambda: spinning(16, 900),
    "32 rings": lambda: spinning(32, 900),
    "64 rings": lambda: spinning(64, 900),
    "64 uneven rings": lambda: of_elevations(UNEVEN_DEG, 900),
    "rosette": lambda: rosette(100_000),
}
_SCATTERED = ("300 points", "60 points", "airborne")
KINDS = (*_RAYS, *_SCATTERED)
_TOLERANCE, _TOLERANCE_BY_DENSITY, _MIN_TOLERANCE_M = 0.01, 0.1, 0.1
"""Of the size of the cloud where its directions form lines, and where only its densities show the place."""


@dataclass(frozen=True, eq=False)
class OriginCase:
    """A cloud and where its scanner stood."""

    name: str
    kind: str
    """One of `KINDS`."""
    points: NDArray[np.float64]
    """(N, 3), m."""
    origin: NDArray[np.float64] | None
    """(3,), m; None: the points were not measured from one place."""

    def verdict(self, found: OriginEstimate) -> str:
        """Return `right`, `asked` or `wrong`; docs/scans.md states how exact a right place is."""
        if found.position is None:
            return "asked"
        size = float(np.percentile(np.linalg.norm(self.points - np.median(self.points, axis=0), axis=1), 90))
        tolerance = _TOLERANCE_BY_DENSITY if self.kind == "rosette" else _TOLERANCE
        return "right" if self.error_m(found) < max(_MIN_TOLERANCE_M, tolerance * size) else "wrong"

    def error_m(self, found: OriginEstimate) -> float:
        """Return how far a place that was found is from the scanner's, m; infinite if there is none."""
        if self.origin is None or found.position is None:
            return np.inf
        return float(np.linalg.norm(np.array(found.position) - self.origin))


def draw_origin_case(seed: int) -> OriginCase:
    """Return a case; equal seeds give equal cases."""
    generator = np.random.default_rng([31, seed])
    kind = KINDS[seed % len(KINDS)]
    offset = np.array(OFFSETS[int(generator.integers(len(OFFSETS)))])
    turn = Rigid.from_rotvec([0, 0, generator.uniform(-np.pi, np.pi)], (0, 0, 0))
    name = f"{seed}: {kind}, moved by {offset[0]:g}, {offset[1]:g}, {offset[2]:g}"
    if kind == "airborne":
        level = generator.uniform(0, 300, (15_000, 2))
        height = 5 * np.sin(level[:, 0] / 40) + 3 * np.cos(level[:, 1] / 25)
        return OriginCase(name, kind, np.column_stack([level, height]) + offset, None)
    rays = _RAYS[kind if kind in _RAYS else "32 rings"]()
    if generator.random() < 0.5:
        place = np.array([*generator.uniform(-1.5, 1.5, 2), generator.uniform(1.2, 1.9)])
        points = in_room(rays, place, seed=seed) - place
    else:
        place = np.array([*generator.uniform([-6, -3], [2, 3]), generator.uniform(1.5, 2.2)])
        points = in_street(rays, place, seed=seed) - place
    if kind in _SCATTERED:
        points = points[generator.permutation(len(points))[: int(kind.split()[0])]]
    return OriginCase(name, kind, np.asarray(turn @ points) + offset, offset)
