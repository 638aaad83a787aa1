"""Scans of an adjusted survey: they belong to its exports and its model even without a photograph of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.batches.photos.folder import is_batch_folder
from ladarreg_core.batches.photos.photo_summary import read_photos_result
from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.frames import Rigid


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """A scan with its place in the world of a survey."""

    input: Mapping[str, Any]
    """The document of its file, with the options that it was read with."""
    world_from_scanner: Rigid
    """Its pose."""


def placed_scans(folders: Sequence[Path], *, trust_edited: bool = False) -> list[PlacedScan]:
    """Return the scans of adjusted surveys that have a place; other folders have none.

    Adjustments of earlier versions do not state how a scan was read, and of a file with several not which it is: theirs
    are left out.

    Args:
        folders: any folders of results.
        trust_edited: read documents that were changed after they were written.

    Raises:
        FormatError: if a document is damaged.
    """
    found = []
    for folder in folders:
        if not is_batch_folder(folder):
            continue
        for name, fields in read_photos_result(folder, trust_edited=trust_edited).document["scans"].items():
            record = fields.get("input")
            if not fields.get("accepted") or not isinstance(record, dict) or "read_with" not in record:
                continue
            try:
                world = Rigid.from_matrix(np.asarray(fields["world_from_scanner"], np.float64))
            except (LadarregError, KeyError, TypeError, ValueError):
                raise FormatError(f"{folder}: the pose of the scan {name!r:.60} is damaged; adjust again") from None
            found.append(PlacedScan(record, world))
    return found
