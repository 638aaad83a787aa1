"""What a folder of scans and photographs contains, and what `register` would do with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.batches.photos.photo_list import CameraGroup, camera_groups, folder_contents, photo_entries
from ladarreg_core.errors import FormatError
from ladarreg_core.storage.replacement import display_path


def describe_folder(folder: str | Path) -> dict[str, Any]:
    """Return the scans, photographs and cameras of a folder, JSON-ready.

    Raises:
        FormatError: if it has neither a scan nor a photograph.
        OptionError: if it cannot be listed.
    """
    contents = folder_contents(folder)
    if not contents.scans and not contents.photos:
        raise FormatError(f"{display_path(folder)} contains neither a scan nor a photo; give a file, or another folder")
    entries = photo_entries(contents.photos)
    groups = camera_groups(entries)
    return {
        "folder": display_path(folder),
        "scans": [path.name for path in contents.scans],
        "photos": [entry.path.name for entry in entries if entry.facts is not None],
        "cameras": [
            {"id": group.id, "is": group.words, "photos": len(group.photos), "register": _of_camera(group)}
            for group in groups
        ],
        "unreadable": [entry.fault for entry in entries if entry.facts is None],
        "camera_files": [path.name for path in contents.cameras],
        "register": _of_all(contents.scans, len(entries), groups),
    }


def _of_camera(group: CameraGroup) -> str:
    if group.may_pool:
        return "one focal length, distortion and principal point, pooled over its photos"
    facts = group.photos[0].facts
    if facts is not None and facts.focal_mm is None and facts.film_mm is None:
        return "no focal length in EXIF: needs `camera` or `focal_px`"
    return "estimated by itself"


def _of_all(scans: Sequence[Path], photos: int, groups: Sequence[CameraGroup]) -> str:
    if not photos:
        return "nothing: there is no photo"
    if not scans:
        return f"{photos} photos, on a scan that must be given: there is none here"
    if len(scans) > 1:
        return f"{photos} photos, on the scan that is given, or with all {len(scans)} scans as a survey"
    cameras = "1 camera" if len(groups) == 1 else f"{len(groups)} cameras"
    return f"{photos} photos on {scans[0].name}, each with its verdict; {cameras}; one summary"
