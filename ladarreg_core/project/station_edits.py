"""Edits of a document's stations: scans of one place from elsewhere, with one of which each photograph is matched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.project.carried import carried_pose
from ladarreg_core.project.document import (
    Document,
    PhotoEntry,
    PoseEntry,
    Rows,
    StationEntry,
    StationWork,
    Survey,
)
from ladarreg_core.project.edits import finite, require_photo
from ladarreg_core.project.source import Source

MAX_STATIONS = 12
"""Most stations of a project besides the scan that is shown: every pair of them is compared."""
_FARTHEST_M = 10_000.0
_WORK = ("picks", "numbered", "poses", "shown_stage", "stated_pose", "stated_by")
"""What belongs to a photograph beside one scan."""


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
    """Return the document without a station; photographs that are matched with it return to the project's scan, and
    what was measured on its scan goes with it.
    """
    gone = require_station(document, station_id)
    for photo in document.photos:
        if photo.station == gone.id:
            document = with_partner(document, photo.id, "", given=False)
    photos = tuple(
        replace(photo, elsewhere=tuple(work for work in photo.elsewhere if work.station != gone.id))
        if photo.elsewhere else photo for photo in document.photos
    )  # fmt: skip
    return replace(
        document, photos=photos, stations=tuple(each for each in document.stations if each is not gone),
        measurements=tuple(each for each in document.measurements if each.station != gone.id),
    )  # fmt: skip


def with_partner_scan(document: Document, station_id: str, scan: Source) -> Document:
    """Return the document with another state of a station's scan; with an empty id of the project's.

    Raises:
        OptionError: if there is no such station.
    """
    if not station_id:
        return replace(document, scan=scan)
    chosen = require_station(document, station_id)
    stations = tuple(replace(each, source=scan) if each is chosen else each for each in document.stations)
    return replace(document, stations=stations)


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


def known_place(document: Document, station_id: str) -> Rigid | None:
    """Return `scan_from_station` of a station in the frame of the project's scan, as it was adjusted or registered.

    Args:
        document: the document.
        station_id: id of the station; empty: the project's scan itself.

    Returns:
        The pose; None where none was found: a rough place does not count.
    """
    if not station_id:
        return Rigid.identity()
    return place_of(document, replace(require_station(document, station_id), rough=None))


def partner_of(document: Document, station_id: str) -> Source | None:
    """Return the scan of a station; with an empty id that of the project; None if the project has none.

    Raises:
        OptionError: if there is no such station.
    """
    return require_station(document, station_id).source if station_id else document.scan


def with_partner(document: Document, photo_id: object, station_id: str, *, given: bool) -> Document:
    """Return the document with a photograph beside the scan of another station, with which it is matched from now on.

    What was done on it beside the former scan is kept with it, and returns with that. Where nothing was done beside the
    new one, a pose that is known is carried over: one that everything together determines stays accepted, any other
    is where a search begins.

    Args:
        document: the document.
        photo_id: id of the photograph.
        station_id: id of the station; empty: the scan of the project.
        given: whether the operator chose it.

    Raises:
        OptionError: if there is no such photograph or station, or the photograph is held in its pose.
    """
    photo = require_photo(document, photo_id)
    partner_of(document, station_id)
    if photo.part == "held" and photo.station != station_id:
        raise OptionError(f"{photo.source.name} is held in its pose beside its station; let it take part freely first")
    if photo.station == station_id:
        new = photo if photo.station_given == given else replace(photo, station_given=given)
    else:
        new = replace(_beside(document, photo, station_id), station_given=given)
    return replace(document, photos=tuple(new if each is photo else each for each in document.photos))


def may_choose_partner(photo: PhotoEntry) -> bool:
    """Return whether another station may be chosen for a photograph unasked: nothing was done beside the present one.

    A pose that everything together determines holds beside all of them.
    """
    pose = photo.pose
    found_here = pose is not None and pose.accepted and pose.stage != "survey"
    return not (photo.station_given or photo.picks or found_here or photo.part == "held")


def seen_from_scan(document: Document, photo: PhotoEntry, station_id: str = "") -> PhotoEntry:
    """Return a photograph as it is beside a station's scan: where it is matched with another one, its pose is carried
    over, without matches; it has none where it is not known how the two scans stand to each other.

    Args:
        document: the document.
        photo: the photograph.
        station_id: id of the station; empty: the project's scan.

    Raises:
        OptionError: if there is no such station.
    """
    if photo.station == station_id:
        return photo
    between, pose = place_between(document, photo.station, station_id), photo.pose
    source = partner_of(document, station_id)
    assert source is not None, "stations are added to a scan"
    found: dict[str, Any] = {"poses": (), "shown_stage": None}
    if between is not None and pose is not None:
        sigma_m, sigma_rad = place_sigmas(document, photo.station, station_id)
        carried = carried_pose(pose, between, source, sigma_m=sigma_m, sigma_rad=sigma_rad)
        found = {"poses": (carried,), "shown_stage": pose.stage}
    return replace(photo, station="", elsewhere=(), picks=(), stated_pose=None, stated_by="", **found)


def place_between(document: Document, one: str, other: str) -> Rigid | None:
    """Return `one_from_other` of two stations by their ids, empty: the project's scan; None where it is not known."""
    first, second = known_place(document, one), known_place(document, other)
    return None if first is None or second is None else first.inverse @ second


def pose_beside(photo: PhotoEntry, station_id: str) -> PoseEntry | None:
    """Return the current pose of a photograph beside a station's scan, with which it need not be matched now."""
    if photo.station == station_id:
        return photo.pose
    kept = next((work for work in photo.elsewhere if work.station == station_id), None)
    return None if kept is None else next((pose for pose in kept.poses if pose.stage == kept.shown_stage), None)


