"""What a project has measured, by its scan and poses as they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

from ladarreg_core.errors import LadarregError, OptionError

from .loader import Loader

if TYPE_CHECKING:
    from ladarreg_core.formats.documents.places_file import Place
    from ladarreg_core.measuring.measurement_list import NamedMeasurement
    from ladarreg_core.project.document import Document, MeasuredPlace, MeasurementKind
    from ladarreg_core.results import PoseResult
    from ladarreg_core.scan import Scan

Picked: TypeAlias = "tuple[MeasurementKind, Sequence[MeasuredPlace]]"
"""What is measured, between which points."""


def measured_places(loader: Loader, document: Document, scan: Scan, wanted: Sequence[Picked]) -> list[NamedMeasurement]:
    """Measure, everything together, which takes hardly longer than one; what cannot be measured is refused."""
    from ladarreg_core.formats.documents.places_file import Place
    from ladarreg_core.measuring.measurement_list import NamedMeasurement, measure_places

    refusals: dict[int, str] = {}
    photos: dict[str, PoseResult] = {}
    listed: list[Place] = []
    for number, (kind, places) in enumerate(wanted):
        names = ["the point"] if len(places) == 1 else [f"point {k}" for k in range(1, len(places) + 1)]
        try:
            if kind == "point" and len(places) > 1:
                raise OptionError(f"{len(places)} points are given for the coordinates of a point; give one")
            photos |= {photo: _registration(loader, document, photo) for photo in photos_of(places)}
        except OptionError as error:
            refusals[number] = str(error)
            continue
        listed += [
            Place(one.at, "photo" if one.photo else "ray", one.photo, str(number), kind, name, one.sigma)
            for one, name in zip(places, names, strict=True)
        ]
    found = {int(one.name): one for one in measure_places(scan, photos, listed)} if listed else {}
    for number, why in refusals.items():
        found[number] = NamedMeasurement(str(number), wanted[number][0], None, why)
    return [found[number] for number in range(len(wanted))]


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
