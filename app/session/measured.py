"""What a project has measured, by its scans and poses as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project.station_edits import known_place, partner_of, place_sigmas

from .loader import Loader

if TYPE_CHECKING:
    from ladarreg_core.formats.documents.places_file import Place
    from ladarreg_core.inspection.measuring.measurement_list import NamedMeasurement
    from ladarreg_core.project.document import Document, MeasuredPlace, MeasurementEntry, MeasurementKind
    from ladarreg_core.results.registration import PoseResult
    from ladarreg_core.scan import Scan


class Picked(NamedTuple):
    """What is measured, between which points."""

    station: str
    """Id of the station on whose scan it is measured; empty: the project's scan."""
    kind: MeasurementKind
    """What is measured."""
    places: tuple[MeasuredPlace, ...]
    """The points."""

    @staticmethod
    def of(entry: MeasurementEntry) -> Picked:
        """Return what was measured."""
        return Picked(entry.station, entry.kind, entry.places)


def measured_places(loader: Loader, document: Document, wanted: Sequence[Picked]) -> list[NamedMeasurement]:
    """Measure, in the frames of the scans' own scanners; all of one scan together, which takes hardly longer than one.

    What cannot be measured is refused, each with its reason.
    """
    from ladarreg_core.inspection.measuring.measurement_list import NamedMeasurement

    found: dict[int, NamedMeasurement] = {}
    for station in dict.fromkeys(one.station for one in wanted):
        numbers = [k for k, one in enumerate(wanted) if one.station == station]
        some = [wanted[k] for k in numbers]
        try:
            seen = loader.seen_from_scan(document, station)
            scan = loader.scan(seen)
            if scan is None:
                raise OptionError("there is no scan to measure on; open one")
        except LadarregError as error:
            made = [NamedMeasurement("", one.kind, None, str(error)) for one in some]
        else:
            made = _on_scan(loader, seen, scan, some)
        found |= dict(zip(numbers, made, strict=True))
    return [found[k] for k in range(len(wanted))]


def in_common_frame(document: Document, station: str, found: NamedMeasurement) -> NamedMeasurement:
    """Return what was measured on the scan of a station in the frame of the project's scan, with the name of its scan.

    Where the station's place is not known it stays in the frame of its own scanner.
    """
    from ladarreg_core.inspection.measuring.measurement_list import in_frame

    source, place = partner_of(document, station), known_place(document, station)
    if document.stations and source is not None:
        found = replace(found, scan=source.name, own_frame=place is None)
    if not station or place is None:
        return found
    sigma_m, sigma_rad = place_sigmas(document, station, "")
    return in_frame(found, place, name=found.name, sigma_m=sigma_m, sigma_rad=sigma_rad)


def stale_poses(loader: Loader, document: Document, places: Sequence[MeasuredPlace]) -> list[str]:
    """Return which poses that points rest on are out of date, in sentences."""
    entries = [entry for photo in photos_of(places) if (entry := document.photo(photo)) is not None]
    stale = [
        (entry, why)
        for entry in entries
        if entry.pose is not None and (why := loader.stale(document, entry, entry.pose))
    ]
    return [f"the pose of {entry.source.name} is out of date: {why}" for entry, why in stale]


def photos_of(places: Sequence[MeasuredPlace]) -> list[str]:
    """Return the ids of the photographs in which points were picked."""
    return list(dict.fromkeys(one.photo for one in places if one.photo))


def _on_scan(loader: Loader, seen: Document, scan: Scan, wanted: Sequence[Picked]) -> list[NamedMeasurement]:
    """Measure on one scan, with all photographs as seen from it."""
    from ladarreg_core.formats.documents.places_file import Place
    from ladarreg_core.inspection.measuring.measurement_list import NamedMeasurement, measure_places

    refusals: dict[int, str] = {}
    photos: Mapping[str, PoseResult] = {}
    listed: list[Place] = []
    for number, (_, kind, places) in enumerate(wanted):
        names = ["the point"] if len(places) == 1 else [f"point {k}" for k in range(1, len(places) + 1)]
        try:
            if kind == "point" and len(places) > 1:
                raise OptionError(f"{len(places)} points are given for the coordinates of a point; give one")
            photos = {**photos, **{photo: _registration(loader, seen, photo) for photo in photos_of(places)}}
        except OptionError as error:
            refusals[number] = str(error)
            continue
        listed += [
            Place(one.at, "photo" if one.photo else "ray", one.photo, str(number), kind, name, one.sigma)
            for one, name in zip(places, names, strict=True)
        ]
    found = {int(one.name): one for one in measure_places(scan, photos, listed)} if listed else {}
    for number, why in refusals.items():
        found[number] = NamedMeasurement(str(number), wanted[number].kind, None, why)
    return [found[number] for number in range(len(wanted))]


def _registration(loader: Loader, document: Document, photo: str) -> PoseResult:
    entry = document.photo(photo)
    if entry is None:
        raise OptionError("its photograph is no longer in the project; remove the measurement, or undo")
    if entry.pose is None or not entry.pose.accepted:
        raise OptionError(
            f"{entry.source.name} has no accepted pose, by which its pixels could be measured: solve it first, or "
            "pick in the scan"
        )
    try:
        return loader.registration(entry.pose)
    except LadarregError as error:
        raise OptionError(str(error)) from None
