"""Which station each photograph is matched with: chosen by the operator, or as that which sees most of it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.errors import LadarregError
from ladarreg_core.project.edits import require_photo
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.station_edits import known_place, may_choose_partner, partner_of, with_partner

from ...session.debounce import Debouncer
from ...session.loader import Loader
from ...session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.camera import CameraModel
    from ladarreg_core.frames import Rigid
    from ladarreg_core.project.document import Document, PhotoEntry
    from ladarreg_core.project.history import Author

    from ...slices.several import Partner, PartnerChoice

log = logging.getLogger(__name__)
_MIN_SHARE, _BETTER_BY = 0.1, 0.05
"""A station is chosen unasked if it sees so much of the photograph, and so much more than the present one."""
Shares = dict[str, float]
"""Shares of a photograph by the ids of the stations that see it; the empty one is the project's scan."""


class Partners:
    """Computes, in a thread of its own, how much the stations see of the photographs that are looked at.

    Args:
        session: the session.
        loader: its loader.
        looked_at: returns the ids of the photographs that clients see; with True, those who may edit.
        on_change: called when shares are known.
    """

    def __init__(
        self,
        session: Session,
        loader: Loader,
        looked_at: Callable[[bool], Collection[str]],
        on_change: Callable[[], None],
    ) -> None:
        self._session, self._loader, self._looked_at, self._on_change = session, loader, looked_at, on_change
        self._known: dict[str, tuple[tuple[object, ...], Shares]] = {}
        self._debouncer = Debouncer()
        self._thread = threading.Thread(target=self._work, name="partners", daemon=True)
        self._thread.start()

    def refresh(self) -> None:
        """Compute soon what is looked at and not known yet."""
        if self._session.document.stations:
            self._debouncer.request()

    def close(self) -> None:
        """End the thread."""
        self._debouncer.close()
        self._thread.join(30)

    def slice(self, shown: PhotoEntry | None) -> Partner:
        """Return the slice `partner` of a client that sees a photograph."""
        return {"station": "" if shown is None else shown.station, "choices": self._choices(shown)}

    def _choices(self, shown: PhotoEntry | None) -> list[PartnerChoice]:
        document = self._session.document
        if shown is None or document.scan is None or not document.stations:
            return []
        known = self._known.get(shown.id)
        shares = {} if known is None or not _same(known[0], _rests_on(document, shown)) else known[1]
        stations = [("", document.scan), *((station.id, station.source) for station in document.stations)]
        return [
            {"station": name, "name": source.name, "index": source.index, "sees": shares.get(name)}
            for name, source in stations
        ]

    def choose(self, photo_id: str, station_id: str, author: Author) -> int | None:
        """Match a photograph with a station, and return the number of the step of the history.

        Raises:
            LadarregError: if one of them is gone, or the station's scan cannot be read.
        """
        document = self._session.document
        source, entry = partner_of(document, station_id), require_photo(document, photo_id)
        if source is not None and self._loader.known("scan", source) is None:
            self._loader.preload_scan(source)
        name = "" if source is None else source.name
        return self._session.commit(
            f"Match {entry.source.name} with {name}",
            lambda d: with_partner(d, photo_id, station_id, given=True), author=author,
        )  # fmt: skip

    def _work(self) -> None:
        while self._debouncer.wait():
            try:
                for photo_id in sorted(self._looked_at(False)):
                    self._look_at(photo_id)
            except LadarregError as error:
                log.info("how much the stations see of a photograph is not known: %s", error)
            except Exception:
                log.exception("how much the stations see of a photograph")

    def _look_at(self, photo_id: str) -> None:
        document = self._session.document
        photo = document.photo(photo_id)
        if photo is None or not document.stations:
            return
        rests_on, known = _rests_on(document, photo), self._known.get(photo_id)
        if known is None or not _same(known[0], rests_on):
            self._known[photo_id] = rests_on, self._shares(document, photo)
            self._on_change()
        shares = self._known[photo_id][1]
        best = max(shares, key=shares.__getitem__, default=photo.station)
        if best == photo.station or shares[best] < max(_MIN_SHARE, shares.get(photo.station, 0.0) + _BETTER_BY):
            return
        if not may_choose_partner(photo) or photo_id not in self._looked_at(True) or self._session.history.redone:
            return
        source = partner_of(document, best)
        assert source is not None, "its points were seen"
        if self._loader.known("scan", source) is None:
            self._loader.preload_scan(source)

        def edit(present: Document) -> Document:
            now = present.photo(photo_id)
            if now is None or not _same(_rests_on(present, now), rests_on) or not may_choose_partner(now):
                return present
            return with_partner(present, photo_id, best, given=False)

        label = f"Match {photo.source.name} with {source.name}, which sees most of it"
        self._session.commit(label, edit, author=NOBODY, automatic=True)

    def _shares(self, document: Document, photo: PhotoEntry) -> Shares:
        from ladarreg_core.inspection.overlap import seen_shares

        posed = self._posed(document, photo)
        if posed is None:
            return {}
        camera, camera_from_scan = posed
        names, points = [], []
        for name in ("", *(station.id for station in document.stations)):
            place, source = known_place(document, name), partner_of(document, name)
            if place is None or source is None:
                continue
            try:
                found = self._loader.station_points(source, self._loader.known("scan", source))
            except LadarregError:  # its file has gone: the list of stations says so
                continue
            names.append(name)
            points.append((camera_from_scan @ place) @ np.asarray(found, np.float64))
        return dict(zip(names, seen_shares(camera, points), strict=True))

    def _posed(self, document: Document, photo: PhotoEntry) -> tuple[CameraModel, Rigid] | None:
        """Return a photograph's camera, and its pose in the frame of the project's scan; None: it is not known."""
        from ladarreg_core.frames import Rigid
        from ladarreg_core.project.results import pose_of

        place, pose = known_place(document, photo.station), photo.pose
        if place is None:
            return None
        if pose is not None and pose.accepted:
            return self._loader.registration(pose).camera, pose_of(pose) @ place.inverse
        camera = self._loader.header(photo).camera
        if photo.stated_pose is None or camera is None:
            return None
        return camera, Rigid.from_matrix(np.array(photo.stated_pose)) @ place.inverse


def _rests_on(document: Document, photo: PhotoEntry) -> tuple[object, ...]:
    """Return what the shares of a photograph rest on."""
    places = document.scan, document.stations, document.survey, document.adjusted
    return (*places, photo.source, photo.camera, photo.stated_pose, photo.pose)


def _same(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    return all(a is b for a, b in zip(one, other, strict=True))
