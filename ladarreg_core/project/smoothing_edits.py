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

if TYPE_CHECKING:
    from ladarreg_core.quality.smoothing import Replacements, SmoothedScan
    from ladarreg_core.scan import Scan


def require_registered(document: Document, photo_id: str) -> PoseEntry:
    """Return the accepted pose of a photograph, by which ranges can be smoothed.

    Raises:
        OptionError: if there is no scan, photograph or accepted pose.
    """
    photo = require_photo(document, photo_id)
    pose = photo.pose
    if document.scan is None:
        raise OptionError("there is no scan; open one")
    if photo.station:
        raise OptionError(
            f"{photo.source.name} is matched with another station; ranges are replaced in {document.scan.name}: choose "
            "a photograph beside that scan"
        )
    if pose is None or not pose.accepted:
        raise OptionError("ranges are smoothed by an accepted pose; register the photograph first")
    return pose


def with_smoothing(document: Document, photo_id: str, replacements: Replacements) -> Document:
    """Return the document with ranges of its scan replaced, by what a photograph's accepted pose says of them.

    That pose stays current: it is what the new ranges rest on. All else that was solved on the former ones does not.

    Args:
        document: the document.
        photo_id: the photograph.
        replacements: the ranges, of the scan as the document has it.

    Raises:
        OptionError: if there is nothing to replace, or no scan, photograph or accepted pose.
    """
    pose = require_registered(document, photo_id)
    assert document.scan is not None, "it was required"
    if not len(replacements):
        raise OptionError(
            "no range would be replaced; choose those at depth edges, too, or leave the ranges as they are"
        )
    cells = tuple(
        (int(row), int(column), float(range_m))
        for (row, column), range_m in zip(replacements.cells.tolist(), replacements.ranges.tolist(), strict=True)
    )
    name = require_photo(document, photo_id).source.name
    made_of = msgspec.json.encode([document.scan.ranges, photo_id, pose.name, cells])
    made = SmoothingEntry(
        id=blake2b(made_of, digest_size=8).hexdigest(), photo=photo_id, name=name, pose=pose.name, cells=cells
    )
    scan = replace(document.scan, smoothings=(*document.scan.smoothings, made))
    found = replace(document, scan=scan)
    return edited_photo(found, photo_id, lambda photo: with_pose(photo, replace(pose, ranges=made.id)))


def without_smoothings(document: Document) -> Document:
    """Return the document with the ranges of its scan as they were measured; poses solved on others are out of date.

    Raises:
        OptionError: if none was replaced.
    """
    if document.scan is None or not document.scan.smoothings:
        raise OptionError("the ranges of the scan are as measured: there is nothing to restore")
    return replace(document, scan=replace(document.scan, smoothings=()))


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


def smoothed_scan(scan: Scan, document: Document) -> SmoothedScan | None:
    """Return what was replaced in the ranges of a document's scan, for its results; None: nothing.

    Args:
        scan: the scan as `with_smoothings` returns it.
        document: the document.
    """
    from ladarreg_core.quality.smoothing import SmoothedScan

    count = replaced_count(document.scan)
    return SmoothedScan(scan, count, smoothing_sentence(document)) if count else None


def smoothing_sentence(document: Document) -> str:
    """Return what was replaced in the ranges of the scan, and by whose poses; empty: nothing."""
    count = replaced_count(document.scan)
    if document.scan is None or not count:
        return ""
    names = ", ".join(dict.fromkeys(one.name for one in document.scan.smoothings))
    fault = smoothing_fault(document)
    said = f"{count} range{' was' if count == 1 else 's were'} replaced by stereo with {names}"
    return f"{said}; out of date: {fault}." if fault else f"{said}."


def replaced_count(source: Source | None) -> int:
    """Return how many cells of a scan have a range that is not as measured."""
    return 0 if source is None else len({cell[:2] for one in source.smoothings for cell in one.cells})


def smoothing_fault(document: Document) -> str:
    """Return why the smoothed ranges of the scan are out of date, without a full stop; empty if they are not.

    They are once the pose that one of the smoothings rests on is no longer the current one of its photograph.
    """
    for one in () if document.scan is None else document.scan.smoothings:
        photo = document.photo(one.photo)
        if photo is None:
            return f"{one.name}, by which ranges were replaced, is no longer in the project"
        pose = photo.pose
        if pose is None or not pose.accepted or pose.name != one.pose:
            return f"the pose of {one.name}, by which ranges were replaced, has changed since"
    return ""
