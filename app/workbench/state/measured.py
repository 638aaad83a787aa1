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
from ladarreg_core.project.station_edits import partner_of

from ...messages import sentence
from ...session.loader import Loader
from ...session.measured import Picked, in_common_frame, measured_places, photos_of, stale_poses
from ...session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.inspection.measuring.drawn import DrawnMeasurement
    from ladarreg_core.inspection.measuring.measurement_list import NamedMeasurement
    from ladarreg_core.project.document import Document, MeasuredPlace, MeasurementEntry, PhotoEntry
    from ladarreg_core.scan import Scan
    from ladarreg_core.surface.visibility.visible_points import Occluder

    from ...scene import MeasuredShown
    from ...slices.project import Drawing, Drawings, MeasuredValue, Measurement, MeasurementPlace
    from ...slices.project import Measured as MeasuredSlice

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

    def slice(self) -> list[MeasuredSlice]:
        """Return the slice `measured`."""
        document = self._session.document
        entries = document.measurements
        found = self._of_places(document, list(map(Picked.of, entries)))
        looked_at = sorted(self._looked_at()) if entries else []
        return [
            {
                "id": entry.id,
                **self._fields(document, Picked.of(entry), value),
                **self._drawing(document, Picked.of(entry), value, looked_at),
            }
            for entry, value in zip(entries, found, strict=True)
        ]

    def preview(self, picked: Picked) -> MeasuredValue:
        """Return the value of points that are being picked, or why they cannot be measured.

        Raises:
            OptionError: if there is no scan, or no such station.
        """
        document = self._with_scan(picked.station)
        (found,) = self._of_places(document, [picked])
        return self._fields(document, picked, found)

    def check(self, picked: Picked) -> None:
        """Refuse what cannot be measured.

        Raises:
            OptionError: with the reason.
        """
        (found,) = self._of_places(self._with_scan(picked.station), [picked])
        if found.measurement is None:
            raise OptionError(found.refusal)

    def shown(self) -> MeasuredShown | None:
        """Return what is drawn of measurements in space, in the frame of the project's scan; None: nothing.

        Those of stations that stand nobody knows where are not drawn.
        """
        from ladarreg_core.inspection.measuring.drawn import lines_of

        from ...scene import MeasuredShown

        document = self._session.document
        entries = document.measurements
        if not entries or self._loader.scan(document) is None:
            return None
        values = self._of_places(document, list(map(Picked.of, entries)))
        placed = [self._placed(document, entry.station, value) for entry, value in zip(entries, values, strict=True)]
        key = tuple(map(id, placed)), tuple(entry.title for entry in entries)
        if key != self._shown[0]:
            pairs = [
                (entry, value.measurement)
                for entry, value in zip(entries, placed, strict=True)
                if value.measurement is not None and not value.own_frame
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

    def _with_scan(self, station: str) -> Document:
        document = self._session.document
        if partner_of(document, station) is None:
            raise OptionError("there is no scan to measure on; open one")
        return document

    def _of_places(self, document: Document, wanted: Sequence[Picked]) -> list[NamedMeasurement]:
        """Return what was measured; all that is not known yet is measured together, which takes hardly longer."""

        def poses(one: Picked) -> Hashable:
            seen = self._loader.seen_from_scan(document, one.station)
            return tuple(_pose_of(seen.photo(each)) for each in photos_of(one.places))

        keys = [(partner_of(document, one.station), one.kind, one.places, poses(one)) for one in wanted]
        with self._lock:
            new = {key: one for key, one in zip(keys, wanted, strict=True) if key not in self._values}
            made = dict(zip(new, measured_places(self._loader, document, list(new.values())), strict=True))
            return [self._kept(self._values, key, partial(made.__getitem__, key)) for key in keys]

    def _placed(self, document: Document, station: str, found: NamedMeasurement) -> NamedMeasurement:
        """Return it in the frame of the project's scan; the same object while the station stays where it is."""
        if not document.stations:
            return found
        rests_on = (found, document.scan, document.stations, document.survey, document.adjusted)
        key = "placed", station, *map(id, rests_on)
        return self._kept(self._drawn, key, lambda: (rests_on, in_common_frame(document, station, found)))[1]  # type: ignore[no-any-return]

    def _fields(self, document: Document, picked: Picked, found: NamedMeasurement) -> MeasuredValue:
        if found.measurement is None:
            return {"value": "", "interval": "", "notes": [], "refusal": sentence(found.refusal)}
        placed = self._placed(document, picked.station, found)
        measured = placed.measurement
        assert measured is not None, "it was measured"
        seen = self._loader.seen_from_scan(document, picked.station)
        notes = [*measured.flags, *stale_poses(self._loader, seen, picked.places)]
        if placed.own_frame and measured.kind == "point":
            notes.append(f"is in the frame of {placed.scan}: it is not known where that stands; register the stations")
        return {
            "value": _typeset(measured.described),
            "interval": _typeset(measured.described_interval),
            "notes": [sentence(note) for note in notes],
            "refusal": "",
        }

    def _drawing(
        self, document: Document, picked: Picked, found: NamedMeasurement, looked_at: Sequence[str]
    ) -> Drawings:
        measured = found.measurement
        if measured is None:
            return {"drawn": None, "in_photo": {}}
        from ladarreg_core.inspection.measuring.drawn import drawn_from_scanner

        seen = self._loader.seen_from_scan(document, picked.station)
        scan = self._loader.scan(seen)
        assert scan is not None, "it was measured on it"
        # the measurement is kept beside what is drawn of it, so that its id is not used again
        _, drawn = self._kept(self._drawn, id(found), lambda: (found, _rows(drawn_from_scanner(measured), 6)))
        pictures: dict[str, Drawing] = {}
        for photo in filter(None, map(seen.photo, looked_at)):
            key = (id(found), photo.id, _pose_of(photo))
            if key[-1]:
                _, picture = self._kept(self._drawn, key, partial(self._in_photo, scan, picked.places, found, photo))
                if picture is not None:
                    pictures[photo.id] = picture
        return {"drawn": drawn, "in_photo": pictures}

    def _in_photo(
        self, scan: Scan, places: Sequence[MeasuredPlace], found: NamedMeasurement, photo: PhotoEntry
    ) -> tuple[NamedMeasurement, Drawing | None]:
        from ladarreg_core.inspection.measuring.drawn import drawn_in_photo, may_be_drawn
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
            self._occluders, (id(scan), _pose_of(photo)),
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


def measurement_entry(entry: MeasurementEntry) -> Measurement:
    """Return an entry of the slice `measurements`."""
    return {
        "id": entry.id,
        "station": entry.station,
        "name": entry.title,
        "kind": entry.kind,
        "places": [_place(one) for one in entry.places],
    }


def _place(one: MeasuredPlace) -> MeasurementPlace:
    at: MeasurementPlace = {"photo": one.photo, "uv": list(one.at)} if one.photo else {"ray": list(one.at)}
    if one.sigma:
        at["sigma_px" if one.photo else "sigma_rad"] = one.sigma
    return at


def _pose_of(entry: PhotoEntry | None) -> Hashable:
    """Return what changes with the pose by which a photograph is measured; None: there is no photograph, or empty: it
    has no such pose.
    """
    if entry is None:
        return None
    pose = entry.pose
    return (pose.name, pose.camera_from_scanner, pose.covariance) if pose is not None and pose.accepted else ()


def _rows(drawn: DrawnMeasurement, digits: int) -> Drawing:
    ends, lines = (np.round(part, digits) for part in (drawn.ends, drawn.lines))
    return {
        "ends": [_row(end) for end in ends],
        "lines": [[_row(at) for at in line] for line in lines],
    }


def _row(values: Any) -> list[float] | None:
    return values.tolist() if np.isfinite(values).all() else None


def _typeset(text: str) -> str:
    return text.replace("+-", "±").replace("m2", "m²").replace(" deg", "°")
