"""Edits: each takes a document and returns another."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import OptionError
from ladarreg_core.matches import Pick, unit_rays
from ladarreg_core.project.document import (
    STAGES,
    CameraGiven,
    Document,
    PhotoEntry,
    PickEntry,
    PoseEntry,
    Rows,
    Source,
)

MOST_PHOTOS = 32
MOST_PICKS = 5000
MOST_PIXEL = 1e6
"""A pixel of a match lies no farther than this from the picture's corner, along each side."""
_LONGEST_LINE_RAD = math.radians(150)
WEIGHTS = 1e-6, 1e6
"""The least and the greatest weight of a match."""


def with_scan(document: Document, scan: Source) -> Document:
    """Return the document of another scan; what was drawn and found on the old one is gone from it."""
    photos = tuple(replace(p, picks=(), poses=(), shown_stage=None) for p in document.photos)
    return replace(document, scan=scan, photos=photos)


def with_photo(document: Document, source: Source, camera: CameraGiven | None = None) -> tuple[Document, str]:
    """Return the document with one photograph more, and its id.

    Raises:
        OptionError: if there are too many.
    """
    if len(document.photos) >= MOST_PHOTOS:
        raise OptionError(f"the project has {MOST_PHOTOS} photographs, which is the most; remove one, or begin another")
    number = document.numbered + 1
    photo = PhotoEntry(id=f"p{number}", source=source, camera=camera or CameraGiven())
    return replace(document, photos=(*document.photos, photo), numbered=number), photo.id


def without_photo(document: Document, photo_id: str) -> Document:
    """Return the document without a photograph."""
    the_photo(document, photo_id)
    return replace(document, photos=tuple(p for p in document.photos if p.id != photo_id))


def the_photo(document: Document, photo_id: object) -> PhotoEntry:
    """Return a photograph.

    Raises:
        OptionError: if there is none of that id.
    """
    found = document.photo(photo_id) if isinstance(photo_id, str) else None
    if found is None:
        raise OptionError("the photograph is not in the project any more; choose another")
    return found


def edited_photo(document: Document, photo_id: str, edit: Callable[[PhotoEntry], PhotoEntry]) -> Document:
    """Return the document with one photograph edited."""
    new = edit(the_photo(document, photo_id))
    return replace(document, photos=tuple(new if p.id == photo_id else p for p in document.photos))


def with_camera(photo: PhotoEntry, camera: CameraGiven) -> PhotoEntry:
    """Return the photograph with another camera; poses of the old one are gone."""
    return replace(photo, camera=camera, poses=(), shown_stage=None)


def with_picks(photo: PhotoEntry, picks: Iterable[Pick]) -> tuple[PhotoEntry, tuple[str, ...]]:
    """Return the photograph with picks more, under ids of its own, and these.

    Raises:
        OptionError: if there would be too many, or one has a pixel or a weight beyond all bounds.
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
            )
        )
    if len(photo.picks) + len(new) > MOST_PICKS:
        raise OptionError(f"the photograph would have more than {MOST_PICKS:,} matches; remove some first")
    return replace(photo, picks=(*photo.picks, *new), numbered=number), tuple(pick.id for pick in new)


def without_picks(photo: PhotoEntry, ids: Collection[str]) -> PhotoEntry:
    """Return the photograph without some picks."""
    return replace(photo, picks=tuple(p for p in photo.picks if p.id not in ids))


def without_origin(photo: PhotoEntry, origins: Collection[str]) -> PhotoEntry:
    """Return the photograph without what some detectors put down."""
    return replace(photo, picks=tuple(p for p in photo.picks if p.origin not in origins))


def switched(photo: PhotoEntry, on: Mapping[str, bool]) -> PhotoEntry:
    """Return the photograph with picks switched on or off, by id."""
    return replace(
        photo,
        picks=tuple(
            replace(p, on=on[p.id]) if p.id in on and on[p.id] != p.on else p  # the same object where nothing changed
            for p in photo.picks
        ),
    )


def changed_pick(photo: PhotoEntry, pick_id: str, fields: Mapping[str, Any]) -> PhotoEntry:
    """Return the photograph with one pick changed.

    Raises:
        OptionError: if there is no such pick.
        OptionError: if a new pixel or weight is beyond all bounds.
        ShapeError: if it would be no sound pick.
    """
    old = photo.pick(pick_id)
    if old is None:
        raise OptionError("the match is not there any more: somebody removed it")
    new = replace(old, **fields)
    sound = new.as_pick()
    new = replace(
        new,
        scan=rays(sound.scan.tolist()) if "scan" in fields else old.scan,
        photo=pixels(new.photo) if "photo" in fields else old.photo,
        weight=weight(new.weight) if "weight" in fields else old.weight,
    )
    return replace(photo, picks=tuple(new if p.id == pick_id else p for p in photo.picks))


def without_work(photo: PhotoEntry) -> PhotoEntry:
    """Return the photograph as it was when it was opened."""
    return replace(photo, picks=(), poses=(), shown_stage=None)


def with_pose(photo: PhotoEntry, pose: PoseEntry, *, shown: bool = True) -> PhotoEntry:
    """Return the photograph with a stage's answer, in the place of its last one."""
    poses = [*(p for p in photo.poses if p.stage != pose.stage), pose]
    poses.sort(key=lambda p: STAGES.index(p.stage))
    return replace(photo, poses=tuple(poses), shown_stage=pose.stage if shown else photo.shown_stage)


