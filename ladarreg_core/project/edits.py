"""Edits of documents: functions that take a document or photograph and return a changed copy."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick, unit_rays
from ladarreg_core.project.document import STAGES, CameraGiven, Document, Part, PhotoEntry, PickEntry, PoseEntry, Rows
from ladarreg_core.project.drawn import LineEntry
from ladarreg_core.project.source import Source, file_name
from ladarreg_core.results.registration import StageId

MAX_PHOTOS = 200
MAX_PICKS = 5000
MAX_PIXEL = 1e6
"""Largest absolute pixel coordinate of a match."""
_LONGEST_LINE_RAD = math.radians(150)
_FARTHEST_M = 1e5
WEIGHTS = 1e-6, 1e6
"""Smallest and largest weight of a match."""


def with_scan(document: Document, scan: Source) -> Document:
    """Return the document with another scan, without the picks, poses and measurements that belong to the old one.

    Photographs that are matched with a station keep theirs, and what was measured on its scan stays.
    """
    taken = {(path, scan.index) for path in scan.paths}
    others = (s for s in document.stations if (s.source.path, s.source.index) not in taken)
    stations = tuple(replace(station, rough=None) for station in others)  # rough places were seen from the old one
    left = {station.id for station in stations}

    def kept(photo: PhotoEntry) -> PhotoEntry:
        elsewhere = tuple(work for work in photo.elsewhere if work.station in left)
        if photo.station in left:
            return replace(photo, elsewhere=elsewhere)
        nothing: dict[str, Any] = {"picks": (), "poses": (), "shown_stage": None, "stated_pose": None, "stated_by": ""}
        return replace(photo, station="", station_given=False, elsewhere=elsewhere, **nothing)

    photos = tuple(map(kept, document.photos))
    measurements = tuple(each for each in document.measurements if each.station in left)
    return replace(document, scan=scan, photos=photos, stations=stations, measurements=measurements)


def with_more_clouds(document: Document, paths: Sequence[str], names: Sequence[str] = ()) -> Document:
    """Return the document with further clouds accumulated to its scan; what was drawn and solved stays.

    Picks are rays of the scanner, which the grid that is made anew does not change. Ranges that were replaced are those
    of cells, and are measured again.

    Args:
        document: the document.
        paths: files of the scan's standpoint, as in `Source.path`.
        names: their names for display; empty: the names of the files.

    Raises:
        OptionError: if there is no scan, or a file is part of it already, or a further station.
    """
    if document.scan is None:
        raise OptionError("clouds are accumulated with a scan; open the scan first")
    named = dict(zip(paths, names or map(file_name, paths), strict=True))
    files = (*document.scan.paths, *paths)
    twice = next((path for k, path in enumerate(files) if path in files[:k]), None)
    if twice is not None:
        raise OptionError(f"{named[twice]} is part of the scan already; give clouds that are not")
    elsewhere = next((path for each in document.stations for path in each.source.paths if path in named), None)
    if elsewhere is not None:
        raise OptionError(f"{named[elsewhere]} is a station of the project; remove the station, or leave the cloud out")
    every = (*document.scan.names[1:], *named.values())
    return replace(document, scan=replace(document.scan, more=files[1:], more_names=every, smoothings=()))


def with_photo(
    document: Document, source: Source, camera: CameraGiven | None = None, *, stated_pose: Rows | None = None
) -> tuple[Document, str]:
    """Return the document with an additional photograph, and its id.

    Raises:
        OptionError: if there are too many photographs.
    """
    if len(document.photos) >= MAX_PHOTOS:
        raise OptionError(
            f"the project has {MAX_PHOTOS} photographs, which is the maximum; remove one, or start another project"
        )
    number = document.numbered + 1
    photo = PhotoEntry(id=f"p{number}", source=source, camera=camera or CameraGiven(), stated_pose=stated_pose)
    return replace(document, photos=(*document.photos, photo), numbered=number), photo.id


def without_photo(document: Document, photo_id: str) -> Document:
    """Return the document without a photograph, and without the ties and lines that were drawn in it."""
    require_photo(document, photo_id)
    return replace(
        document,
        photos=tuple(p for p in document.photos if p.id != photo_id),
        ties=tuple(tie for tie in document.ties if photo_id not in tie.photos),
        lines=tuple(left for line in document.lines if (left := _without(line, photo_id)) is not None),
    )


def _without(line: LineEntry, photo_id: str) -> LineEntry | None:
    """Return a line without what was drawn in a photograph; None: nothing is left."""
    if photo_id not in line.photos:
        return line
    left = [(photo, uv) for photo, uv in zip(line.photos, line.uv, strict=True) if photo != photo_id]
    if not left and line.in_scan is None:
        return None
    return replace(line, photos=tuple(one for one, _ in left), uv=tuple(uv for _, uv in left))


def require_photo(document: Document, photo_id: object) -> PhotoEntry:
    """Return a photograph by its id.

    Raises:
        OptionError: if there is none.
    """
    found = document.photo(photo_id) if isinstance(photo_id, str) else None
    if found is None:
        raise OptionError("the photograph is no longer in the project; choose another")
    return found


def edited_photo(document: Document, photo_id: str, edit: Callable[[PhotoEntry], PhotoEntry]) -> Document:
    """Return the document with one photograph edited."""
    new = edit(require_photo(document, photo_id))
    return replace(document, photos=tuple(new if p.id == photo_id else p for p in document.photos))


def with_camera(photo: PhotoEntry, camera: CameraGiven) -> PhotoEntry:
    """Return the photograph with another camera, without the poses found with the old one."""
    elsewhere = tuple(replace(work, poses=(), shown_stage=None) for work in photo.elsewhere)
    return replace(photo, camera=camera, poses=(), shown_stage=None, camera_held=None, elsewhere=elsewhere)


def with_part(document: Document, photo_ids: Iterable[str], part: Part) -> Document:
    """Return the document with photographs that take part in adjustments in another way.

    Raises:
        OptionError: if one is not in the project, or is to be held but has no accepted pose.
    """
    ids = frozenset(photo_ids)
    for photo in [require_photo(document, each) for each in sorted(ids)]:
        if part == "held" and not (photo.pose and photo.pose.accepted):
            raise OptionError(f"{photo.source.name} has no accepted pose that could be held; register it first")
    return replace(document, photos=tuple(replace(p, part=part) if p.id in ids else p for p in document.photos))


def with_camera_held(document: Document, camera_id: str, *, held: bool) -> Document:
    """Return the document with a camera whose intrinsics the next adjustments keep as the last one left them, or not.

    Args:
        document: the document.
        camera_id: id of a camera of the last adjustment.
        held: whether they are kept.

    Raises:
        OptionError: if the last adjustment has no such camera.
    """
    adjusted = document.adjusted
    camera = None if adjusted is None else adjusted.cameras.get(camera_id)
    if adjusted is None or camera is None:
        raise OptionError("that camera is not one of the last adjustment; adjust again")
    takers = {name for name, photo in adjusted.photos.items() if photo.camera == camera_id}
    kept = camera.camera if held else None
    return replace(
        document, photos=tuple(replace(p, camera_held=kept) if p.id in takers else p for p in document.photos)
    )


def with_picks(photo: PhotoEntry, picks: Iterable[Pick]) -> tuple[PhotoEntry, tuple[str, ...]]:
    """Return the photograph with additional picks, and their new ids.

    Raises:
        OptionError: if there would be too many, or a pixel or weight is out of range.
    """
    new: list[PickEntry] = []
    number = photo.numbered
    for pick in picks:
        number += 1
        new.append(
            PickEntry(
                id=str(number),
                number=number,
                kind=pick.kind,
                scan=rays(pick.scan.tolist()),
                photo=pixels(pick.photo.tolist()),
                on=bool(pick.on),
                weight=weight(pick.weight),
                origin=pick.origin,
                lengths_m=None if pick.lengths_m is None else tuple(pick.lengths_m.tolist()),
                name=pick.name,
            )
        )
    if len(photo.picks) + len(new) > MAX_PICKS:
        raise OptionError(f"the photograph would have more than {MAX_PICKS:,} matches; remove some first")
    return replace(photo, picks=(*photo.picks, *new), numbered=number), tuple(pick.id for pick in new)


def without_picks(photo: PhotoEntry, ids: Collection[str]) -> PhotoEntry:
    """Return the photograph without some picks."""
    return replace(photo, picks=tuple(p for p in photo.picks if p.id not in ids))


def without_origin(photo: PhotoEntry, origins: Collection[str]) -> PhotoEntry:
    """Return the photograph without the picks of some origins."""
    return replace(photo, picks=tuple(p for p in photo.picks if p.origin not in origins))


def switched(photo: PhotoEntry, on: Mapping[str, bool]) -> PhotoEntry:
    """Return the photograph with picks switched on or off, by id."""
    return replace(
        photo,
        picks=tuple(
            replace(p, on=on[p.id]) if p.id in on and on[p.id] != p.on else p  # unchanged picks stay the same objects
            for p in photo.picks
        ),
    )


def changed_pick(photo: PhotoEntry, pick_id: str, fields: Mapping[str, Any]) -> PhotoEntry:
    """Return the photograph with one pick changed.

    Raises:
        OptionError: if there is no such pick, or a new pixel or weight is out of range.
        ShapeError: if the changed pick is invalid.
    """
    old = photo.pick(pick_id)
    if old is None:
        raise OptionError("the match no longer exists: it was removed")
    new = replace(old, **fields)
    sound = new.as_pick()
    new = replace(
        new,
        scan=rays(sound.scan.tolist()) if "scan" in fields else old.scan,
        photo=pixels(new.photo) if "photo" in fields else old.photo,
        weight=weight(new.weight) if "weight" in fields else old.weight,
        # a length is of the point that was measured, not of where the match has been moved
        lengths_m=None
        if "scan" in fields and not np.allclose(sound.scan, old.scan, rtol=0, atol=1e-9)
        else old.lengths_m,
    )
    return replace(photo, picks=tuple(new if p.id == pick_id else p for p in photo.picks))


def without_work(photo: PhotoEntry) -> PhotoEntry:
    """Return the photograph without picks and poses."""
    return replace(photo, picks=(), poses=(), shown_stage=None)


def with_pose(photo: PhotoEntry, pose: PoseEntry, *, shown: bool = True) -> PhotoEntry:
    """Return the photograph with the result of a stage, which replaces the stage's previous result."""
    poses = [*(p for p in photo.poses if p.stage != pose.stage), pose]
    poses.sort(key=lambda p: STAGES.index(p.stage))
    return replace(photo, poses=tuple(poses), shown_stage=pose.stage if shown else photo.shown_stage)


