"""Edits of what a document has measured. Only the picked places are kept: values follow from scan and poses."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document, MeasuredPlace, MeasurementEntry, MeasurementKind
from ladarreg_core.project.edits import MAX_PIXEL, finite, require_photo
from ladarreg_core.project.station_edits import partner_of

MAX_MEASUREMENTS = 500
MAX_PLACES = 100
"""Most points of one measurement."""
MAX_SIGMA_RAD, MAX_SIGMA_PX = 0.2, 1000.0
"""Largest standard deviations of a pick."""
MAX_NAME = 60
"""Longest name of a measurement, letters."""


def place(at: Sequence[object], photo: str = "", sigma: object = 0.0) -> MeasuredPlace:
    """Return a picked point.

    Args:
        at: a ray of the scanner frame, of any length, or a pixel of a photograph.
        photo: id of the photograph; empty: the point was picked in the scan.
        sigma: standard deviation of the pick along each axis, rad of a ray or pixels; 0: as usual.

    Raises:
        OptionError: if it is not three finite numbers that are not all zero, or two of a pixel near the photograph; or
            the standard deviation is negative or so large that nothing was picked.
    """
    picked, largest_sigma, unit = finite(sigma), *((MAX_SIGMA_PX, "px") if photo else (MAX_SIGMA_RAD, "rad"))
    if picked is None or not 0 <= picked <= largest_sigma:
        raise OptionError(f"the standard deviation of a pick is {sigma!r}; it is 0 to {largest_sigma:g} {unit}")
    numbers = [finite(value) for value in at]
    wanted = 2 if photo else 3
    if len(numbers) != wanted or any(value is None for value in numbers):
        kind = "a pixel [u, v]" if photo else "a ray [x, y, z]"
        raise OptionError(f"a point has {len(numbers)} numbers; it is {kind}, {wanted} finite numbers")
    values = np.array(numbers, dtype=np.float64)
    if photo:
        if (np.abs(values) > MAX_PIXEL).any():
            raise OptionError(f"a pixel lies more than {MAX_PIXEL:,.0f} px from the image's corner; pick in the image")
        return MeasuredPlace(at=tuple(values.tolist()), photo=photo, sigma=picked)
    largest = float(np.abs(values).max())
    if largest == 0:
        raise OptionError("a ray has zero length; a ray is a direction [x, y, z]")
    values /= largest  # first: the squares of huge numbers overflow
    return MeasuredPlace(at=tuple((values / np.linalg.norm(values)).tolist()), sigma=picked)


def with_measurement(
    document: Document, kind: MeasurementKind, places: Sequence[MeasuredPlace], station: str = ""
) -> tuple[Document, MeasurementEntry]:
    """Return the document with a measurement, and that.

    Args:
        document: the document.
        kind: what is measured.
        places: the points.
        station: id of the station on whose scan it is measured; empty: the project's scan.

    Raises:
        OptionError: if there is no scan, there are too many measurements or points, or a photograph or the station is
            unknown.
    """
    if partner_of(document, station) is None:
        raise OptionError("there is no scan to measure on; open one")
    if len(document.measurements) >= MAX_MEASUREMENTS:
        raise OptionError(f"the project has {MAX_MEASUREMENTS} measurements, which is the maximum; remove some first")
    for one in places:
        if one.photo:
            require_photo(document, one.photo)
    number = document.numbered_measurements + 1
    entry = MeasurementEntry(id=f"m{number}", number=number, kind=kind, places=tuple(places), station=station)
    new = checked_measurement(entry)
    return replace(document, measurements=(*document.measurements, new), numbered_measurements=number), new


def with_measurement_name(document: Document, measurement_id: str, name: str) -> Document:
    """Return the document with another name of a measurement; an empty one is kind and number.

    Raises:
        OptionError: if there is no such measurement.
    """
    old = require_measurement(document, measurement_id)
    words = " ".join("".join(letter if letter.isprintable() else " " for letter in name).split())[:MAX_NAME].strip()
    new = replace(old, name="" if words == replace(old, name="").title else words)
    return replace(document, measurements=tuple(new if each is old else each for each in document.measurements))


def without_measurements(document: Document, ids: Collection[str]) -> Document:
    """Return the document without some measurements."""
    return replace(document, measurements=tuple(each for each in document.measurements if each.id not in ids))


def with_one_list(document: Document) -> Document:
    """Return a document with all measurements in one list, without those of stations that it has no longer; earlier
    versions kept what was measured on a station's scan with the station.
    """
    ids = {"", *(station.id for station in document.stations)}
    moved = [replace(each, station=one.id) for one in document.stations for each in one.measurements]
    if not moved and all(each.station in ids for each in document.measurements):
        return document
    again = {each.id for each in moved}
    kept = (each for each in document.measurements if each.station in ids and each.id not in again)
    stations = tuple(replace(one, measurements=()) if one.measurements else one for one in document.stations)
    return replace(document, measurements=(*kept, *moved), stations=stations)


def require_measurement(document: Document, measurement_id: object) -> MeasurementEntry:
    """Return a measurement by its id.

    Raises:
        OptionError: if there is none.
    """
    found = next((each for each in document.measurements if each.id == measurement_id), None)
    if found is None:
        raise OptionError("the measurement no longer exists: it was removed")
    return found


def checked_measurement(entry: MeasurementEntry) -> MeasurementEntry:
    """Return a measurement whose points are sound.

    Raises:
        OptionError: if there is none, there are too many, or one is neither a ray nor a pixel.
    """
    if not 1 <= len(entry.places) <= MAX_PLACES:
        raise OptionError(f"a measurement has {len(entry.places)} points; it takes from 1 to {MAX_PLACES}")
    for one in entry.places:
        place(one.at, one.photo)
    return entry
