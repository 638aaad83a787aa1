"""Edits of a document's stations: scans of one place from elsewhere, of which one is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.project.document import Document, PhotoEntry, Rows, Source, StationEntry, Survey
from ladarreg_core.project.edits import finite

MAX_STATIONS = 12
"""Most stations of a project besides the scan that is shown: every pair of them is compared."""
_FARTHEST_M = 10_000.0


def scans_of(document: Document) -> tuple[Source, ...]:
    """Return the files of all stations, the scan that is shown first."""
    shown = () if document.scan is None else (document.scan,)
    return (*shown, *(station.source for station in document.stations))


def with_stations(document: Document, sources: Sequence[Source]) -> Document:
    """Return the document with further stations, those that are not there yet, alone or as a cloud of another.

    Raises:
        OptionError: if there is no scan yet, all are there already, or there would be too many.
    """
    if document.scan is None:
        raise OptionError("stations are registered to the project's scan; open that first")
    there = {(path, source.index) for source in scans_of(document) for path in source.paths}
    new = [source for source in sources if _key(source) not in there]
    if not new:
        raise OptionError(f"{sources[0].name} is in the project already; add scans of other stations")
    number = document.numbered_stations
    added = (StationEntry(id=f"s{number + k}", source=source) for k, source in enumerate(new, 1))
    stations = (*document.stations, *added)
    if len(stations) > MAX_STATIONS:
        raise OptionError(
            f"there would be {len(stations)} further stations; a project takes {MAX_STATIONS}: register more with "
            "ladarreg register-scans"
        )
    return replace(document, stations=stations, numbered_stations=number + len(new))


def require_station(document: Document, station_id: object) -> StationEntry:
    """Return a station by its id.

    Raises:
        OptionError: if there is none.
    """
    found = next((station for station in document.stations if station.id == station_id), None)
    if found is None:
        raise OptionError("this station is no longer in the project; choose another")
    return found


def without_station(document: Document, station_id: object) -> Document:
    """Return the document without a station."""
    gone = require_station(document, station_id)
    return replace(document, stations=tuple(each for each in document.stations if each is not gone))


def rough_pose(fields: Mapping[str, object]) -> Rigid:
    """Return the rough pose of an upright scanner in the frame of another: `x`, `y`, `z`, m, and `yaw_deg`.

    Raises:
        OptionError: if one of them is missing, or absurdly large.
    """
    values = [finite(fields.get(name)) for name in ("x", "y", "z", "yaw_deg")]
    if any(value is None or abs(value) > _FARTHEST_M for value in values):
        raise OptionError(
            f"a rough place is x, y and z in m and yaw_deg, numbers within {_FARTHEST_M:,.0f}; enter all of them"
        )
    x, y, z, yaw = (float(value) for value in values if value is not None)
    return Rigid(rotation_about("z", float(np.radians(yaw))), np.array([x, y, z]))


def with_rough_place(document: Document, station_id: object, rough: Rigid | None) -> Document:
    """Return the document with another rough pose of a station, in the frame of the scan that is shown; None: none."""
    chosen = require_station(document, station_id)
    rows = None if rough is None else _rows(rough)
    stations = tuple(replace(each, rough=rows) if each is chosen else each for each in document.stations)
    return replace(document, stations=stations)


def surveyed_pose(survey: Survey | None, source: Source | None) -> Rigid | None:
    """Return `world_from_scanner` of a scan as the stations were registered; None if it was not."""
    found = stated_station(survey, source)
    matrix = None if found is None else found["world_from_scanner"]
    return None if matrix is None else Rigid.from_matrix(matrix)


def stated_station(survey: Survey | None, source: Source | None) -> Mapping[str, Any] | None:
    """Return what a survey states of a scan, which may have got further clouds since; None if it was not in it.

    The frame of a scan is that of its first cloud, so that it stands where it stood.
    """
    if survey is None or source is None:
        return None
    keys = [_key(scan) for scan in survey.scans]
    return survey.fields["stations"][keys.index(_key(source))] if _key(source) in keys else None


def checked_survey(survey: Survey) -> Survey:
    """Return a survey that was read from a file.

    Raises:
        FormatError: if its fields are not those of a result on its scans.
    """
    fields = survey.fields
    try:
        stations = fields["stations"]
        known = {(one["name"], one["state"], one["sigma_mm"] is None, one["sigma_deg"] is None) for one in stations}
        for pair in fields["pairs"]:
            known.add((stations[pair["first"]]["name"], stations[pair["second"]]["name"], pair["verdict"], True))
            known.add((*map(str, pair["reasons"]), pair["evidence"]["overlap"], pair["sigma_mm"], pair["sigma_deg"]))
        for loop in fields["loops"]:
            known.add((*(stations[k]["name"] for k in loop["stations"]), loop["error_mm"], loop["error_deg"]))
        sound = len(stations) == len(survey.scans) and all(isinstance(reason, str) for reason in fields["reasons"])
        for source in survey.scans:
            surveyed_pose(survey, source)
    except (KeyError, IndexError, TypeError, ValueError, LadarregError) as error:
        raise FormatError(f"its stations are damaged ({type(error).__name__}: {error}); register them again") from None
    if not sound:
        raise FormatError("its stations are damaged: they are not those of its scans; register them again")
    return survey


def place_of(document: Document, station: StationEntry) -> Rigid | None:
    """Return `shown_from_station`, of the scan that is shown; None where it is not known at all.

    It is the place that was adjusted with the photographs, else the registered one, else the rough one.
    """
    for poses in (adjusted_poses(document), registered_poses(document)):
        shown, other = (
            None if source is None else poses.get(_key(source)) for source in (document.scan, station.source)
        )
        if shown is not None and other is not None:
            return shown.inverse @ other
    return None if station.rough is None else Rigid.from_matrix(station.rough)


def adjusted_poses(document: Document) -> dict[tuple[str, int], Rigid]:
    """Return `world_from_scanner` of the scans as they were adjusted with the photographs, by path and index."""
    scans = () if document.adjusted is None else document.adjusted.scans
    return {
        _key(one.source): Rigid.from_matrix(one.world_from_scanner)
        for one in scans
        if one.world_from_scanner is not None
    }


def registered_poses(document: Document) -> dict[tuple[str, int], Rigid]:
    """Return the same as the stations were registered to each other."""
    survey = document.survey
    scans = () if survey is None else survey.scans
    return {_key(one): pose for one in scans if (pose := surveyed_pose(survey, one)) is not None}


def is_stale(document: Document) -> bool:
    """Return whether stations have come or gone since they were registered, or got further clouds or ranges."""
    survey = document.survey
    if survey is None:
        return False
    then, now = (
        {(source.index, source.paths, source.ranges) for source in scans}
        for scans in (survey.scans, scans_of(document))
    )
    return then != now


def with_station_shown(document: Document, station_id: object) -> Document:
    """Return the document with another station's scan shown, to which photographs are registered from now on.

    The scan that was shown becomes a station, and keeps what was done on it: matches, poses and measurements return
    with it. A photograph that has none at the new one begins at the pose that it had, if the stations are registered.
    """
    chosen = require_station(document, station_id)
    assert document.scan is not None, "stations are added to a scan"
    between = place_of(document, chosen)
    registered = surveyed_pose(document.survey, chosen.source) is not None
    kept = {photo.id: photo for photo in chosen.photos}
    photos = tuple(
        _at_other_station(photo, kept.get(photo.id), between if registered else None, document.scan.name)
        for photo in document.photos
    )
    rough = None if between is None else _rows(between.inverse)
    number = document.numbered_stations + 1
    before = StationEntry(
        id=f"s{number}", source=document.scan, photos=document.photos, rough=rough, measurements=document.measurements
    )
    stations = tuple(
        before if each is chosen else replace(each, rough=_seen_from(each.rough, between)) for each in document.stations
    )
    return replace(
        document, scan=chosen.source, photos=photos, stations=stations, numbered_stations=number,
        measurements=chosen.measurements,
    )  # fmt: skip


def _at_other_station(photo: PhotoEntry, kept: PhotoEntry | None, between: Rigid | None, name: str) -> PhotoEntry:
    if kept is not None and kept.source == photo.source and kept.camera == photo.camera and (kept.picks or kept.poses):
        return replace(
            photo, picks=kept.picks, poses=kept.poses, shown_stage=kept.shown_stage, numbered=kept.numbered,
            stated_pose=kept.stated_pose, stated_by=kept.stated_by,
        )  # fmt: skip
    stated, by = None, ""
    if between is not None and photo.pose is not None and photo.pose.accepted:
        stated, by = _rows(Rigid.from_matrix(photo.pose.camera_from_scanner) @ between), name
    return replace(photo, picks=(), poses=(), shown_stage=None, stated_pose=stated, stated_by=by)


def _seen_from(rough: Rows | None, between: Rigid | None) -> Rows | None:
    if rough is None or between is None:
        return None
    return _rows(between.inverse @ Rigid.from_matrix(rough))


def _rows(pose: Rigid) -> Rows:
    return tuple(tuple(float(value) for value in row) for row in pose.matrix)


def _key(source: Source) -> tuple[str, int]:
    """Return what a scan is, whether or not it gets further clouds."""
    return source.path, source.index
