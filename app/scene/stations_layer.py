"""The other stations, each a cloud of points in its own colour."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import viser
    from numpy.typing import NDArray

    from ladarreg_core.foundations.palette import Color
    from ladarreg_core.frames import Rigid

    from .place import Place

_SIZE_PER_RANGE = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class StationShown:
    """A station whose place is known."""

    id: str
    """Its id."""
    points: NDArray[np.float32]
    """(N, 3) m, frame of its scanner."""
    shown_from_station: Rigid
    """Its pose in the frame of the scan that is shown."""
    color: Color
    """Its colour."""


class StationsLayer:
    """A node for each station: its points are sent once, and it moves when its place changes."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._nodes: dict[str, tuple[NDArray[np.float32], Color, viser.PointCloudHandle]] = {}

    def draw(self, stations: Sequence[StationShown], *, hidden: Collection[str]) -> None:
        """Draw the stations, those that are hidden invisible."""
        for name in set(self._nodes) - {station.id for station in stations}:
            self._nodes.pop(name)[2].remove()
        for station in stations:
            known = self._nodes.get(station.id)
            if known is None or not np.array_equal(known[0], station.points) or known[1] != station.color:
                known = self._nodes[station.id] = station.points, station.color, self._node(station)
            node = known[2]
            with self._place.atomic():
                node.wxyz = station.shown_from_station.quaternion_wxyz
                node.position = station.shown_from_station.translation
                node.visible = station.id not in hidden

    def _node(self, station: StationShown) -> viser.PointCloudHandle:
        return self._place.scene.add_point_cloud(
            f"/stations/{station.id}",
            points=station.points,
            colors=np.repeat(np.array([station.color], np.uint8), len(station.points), axis=0),
            point_size=_SIZE_PER_RANGE * float(np.median(np.linalg.norm(station.points, axis=1))),
            point_shading="flat",
        )
