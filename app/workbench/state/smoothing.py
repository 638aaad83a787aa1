"""Previews of smoothed ranges: what an accepted pose would replace, for each client, and what was replaced."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project.smoothing_edits import (
    replaced_count,
    require_registered,
    smoothing_sentence,
    with_smoothing,
)
from ladarreg_core.project.station_edits import known_place, partner_of

from ...session.loader import Loader
from ...session.session import Session
from .clients import Client, SmoothingChoice

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry
    from ladarreg_core.quality.smoothing import Replacements
    from ladarreg_core.scan import Scan

    from ...scene import SmoothingShown
    from ...slices.choices import SmoothingShow
    from ...slices.project import Smoothing as SmoothingSlice
    from ...slices.project import SmoothingPreview

_KEPT = 4
"""Previews that are kept: of as many photographs at once."""
_OUT_OF_DATE = "The pose or the scan has changed since this preview"


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a pose would replace in a scan."""

    made_of: tuple[Scan, PoseEntry, PhotoEntry]
    """Kept, so that their ids stay theirs."""
    replacements: Replacements
    rays: np.ndarray[Any, Any]
    uv: np.ndarray[Any, Any]
    """(N, 2) pixels at which the photograph shows the new ranges; NaN where it does not."""
    nothing: str
    """Why there is nothing to replace, without a full stop; empty if there is something."""
    rev: str
    """Changes with the ranges of the scan, the pose and what it would replace."""