def with_station_shown(document: Document, station_id: object) -> Document:
    """Return the document with another station's scan as the project's, to whose frame it refers from now on.

    The former one becomes a station. Photographs beside it come to be beside the new one, see `with_partner`; those
    that are matched with other stations stay with them, and measurements with the scans that they were made on.
    """
    chosen = require_station(document, station_id)
    assert document.scan is not None, "stations are added to a scan"
    between = place_of(document, chosen)
    number = document.numbered_stations + 1
    renamed = {"": f"s{number}", chosen.id: ""}
    photos = tuple(
        _renamed(photo if photo.station else _beside(document, photo, chosen.id), renamed) for photo in document.photos
    )
    rough = None if between is None else _rows(between.inverse)
    before = StationEntry(id=f"s{number}", source=document.scan, rough=rough)
    measurements = tuple(
        replace(each, station=renamed.get(each.station, each.station)) for each in document.measurements
    )
    stations = tuple(
        before if each is chosen else replace(each, rough=_seen_from(each.rough, between)) for each in document.stations
    )
    return replace(
        document, scan=chosen.source, photos=photos, stations=stations, numbered_stations=number,
        measurements=measurements,
    )  # fmt: skip


def _renamed(photo: PhotoEntry, names: Mapping[str, str]) -> PhotoEntry:
    elsewhere = tuple(replace(work, station=names.get(work.station, work.station)) for work in photo.elsewhere)
    return replace(photo, station=names.get(photo.station, photo.station), elsewhere=elsewhere)


def _beside(document: Document, photo: PhotoEntry, station_id: str) -> PhotoEntry:
    """Return a photograph beside another scan than it is."""
    kept = next((work for work in photo.elsewhere if work.station == station_id), None)
    others = tuple(work for work in photo.elsewhere if work.station != station_id)
    left = StationWork(station=photo.station, **{name: getattr(photo, name) for name in _WORK})
    elsewhere = (*others, left) if left.picks or left.poses or left.stated_pose is not None else others
    new = replace(photo, station=station_id, elsewhere=elsewhere)
    found: PhotoEntry | StationWork | None = kept or _kept_by_station(document, photo, station_id)
    if found is not None and (found.picks or found.poses):
        return replace(new, **{name: getattr(found, name) for name in _WORK})
    return replace(new, picks=(), **_carried(document, photo, station_id))


def _kept_by_station(document: Document, photo: PhotoEntry, station_id: str) -> PhotoEntry | None:
    """Return a photograph as an earlier version of the program kept it with a station."""
    if not station_id:
        return None
    kept = next((each for each in require_station(document, station_id).photos if each.id == photo.id), None)
    same = kept is not None and kept.source == photo.source and kept.camera == photo.camera
    return kept if same else None


def _carried(document: Document, photo: PhotoEntry, station_id: str) -> dict[str, Any]:
    """Return the pose of a photograph as it is known beside another scan, as fields of its entry."""
    found: dict[str, Any] = {"poses": (), "shown_stage": None, "stated_pose": None, "stated_by": ""}
    from_new = place_between(document, photo.station, station_id)
    source, pose = partner_of(document, station_id), photo.pose
    former = partner_of(document, photo.station)
    if from_new is None or source is None or former is None:
        return found
    if pose is not None and pose.accepted:
        found |= {
            "stated_pose": _rows(Rigid.from_matrix(np.array(pose.camera_from_scanner)) @ from_new),
            "stated_by": former.name,
        }
        if pose.stage == "survey":
            sigma_m, sigma_rad = place_sigmas(document, photo.station, station_id)
            carried = carried_pose(pose, from_new, source, sigma_m=sigma_m, sigma_rad=sigma_rad)
            found |= {"poses": (carried,), "shown_stage": "survey"}
    elif photo.stated_pose is not None:
        found |= {
            "stated_pose": _rows(Rigid.from_matrix(np.array(photo.stated_pose)) @ from_new),
            "stated_by": photo.stated_by or former.name,
        }
    return found


def place_sigmas(document: Document, one: str, other: str) -> tuple[float, float]:
    """Return how well the places of two stations' scans are known together, m and rad, of all axes together.

    Those of the scan that the others were registered to are exact.
    """
    total = np.zeros(2)
    for source in (partner_of(document, one), partner_of(document, other)):
        adjusted = () if document.adjusted is None or source is None else document.adjusted.scans
        found = next((each for each in adjusted if source is not None and _key(each.source) == _key(source)), None)
        stated = stated_station(document.survey, source)
        if found is not None and found.world_from_scanner is not None:
            sigmas = [found.sigma_m or 0.0, found.sigma_rad or 0.0]
        elif stated is not None and stated["sigma_mm"] is not None and stated["sigma_deg"] is not None:
            mm, deg = (np.array([0 if each is None else each for each in stated[n]]) for n in ("sigma_mm", "sigma_deg"))
            sigmas = [float(np.linalg.norm(mm)) / 1000, float(np.radians(np.linalg.norm(deg)))]
        else:
            sigmas = [0.0, 0.0]
        total += np.square(sigmas)
    sigma_m, sigma_rad = np.sqrt(total).tolist()
    return sigma_m, sigma_rad


def _seen_from(rough: Rows | None, between: Rigid | None) -> Rows | None:
    if rough is None or between is None:
        return None
    return _rows(between.inverse @ Rigid.from_matrix(rough))


def _rows(pose: Rigid) -> Rows:
    return tuple(tuple(float(value) for value in row) for row in pose.matrix)


def _key(source: Source) -> tuple[str, int]:
    """Return what a scan is, whether or not it gets further clouds."""
    return source.path, source.index