def with_stage(photo: PhotoEntry, stage: object) -> PhotoEntry:
    """Return the photograph with the answer of another stage as the one that counts.

    Raises:
        OptionError: if that stage has none.
    """
    found = photo.stage(stage) if isinstance(stage, str) else None
    if found is None:
        raise OptionError("that stage has no pose yet; solve first")
    return replace(photo, shown_stage=found.stage)


def rows(values: object, columns: int) -> Rows:
    """Return rows of finite numbers.

    Raises:
        OptionError: if they are none.
    """
    if not isinstance(values, Sequence) or isinstance(values, str | bytes) or not 1 <= len(values) <= 2:
        raise OptionError("a match needs one coordinate on each side, a line two")
    found = []
    for row in values:
        sound = isinstance(row, Sequence) and not isinstance(row, str | bytes) and len(row) == columns
        if not sound or any(finite(value) is None for value in row):
            raise OptionError(f"a coordinate is no list of {columns} numbers")
        found.append(tuple(float(value) for value in row))
    return tuple(found)


def rays(values: object) -> Rows:
    """Return one or two unit rays of vectors of any length.

    Raises:
        OptionError: if they are no rows of three finite numbers, one has no length, or two are more than 150 degrees
            apart.
    """
    vectors = np.array(rows(values, 3))
    if not vectors.any(axis=-1).all():
        raise OptionError("a ray has no length; a ray is a direction [x, y, z]")
    found = unit_rays(vectors)
    if len(found) == 2 and float(found[0] @ found[1]) < math.cos(_LONGEST_LINE_RAD):
        longest = math.degrees(_LONGEST_LINE_RAD)
        raise OptionError(f"a line's ends are more than {longest:.0f} degrees apart; no picture shows such a line")
    return rows(found.tolist(), 3)


def pixels(values: object) -> Rows:
    """Return one or two pixels.

    Raises:
        OptionError: if they are no rows of two finite numbers, or farther away than any picture reaches.
    """
    found = rows(values, 2)
    if any(abs(value) > MOST_PIXEL for row in found for value in row):
        raise OptionError(
            f"a pixel lies more than {MOST_PIXEL:,.0f} px from the picture's corner; no picture is so large"
        )
    return found


def weight(value: object) -> float:
    """Return the weight of a match.

    Raises:
        OptionError: if it is no number within `WEIGHTS`.
    """
    least, most = WEIGHTS
    found = finite(value)
    if found is None or not least <= found <= most:
        shown = "no number" if found is None else f"{found:g}"
        raise OptionError(
            f"the weight of a match is {shown}; it must be a positive number from {least:.6f} to {most:,.0f}"
        )
    return found


def finite(value: object) -> float | None:
    """Return a number as a finite float; None for anything else, a switch or an integer beyond 1.8e308 among it."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        found = float(value)
    except OverflowError:
        return None
    return found if math.isfinite(found) else None
