"""First hits and shadows on a triangle mesh, by Embree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.errors import DependencyError

NOTHING = -1
"""The triangle index of a ray that meets nothing."""


class RayCaster:
    """Answers which triangle a ray meets first; only the index, since planes tell the rest exactly.

    Args:
        triangles: (T, 3, 3), scanner frame, m.

    Raises:
        DependencyError: if the optional package `embreex` is not installed.
    """

    def __init__(self, triangles: FloatArray) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise DependencyError(
                'the simulator needs the package embreex, which is not installed: run pip install "ladarreg[simulate]"'
            ) from None
        self._scene: Any = EmbreeScene()
        self._mesh: Any = TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))

    def first_hit(self, origin: ArrayLike, directions: FloatArray) -> NDArray[np.int32]:
        """Return the triangle (N,) that each ray from one `origin` (3,) along `directions` (N, 3) meets first."""
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        if not len(rays):
            return np.zeros(0, np.int32)
        starts = np.empty_like(rays)
        starts[:] = np.asarray(origin, dtype=np.float32)
        return np.asarray(self._scene.run(starts, rays, query="INTERSECT"), dtype=np.int32)

    def sees(self, points: FloatArray, target: ArrayLike) -> NDArray[np.bool_]:
        """Return which `points` (N, 3) have nothing between them and `target` (3,)."""
        starts = np.ascontiguousarray(points, dtype=np.float32)
        if not len(starts):
            return np.zeros(0, np.bool_)
        towards = np.asarray(target, dtype=np.float32) - starts
        # The direction spans the whole way, so the distance to the target is 1 in its units.
        reach = np.ones(len(starts), np.float32)
        return np.asarray(self._scene.run(starts, towards, reach, query="OCCLUDED") == NOTHING)
