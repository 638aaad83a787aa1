"""Edits of a scan's ranges: those that a registration contradicts are replaced, and can be restored."""

from __future__ import annotations

from hashlib import blake2b
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document, PoseEntry
from ladarreg_core.project.edits import edited_photo, require_photo, with_pose
from ladarreg_core.project.source import SmoothingEntry, Source
from ladarreg_core.project.station_edits import partner_of, pose_beside, with_partner_scan

if TYPE_CHECKING:
    from ladarreg_core.quality.smoothing import Replacements, SmoothedScan
    from ladarreg_core.scan import Scan


def require_registered(document: Document, photo_id: str) -> PoseEntry:
    """Return the accepted pose of a photograph, by which ranges of the scan that it is matched with can be smoothed.

    Raises:
        OptionError: if there is no scan, photograph or accepted pose.
    """
    photo = require_photo(document, photo_id)
    pose = photo.pose
    if document.scan is None:
        raise OptionError("there is no scan; open one")
    if pose is None or not pose.accepted:
        raise OptionError("ranges are smoothed by an accepted pose; register the photograph first")
    return pose


def with_smoothing(document: Document, photo_id: str, replacements: Replacements) -> Document:
    """Return the document with ranges of a scan replaced, by what the accepted pose of a photograph beside it says of
    them.

    That pose stays current: it is what the new ranges rest on. All else that was solved on the former ones does not.

    Args:
        document: the document.
        photo_id: the photograph.
        replacements: the ranges, of the scan that the photograph is matched with, as the document has it.

    Raises:
        OptionError: if there is nothing to replace, or no scan, photograph or accepted pose.
    """
    pose = require_registered(document, photo_id)
    photo = require_photo(document, photo_id)
    scan = partner_of(document, photo.station)
    assert scan is not None, "it was required"
    if not len(replacements):
        raise OptionError(
            "no range would be replaced; choose those at depth edges, too, or leave the ranges as they are"
        )
    cells = tuple(
        (int(row), int(column), float(range_m))
        for (row, column), range_m in zip(replacements.cells.tolist(), replacements.ranges.tolist(), strict=True)
    )
    made_of = msgspec.json.encode([scan.ranges, photo_id, pose.name, cells])
    made = SmoothingEntry(
        id=blake2b(made_of, digest_size=8).hexdigest(), photo=photo_id, name=photo.source.name, pose=pose.name,
        cells=cells,
    )  # fmt: skip
    smoothed = replace(scan, smoothings=(*scan.smoothings, made))
    found = with_partner_scan(document, photo.station, smoothed)
    return edited_photo(found, photo_id, lambda photo: with_pose(photo, replace(pose, ranges=made.id)))


def without_smoothings(document: Document, station_id: str = "") -> Document:
    """Return the document with the ranges of a scan as they were measured; poses solved on others are out of date.

    Args:
        document: the document.
        station_id: id of the station whose scan it is; empty: the project's scan.

    Raises:
        OptionError: if none was replaced, or there is no such station.
    """
    scan = partner_of(document, station_id)
    if scan is None or not scan.smoothings:
        raise OptionError("the ranges of the scan are as measured: there is nothing to restore")
    return with_partner_scan(document, station_id, replace(scan, smoothings=()))


def with_smoothings(scan: Scan, source: Source) -> Scan:
    """Return a scan as its file has it with the ranges that were smoothed.

    Args:
        scan: the scan, (H, W) cells.
        source: its entry in the document.

    Raises:
        ShapeError: if the file has fewer cells than it had when they were.
    """
    from ladarreg_core.quality.smoothing import with_ranges

    for one in source.smoothings:
        table = np.array(one.cells, dtype=np.float64).reshape(-1, 3)
        scan = with_ranges(scan, table[:, :2].astype(np.intp), table[:, 2])
    return scan


def smoothed_scan(scan: Scan, document: Document, station_id: str = "") -> SmoothedScan | None:
    """Return what was replaced in the ranges of a scan, for its results; None: nothing.

    Args:
        scan: the scan as `with_smoothings` returns it.
        document: the document.
        station_id: id of the station whose scan it is; empty: the project's scan.
    """
    from ladarreg_core.quality.smoothing import SmoothedScan

    count = replaced_count(partner_of(document, station_id))
    return SmoothedScan(scan, count, smoothing_sentence(document, station_id)) if count else None


def smoothing_sentence(document: Document, station_id: str = "") -> str:
    """Return what was replaced in the ranges of a station's scan, and by whose poses; empty: nothing."""
    source = partner_of(document, station_id)
    count = replaced_count(source)
    if source is None or not count:
        return ""
    names = ", ".join(dict.fromkeys(one.name for one in source.smoothings))
    fault = smoothing_fault(document, station_id)
    of = f" of {source.name}" if station_id else ""
    what, were = ("range", "was") if count == 1 else ("ranges", "were")
    said = f"{count} {what}{of} {were} replaced by stereo with {names}"
    return f"{said}; out of date: {fault}." if fault else f"{said}."


def replaced_count(source: Source | None) -> int:
    """Return how many cells of a scan have a range that is not as measured."""
    return 0 if source is None else len({cell[:2] for one in source.smoothings for cell in one.cells})


def smoothing_fault(document: Document, station_id: str = "") -> str:
    """Return why the smoothed ranges of a station's scan are out of date, without a full stop; empty if they are not.

    They are once the pose that one of the smoothings rests on is no longer the current one of its photograph beside
    that scan.
    """
    source = partner_of(document, station_id)
    for one in () if source is None else source.smoothings:
        photo = document.photo(one.photo)
        if photo is None:
            return f"{one.name}, by which ranges were replaced, is no longer in the project"
        pose = pose_beside(photo, station_id)
        if pose is None or not pose.accepted or pose.name != one.pose:
            return f"the pose of {one.name}, by which ranges were replaced, has changed since"
    return ""