def without_stage(photo: PhotoEntry, stage: StageId) -> PhotoEntry:
    """Return the photograph without the result of a stage; the current pose is then none, if it was that one's."""
    poses = tuple(pose for pose in photo.poses if pose.stage != stage)
    return replace(photo, poses=poses, shown_stage=None if photo.shown_stage == stage else photo.shown_stage)


def with_stage(photo: PhotoEntry, stage: object) -> PhotoEntry:
    """Return the photograph with the result of another stage as its current pose.

    Raises:
        OptionError: if that stage has no result.
    """
    found = photo.stage(stage) if isinstance(stage, str) else None
    if found is None:
        raise OptionError("that stage has no pose yet; solve first")
    return replace(photo, shown_stage=found.stage)


def rows(values: object, columns: int) -> Rows:
    """Return rows of finite numbers.

    Raises:
        OptionError: if they are not one or two rows of that many finite numbers.
    """
    if not isinstance(values, Sequence) or isinstance(values, str | bytes) or not 1 <= len(values) <= 2:
        raise OptionError("a point needs one coordinate in each image, a line two")
    found = []
    for row in values:
        sound = isinstance(row, Sequence) and not isinstance(row, str | bytes) and len(row) == columns
        if not sound or any(finite(value) is None for value in row):
            raise OptionError(f"a coordinate is not a list of {columns} finite numbers")
        found.append(tuple(float(value) for value in row))
    return tuple(found)


