"""Ray casting: first hits and shadows on a triangle mesh (by Embree), and grids of rays with several samples a cell.

A grid is cast once through the cell centres, and again only where a neighbouring cell meets another face.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DependencyError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.simulate.worlds.world import World

NOTHING = -1
"""Triangle index of a ray that hits nothing."""

_STRIP_ROWS = 32  # a strip's arrays stay in the processor's cache; twice as fast as whole images


class RayCaster:
    """Finds the triangle that a ray hits first; only its index, since the hit point follows exactly from its plane.

    Args:
        triangles: (T, 3, 3), scanner frame, m.

    Raises:
        DependencyError: if `embreex` is not installed.
    """

    def __init__(self, triangles: FloatArray) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise DependencyError(
                "the simulator needs the package embreex, which is not installed: run pip install embreex"
            ) from None
        self._scene: Any = EmbreeScene()
        self._mesh: Any = TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))

    def first_hit(self, origin: ArrayLike, directions: FloatArray) -> NDArray[np.int32]:
        """Return the triangle (N,) that each ray (N, 3) from `origin`, (3,) or (N, 3), hits first."""
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        if not len(rays):
            return np.zeros(0, np.int32)
        starts = np.empty_like(rays)
        starts[:] = np.asarray(origin, dtype=np.float32)
        return np.asarray(self._scene.run(starts, rays, query="INTERSECT"), dtype=np.int32)

    def sees(self, points: FloatArray, target: ArrayLike) -> NDArray[np.bool_]:
        """Return which `points` (N, 3) have a free line of sight to `target` (3,)."""
        starts = np.ascontiguousarray(points, dtype=np.float32)
        if not len(starts):
            return np.zeros(0, np.bool_)
        towards = np.asarray(target, dtype=np.float32) - starts
        # The direction is not normalised, so the distance to the target is 1 in its units.
        reach = np.ones(len(starts), np.float32)
        return np.asarray(self._scene.run(starts, towards, reach, query="OCCLUDED") == NOTHING)


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """The face that each sample of each cell hits."""

    centre_faces: NDArray[np.int32]
    """(H, W): faces along the cell centres."""
    centre_rays: NDArray[np.float32]
    """(H, W, 3): unit rays of the cell centres."""
    mixed: BoolArray
    """(H, W): the 3 x 3 neighbourhood hits more than one face, so that every sample was cast."""
    _sample_faces: list[NDArray[np.int32]]
    _directions: list[NDArray[np.float32]]

    @staticmethod
    def cast(
        world: World,
        caster: RayCaster,
        origin: ArrayLike,
        shape: tuple[int, int],
        rays_at: Callable[[FloatArray, slice], FloatArray],
        steps: FloatArray,
    ) -> SampleGrid:
        """Cast the samples of a grid.

        Args:
            world: the world.
            caster: its ray caster.
            origin: (3,), origin of all rays, m.
            shape: (H, W), cells.
            rays_at: returns the unit rays (h, W, 3), scanner frame, of the cells of some rows, offset by a step (2,).
            steps: (S, 2), the samples within a cell, in cells.
        """

        def rays(step: FloatArray) -> NDArray[np.float32]:
            out = np.empty((*shape, 3), np.float32)

            def strip(part: slice) -> None:
                out[part] = rays_at(step, part)

            in_strips(shape[0], strip)
            return out

        def faces(directions: FloatArray) -> NDArray[np.int32]:
            triangle = caster.first_hit(origin, directions)
            return np.where(triangle < 0, 0, np.take(world.face_of_triangle, triangle)).astype(np.int32)

        centre = rays(np.zeros(2))
        centre_faces = faces(centre.reshape(-1, 3)).reshape(shape)
        mixed = differs_from_neighbours(centre_faces)
        where = np.flatnonzero(mixed)
        sample_faces, directions = [], []
        for step in steps:
            moved = rays(step) if step.any() else centre
            here = centre_faces
            if step.any():
                # Faces are convex: where all neighbours hit one, so does every ray between them.
                here = centre_faces.copy()
                here.reshape(-1)[where] = faces(moved.reshape(-1, 3)[where])
            sample_faces.append(here)
            directions.append(moved)
        return SampleGrid(centre_faces, centre, mixed, sample_faces, directions)

    def faces(self, sample: int, rows: slice) -> NDArray[np.int32]:
        """Return the faces (h, W) of one sample in some rows."""
        return self._sample_faces[sample][rows]

    def directions(self, sample: int, rows: slice) -> NDArray[np.float32]:
        """Return the unit rays (h, W, 3) of one sample in some rows."""
        return self._directions[sample][rows]


def differs_from_neighbours(values: NDArray[np.int32] | BoolArray) -> BoolArray:
    """Return the cells (H, W) whose 3 x 3 neighbourhood has more than one value."""
    across = np.zeros(values.shape, np.bool_)
    change = values[:, 1:] != values[:, :-1]
    across[:, 1:] |= change
    across[:, :-1] |= change
    down = np.zeros(values.shape, np.bool_)
    change = values[1:] != values[:-1]
    down[1:] |= change
    down[:-1] |= change
    # A diagonal neighbour differs from the cell, or from a common neighbour of both.
    out = across | down
    out[1:] |= across[:-1]
    out[:-1] |= across[1:]
    return out


def in_strips(
    rows: int, work: Callable[[slice], None], report: Callable[[float], None] | None = None, *, step: int = _STRIP_ROWS
) -> None:
    """Call `work` for strips of `step` rows on several threads; strips must be independent."""
    parts = [slice(top, min(top + step, rows)) for top in range(0, rows, step)]
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        for done, _ in enumerate(pool.map(work, parts), 1):
            if report:
                report(done / len(parts))
