"""The points of a run that is going on, for all clients: what is drawn stays, so that each point is sent about once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import viser
    from numpy.typing import NDArray

    from ladarreg_core.foundations.arrays import ByteArray

    from .place import Place

_NODE_POINTS = 10_000
_SIZE_PER_RANGE = 0.006


class RunLayer:
    """Nodes of so many points each; only the last one, which is being filled, is sent again."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._nodes: list[viser.PointCloudHandle] = []
        self._points, self._gray = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)

    def add(self, points: NDArray[np.float32], gray: ByteArray) -> None:
        """Draw points (N, 3), m, with their gray levels (N,), besides those that are there."""
        self._points, self._gray = np.concatenate([self._points, points]), np.concatenate([self._gray, gray])
        is_new = len(self._points) == len(points)
        if not is_new:
            self._nodes.pop()  # replaced by the node of the same name
        self._nodes.append(
            self._place.scene.add_point_cloud(
                f"/run/{len(self._nodes)}",
                points=self._points,
                colors=np.repeat(self._gray[:, None], 3, axis=1),
                point_size=_SIZE_PER_RANGE * float(np.median(np.linalg.norm(self._points, axis=1))),
                point_shading="flat",
            )
        )
        if len(self._points) >= _NODE_POINTS:
            self._points, self._gray = self._points[:0], self._gray[:0]

    def clear(self) -> None:
        """Remove everything."""
        for node in self._nodes:
            node.remove()
        self._nodes = []
        self._points, self._gray = self._points[:0], self._gray[:0]