class Smoothing:
    """Computes previews; nothing of them is in the document before one is applied.

    Args:
        session: the session.
        loader: its loader.
    """

    def __init__(self, session: Session, loader: Loader) -> None:
        self._session, self._loader = session, loader
        self._lock = threading.RLock()
        self._found: OrderedDict[tuple[int, int, int], _Found] = OrderedDict()
        self._shown: dict[str, tuple[tuple[object, ...], SmoothingShown | None]] = {}

    def preview(self, photo_id: str, show: SmoothingShow) -> SmoothingChoice:
        """Return the preview of a photograph, computed as scan and pose are now.

        Raises:
            LadarregError: if the photograph has no current accepted pose, or the scan cannot be read.
        """
        return SmoothingChoice(photo_id, show, self._of(self._session.document, photo_id).rev)

    def apply(self, client: Client, photo_id: str, rev: str, *, edges: bool) -> int | None:
        """Replace the ranges that a client has previewed, and return the number of the step of the history.

        Args:
            client: the client.
            photo_id: the photograph.
            rev: that of its preview.
            edges: whether those at depth edges are replaced, too.

        Raises:
            LadarregError: if scan or pose have changed since the preview, or nothing would be replaced.
        """

        def edit(document: Document) -> Document:
            found = self._of(document, photo_id)
            if found.rev != rev:
                raise OptionError(f"{_OUT_OF_DATE.lower()}, so nothing was applied; preview it again")
            return with_smoothing(document, photo_id, found.replacements.chosen(with_edges=edges))

        count = len(self._of(self._session.document, photo_id).replacements.chosen(with_edges=edges))
        number = self._session.commit(f"Smooth {count} range{'' if count == 1 else 's'}", edit, author=client.author)
        client.smoothing = None
        return number

    def slice(self, client: Client, station: str = "") -> SmoothingSlice:
        """Return the slice `smoothing` of a client that sees the scan of a station; empty: the project's."""
        document = self._session.document
        return {
            "station": station,
            "replaced": replaced_count(partner_of(document, station)),
            "sentence": smoothing_sentence(document, station),
            "preview": self._preview_slice(document, client.smoothing),
        }

    def shown(self, client: Client) -> SmoothingShown | None:
        """Return what the 3-D view of a client shows of its preview, in the frame of the project's scan; the same
        object while nothing changes. None: nothing, or it is not known where the scan's station stands.
        """
        document, choice = self._session.document, client.smoothing
        found = None if choice is None else self._current(document, choice)
        if choice is None or found is None:
            return None
        key = found, choice.show, document.scan, document.stations, document.survey, document.adjusted
        known = self._shown.get(client.id)
        if known is None or known[0] != key:
            known = self._shown[client.id] = key, _drawn(found, choice, known_place(document, found.made_of[2].station))
        return known[1]

    def _preview_slice(self, document: Document, choice: SmoothingChoice | None) -> SmoothingPreview | None:
        if choice is None:
            return None
        entry, found = document.photo(choice.photo), self._current(document, choice)
        shown: SmoothingPreview = {
            "photo": choice.photo,
            "name": "" if entry is None else entry.source.name,
            "station": "" if entry is None else entry.station,
            "show": choice.show,
            "rev": choice.rev,
            "stale": "" if found is not None else f"{_OUT_OF_DATE}: preview it again.",
            "nothing": "" if found is None else found.nothing,
            "ranges": [],
        }
        if found is None:
            return shown
        one = found.replacements
        shown["ranges"] = [
            {
                "id": f"{row}.{column}",
                "ray": [round(float(value), 7) for value in ray],
                "uv": [round(float(value), 2) for value in pixel] if np.isfinite(pixel).all() else None,
                "before_m": round(float(before), 4),
                "after_m": round(float(after), 4),
                "sigma_m": round(float(sigma), 4),
                "edge": bool(edge),
            }
            for (row, column), ray, pixel, before, after, sigma, edge in zip(
                one.cells.tolist(),
                found.rays,
                found.uv,
                one.measured,
                one.ranges,
                one.sigma_m,
                one.at_edge,
                strict=True,
            )
        ]
        return shown

    def _current(self, document: Document, choice: SmoothingChoice) -> _Found | None:
        """Return what a client has previewed; None if it is no longer what would be replaced."""
        try:
            found = self._of(document, choice.photo)
        except LadarregError:
            return None
        return found if found.rev == choice.rev else None

    def _of(self, document: Document, photo_id: str) -> _Found:
        pose = require_registered(document, photo_id)
        entry = document.photo(photo_id)
        assert entry is not None, "it has a pose"
        self._require_current(document, entry, pose)
        document = document.beside(entry)
        scan = self._loader.scan(document)
        assert scan is not None, "a scan is open"
        with self._lock:
            key = (id(scan), id(pose), id(entry.picks))
            known = self._found.get(key)
            if known is None:
                known = self._found[key] = self._computed(document, scan, entry, pose)
                while len(self._found) > _KEPT:
                    self._found.popitem(last=False)
        return known

    def _require_current(self, document: Document, entry: PhotoEntry, pose: PoseEntry) -> None:
        stale = self._loader.stale(document, entry, pose)
        if stale:
            raise OptionError(f"the pose of {entry.source.name} is out of date: {stale}")

    def _computed(self, document: Document, scan: Scan, entry: PhotoEntry, pose: PoseEntry) -> _Found:
        from ladarreg_core.quality.smoothing import find_replacements, nothing_found

        result = self._loader.registration(pose)
        found = find_replacements(scan, result, picks=self._loader.picks(entry))
        rays = scan.geometry.ray_at(found.cells.astype(np.float64)) if len(found) else np.zeros((0, 3))
        uv = result.camera.project(result.camera_from_scanner @ (found.ranges[:, None] * rays))
        made_of = msgspec.json.encode(
            [document.scan, pose.name, found.cells.tolist(), found.ranges.tolist(), found.at_edge.tolist()]
        )
        nothing = "" if len(found) else nothing_found(result)
        return _Found((scan, pose, entry), found, rays, uv, nothing, blake2b(made_of, digest_size=8).hexdigest())


def _drawn(found: _Found, choice: SmoothingChoice, place: Rigid | None) -> SmoothingShown | None:
    from ...scene import SmoothingShown

    if place is None:
        return None
    one = found.replacements
    before, after = (place @ (lengths[:, None] * found.rays) for lengths in (one.measured, one.ranges))
    return SmoothingShown(before, after, one.at_edge, choice.show)
