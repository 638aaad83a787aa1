"""Queries of a page: computations on the present document that change nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import require_photo
from ladarreg_core.project.station_edits import known_place, partner_of

from ...session.loader import Loader
from ...session.session import Session
from .pose_state import pick_errors, sampled_line
from .slices import scan_slice

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.inspection.picks import PickPredictor
    from ladarreg_core.project.document import CameraGiven, PhotoEntry
    from ladarreg_core.scan import Scan

    from ...slices.photographs import JudgedPick, SampledLine
    from ...slices.project import LostScan, ReadScan


class Queries:
    """Answers queries of a page.

    Args:
        session: the session.
        loader: its loader.
    """

    def __init__(self, session: Session, loader: Loader) -> None:
        self._session = session
        self._loader = loader

    def pick_errors(self, photo_id: str) -> dict[str, JudgedPick]:
        """Return the errors of a photograph's picks under the shown pose, by pick, as in the slice `judged`."""
        entry = require_photo(self._session.document, photo_id)
        return pick_errors(self._loader, self._scan(entry), self._loader.photo(entry), entry)[0]

    def partners(self, entry: PhotoEntry) -> PickPredictor:
        """Return the prediction of picks from one image to the other under the shown pose.

        Raises:
            OptionError: if there is no pose.
        """
        scan = self._loader.scan(self._session.document.beside(entry))
        if scan is None or entry.pose is None:
            raise OptionError("there is no pose yet to predict with; solve first")
        return self._loader.partners(scan, entry.pose)

    def snapped(
        self,
        side: object,
        view: int,
        photo: object,
        ends: Sequence[Sequence[float]],
        *,
        shown: PhotoEntry | None,
        px_per_screen: float,
    ) -> list[list[float]] | None:
        """Return the pixels that a point (one end) or a line (two) snaps to; None if it stays where it is.

        Args:
            side: `scan` or `photo`.
            view: number of the view of the scan.
            photo: id of the photograph, on its side.
            ends: pixels.
            shown: the photograph beside the scan; None: there is none.
            px_per_screen: pixels of the picture in one of the screen.
        """
        from ladarreg_core.inspection.snapping import PhotoSnapper, ViewSnapper

        snapper: ViewSnapper | PhotoSnapper
        if side == "scan":
            document = self._session.document.beside(shown)
            if not 0 <= view < len(self._loader.views(document)):
                return None
            key = ("snapper", document.scan, view)
            snapper = self._loader.cached("view", key, lambda: ViewSnapper.of(self._loader.view(document, view)))
        else:
            viewed = self._loader.viewable_photo(require_photo(self._session.document, photo))
            snapper = self._loader.cached("picture", ("snapper", id(viewed)), lambda: PhotoSnapper.of(viewed))
        if len(ends) == 1:
            corner = snapper.point(ends[0], px_per_screen=px_per_screen)
            return None if corner is None else [corner.tolist()]
        if len(ends) != 2:
            raise OptionError("give one end of a point or two of a line")
        line = snapper.line(ends, px_per_screen=px_per_screen)
        return None if line is None else line.tolist()

    def sample_line(self, ends: Any, shown: PhotoEntry | None) -> SampledLine:
        """Return the sample points of a line on the scan beside a photograph, given by the rays of its ends."""
        scan = self._loader.scan(self._session.document.beside(shown))
        if scan is None or len(ends) != 2:
            raise OptionError("a line on a scan has two ends")
        return sampled_line(self._loader, scan, ends)

    def scan_of(self, station: str) -> ReadScan | LostScan | None:
        """Return the scan of a station as the slice `scan` has it; None: the project has none.

        Raises:
            OptionError: if there is no such station.
        """
        document = self._session.document
        seen = msgspec.structs.replace(document, scan=partner_of(document, station))
        return self._loader.cached("picture", ("scan slice", seen.scan), lambda: scan_slice(self._loader, seen))

    def probe(self, ray: Sequence[float], shown: PhotoEntry | None) -> dict[str, Any]:
        """Return the measurement along a ray of the scan beside a photograph."""
        from ladarreg_core.inspection.picks import probe

        found = probe(self._scan(shown), ray)
        edge = found.edge
        return {
            "range_m": found.range_m,
            "intensity": found.intensity,
            "cell": found.cell,
            "edge": None
            if edge is None
            else {
                "near_m": edge.near_m,
                "far_m": edge.far_m,
                "near": edge.near_ray.tolist(),
                "far": edge.far_ray.tolist(),
            },
        }

    def check_camera(self, entry: PhotoEntry, camera: CameraGiven) -> None:
        """Refuse a camera that does not fit its photograph.

        Raises:
            LadarregError: naming the reason.
        """
        trial = msgspec.structs.replace(entry, camera=camera)
        self._loader.preload_photo(trial)
        self._loader.photo(trial)

    def place_beside(self, entry: PhotoEntry | None) -> Rigid:
        """Return the pose of the scan beside a photograph in the frame of the project's, in which the 3-D view is.

        Raises:
            OptionError: if it is not known.
        """
        found = known_place(self._session.document, "" if entry is None else entry.station)
        if found is None:
            raise OptionError(
                "the 3-D view does not show where the station of this photograph stands; register the stations first, "
                "or choose another station for the photograph"
            )
        return found

    def _scan(self, entry: PhotoEntry | None) -> Scan:
        scan = self._loader.scan(self._session.document.beside(entry))
        if scan is None:
            raise OptionError("there is no scan; open one")
        return scan