def rays(values: object) -> Rows:
    """Return one or two unit rays from vectors of any length.

    Raises:
        OptionError: if they are not rows of three finite numbers, one has zero length, or two are more than 150
            degrees apart.
    """
    vectors = np.array(rows(values, 3))
    if not vectors.any(axis=-1).all():
        raise OptionError("a ray has zero length; a ray is a direction [x, y, z]")
    found = unit_rays(vectors)
    if len(found) == 2 and float(found[0] @ found[1]) < math.cos(_LONGEST_LINE_RAD):
        longest = math.degrees(_LONGEST_LINE_RAD)
        raise OptionError(f"a line's ends are more than {longest:.0f} degrees apart; draw a shorter line")
    return rows(found.tolist(), 3)


def pose(values: object) -> Rigid:
    """Return a pose from the rows of its matrix (4, 4).

    Raises:
        OptionError: if it is not a rigid transform, or its camera is absurdly far away.
    """
    try:
        found = Rigid.from_matrix(np.array(values, dtype=np.float64))
    except (LadarregError, TypeError, ValueError, OverflowError):
        raise OptionError("a pose is the 4 rows of a rigid transform, camera_from_scanner") from None
    if float(np.abs(found.centre).max()) > _FARTHEST_M:
        raise OptionError(f"the camera is more than {_FARTHEST_M:.0f} m from the scanner; give a pose near the scene")
    return found


def pixels(values: object) -> Rows:
    """Return one or two pixels.

    Raises:
        OptionError: if they are not rows of two finite numbers, or lie too far outside any image.
    """
    found = rows(values, 2)
    if any(abs(value) > MAX_PIXEL for row in found for value in row):
        raise OptionError(
            f"a pixel lies more than {MAX_PIXEL:,.0f} px from the image's corner, beyond the size of any image"
        )
    return found


def weight(value: object) -> float:
    """Return the weight of a match.

    Raises:
        OptionError: if it is not a number within `WEIGHTS`.
    """
    least, most = WEIGHTS
    found = finite(value)
    if found is None or not least <= found <= most:
        shown = "not a number" if found is None else f"{found:g}"
        raise OptionError(
            f"the weight of a match is {shown}; it must be a positive number from {least:.6f} to {most:,.0f}"
        )
    return found


def finite(value: object) -> float | None:
    """Return a number as a finite float; None for anything else, including booleans and integers beyond 1.8e308."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        found = float(value)
    except OverflowError:
        return None
    return found if math.isfinite(found) else None
