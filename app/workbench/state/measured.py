"""What the project has measured, as scan and poses are now: values, notes, and how they are drawn."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ladarreg_core.errors import LadarregError, OptionError

from ...messages import sentence
from ...session.loader import Loader
from ...session.measured import Picked, measured_places, photos_of, stale_poses
from ...session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.measuring.drawn import DrawnMeasurement
    from ladarreg_core.measuring.measurement_list import NamedMeasurement
    from ladarreg_core.project.document import Document, MeasuredPlace, MeasurementEntry, MeasurementKind, PhotoEntry
    from ladarreg_core.scan import Scan
    from ladarreg_core.surface.visibility.visible_points import Occluder

    from ...scene import MeasuredShown

log = logging.getLogger(__name__)
T = TypeVar("T")
_KEPT, _OCCLUDERS = 2000, 4


class Measured:
    """Measures what the document lists; a value is kept while scan and poses stay.

    Args:
        session: the session.
        loader: its loader.
        looked_at: returns the ids of the photographs that clients see, in which measurements are drawn.
    """

    def __init__(self, session: Session, loader: Loader, looked_at: Callable[[], Collection[str]]) -> None:
        self._session, self._loader, self._looked_at = session, loader, looked_at
        self._lock = threading.RLock()
        self._values: OrderedDict[Hashable, NamedMeasurement] = OrderedDict()
        self._drawn: OrderedDict[Hashable, Any] = OrderedDict()
        self._occluders: OrderedDict[Hashable, Occluder] = OrderedDict()
        self._shown: tuple[Hashable, MeasuredShown | None] = None, None

    def slice(self) -> list[dict[str, Any]]:
        """Return the slice `measured`."""
        document = self._loader.seen_from_scan(self._session.document)
        if not document.measurements:
            return []
        try:
            scan = self._loader.scan(document)
        except LadarregError:  # the slice `scan` states it
            scan = None
        if scan is None:
            return []
        found = self._measured(document, scan, document.measurements)
        seen = [photo for each in sorted(self._looked_at()) if (photo := document.photo(each)) is not None]
        return [
            {
                "id": entry.id,
                **self._fields(document, entry.places, value),
                **self._drawing(scan, entry.places, value, seen),
            }
            for entry, value in zip(document.measurements, found, strict=True)
        ]

    def preview(self, kind: MeasurementKind, places: Sequence[MeasuredPlace]) -> dict[str, Any]:
        """Return the value of points that are being picked, or why they cannot be measured.

        Raises:
            OptionError: if there is no scan.
        """
        document, scan = self._present()
        (found,) = self._of_places(document, scan, [(kind, places)])
        return self._fields(document, places, found)

    def check(self, kind: MeasurementKind, places: Sequence[MeasuredPlace]) -> None:
        """Refuse what cannot be measured.

        Raises:
            OptionError: with the reason.
        """
        document, scan = self._present()
        (found,) = self._of_places(document, scan, [(kind, places)])
        if found.measurement is None:
            raise OptionError(found.refusal)

    def shown(self) -> MeasuredShown | None:
        """Return what is drawn of measurements in space; None: nothing."""
        from ladarreg_core.measuring.drawn import lines_of

        from ...scene import MeasuredShown

        document = self._loader.seen_from_scan(self._session.document)
        scan = self._loader.scan(document) if document.measurements else None
        if scan is None:
            return None
        values = self._measured(document, scan, document.measurements)
        key = tuple(map(id, values)), tuple(entry.title for entry in document.measurements)
        if key != self._shown[0]:
            pairs = [
                (entry, value.measurement)
                for entry, value in zip(document.measurements, values, strict=True)
                if value.measurement is not None
            ]
            lines = [lines_of(measured) for _, measured in pairs]
            points = [measured.points.xyz for _, measured in pairs]
            labels = tuple(
                (
                    (line[0].mean(axis=0) if len(line) else xyz[0]),
                    entry.title if measured.kind == "point" else f"{entry.title}: {_typeset(measured.described)}",
                )
                for (entry, measured), line, xyz in zip(pairs, lines, points, strict=True)
            )
            shown = MeasuredShown(np.concatenate(lines), np.concatenate(points), labels) if pairs else None
            self._shown = key, shown
        return self._shown[1]

    def _present(self) -> tuple[Document, Scan]:
        document = self._loader.seen_from_scan(self._session.document)
        scan = self._loader.scan(document)
        if scan is None:
            raise OptionError("there is no scan to measure on; open one")
        return document, scan

    def _measured(self, document: Document, scan: Scan, entries: Sequence[MeasurementEntry]) -> list[NamedMeasurement]:
        return self._of_places(document, scan, [(entry.kind, entry.places) for entry in entries])

    def _of_places(self, document: Document, scan: Scan, wanted: Sequence[Picked]) -> list[NamedMeasurement]:
        """Return what was measured; all that is not known yet is measured together, which takes hardly longer."""
        keys = [
            (document.scan, kind, tuple(places), tuple(_known(document.photo(each)) for each in photos_of(places)))
            for kind, places in wanted
        ]
        with self._lock:
            new = {key: one for key, one in zip(keys, wanted, strict=True) if key not in self._values}
            made = dict(zip(new, measured_places(self._loader, document, scan, list(new.values())), strict=True))
            return [self._kept(self._values, key, partial(made.__getitem__, key)) for key in keys]

    def _fields(self, document: Document, places: Sequence[MeasuredPlace], found: NamedMeasurement) -> dict[str, Any]:
        measured = found.measurement
        if measured is None:
            return {"value": "", "interval": "", "notes": [], "refusal": sentence(found.refusal)}
        notes = [*measured.flags, *stale_poses(self._loader, document, places)]
        return {
            "value": _typeset(measured.described),
            "interval": _typeset(measured.described_interval),
            "notes": [sentence(note) for note in notes],
            "refusal": "",
        }

    def _drawing(
        self, scan: Scan, places: Sequence[MeasuredPlace], found: NamedMeasurement, photos: Sequence[PhotoEntry]
    ) -> dict[str, Any]:
        measured = found.measurement
        if measured is None:
            return {"drawn": None, "in_photo": {}}
        from ladarreg_core.measuring.drawn import drawn_from_scanner

        # the measurement is kept beside what is drawn of it, so that its id is not used again
        _, drawn = self._kept(self._drawn, id(found), lambda: (found, _rows(drawn_from_scanner(measured), 6)))
        pictures: dict[str, Any] = {}
        for photo in photos:
            key = (id(found), photo.id, _pose_name(photo))
            if key[-1]:
                _, picture = self._kept(self._drawn, key, partial(self._in_photo, scan, places, found, photo))
                if picture is not None:
                    pictures[photo.id] = picture
        return {"drawn": drawn, "in_photo": pictures}

    def _in_photo(
        self, scan: Scan, places: Sequence[MeasuredPlace], found: NamedMeasurement, photo: PhotoEntry
    ) -> tuple[NamedMeasurement, dict[str, Any] | None]:
        from ladarreg_core.measuring.drawn import drawn_in_photo, may_be_drawn
        from ladarreg_core.surface.visibility.visible_points import Occluder

        assert photo.pose is not None
        assert found.measurement is not None
        try:
            registration = self._loader.registration(photo.pose)
        except LadarregError:  # its matches are missing, which the verdict of its stage states
            return found, None
        if not may_be_drawn(found.measurement, registration):
            return found, None
        occluder = self._kept(
            self._occluders, (id(scan), _pose_name(photo)),
            lambda: Occluder(scan, registration.camera, registration.camera_from_scanner), most=_OCCLUDERS,
        )  # fmt: skip
        seen = [one.photo == photo.id for one in places]
        return found, _rows(drawn_in_photo(found.measurement, registration, occluder, seen=seen), 2)

    def _kept(self, kept: OrderedDict[Hashable, T], key: Hashable, make: Callable[[], T], *, most: int = _KEPT) -> T:
        with self._lock:
            if key not in kept:
                kept[key] = make()
                while len(kept) > most:
                    kept.popitem(last=False)
            kept.move_to_end(key)
            return kept[key]


def measurement_entry(entry: MeasurementEntry) -> dict[str, Any]:
    """Return an entry of the slice `measurements`."""
    return {
        "id": entry.id,
        "name": entry.title,
        "kind": entry.kind,
        "places": [_place(one) for one in entry.places],
    }


def _place(one: MeasuredPlace) -> dict[str, Any]:
    at, unit = ({"photo": one.photo, "uv": list(one.at)}, "px") if one.photo else ({"ray": list(one.at)}, "rad")
    return at | ({f"sigma_{unit}": one.sigma} if one.sigma else {})


def _pose_name(entry: PhotoEntry) -> str:
    """Return what changes with the pose by which a photograph is measured; empty: none."""
    return "" if entry.pose is None or not entry.pose.accepted else entry.pose.name


def _known(entry: PhotoEntry | None) -> str | None:
    return None if entry is None else _pose_name(entry)


def _rows(drawn: DrawnMeasurement, digits: int) -> dict[str, Any]:
    ends, lines = (np.round(part, digits) for part in (drawn.ends, drawn.lines))
    return {
        "ends": [_row(end) for end in ends],
        "lines": [[_row(at) for at in line] for line in lines],
    }


def _row(values: Any) -> list[float] | None:
    return values.tolist() if np.isfinite(values).all() else None


def _typeset(text: str) -> str:
    return text.replace("+-", "±").replace("m2", "m²").replace(" deg", "°")
