"""The photographs of a run: which files of a folder they are, their ids, and which of them one camera took."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.batches.photos.pooled_camera import may_be_turned
from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.export.registered_scan import photo_id
from ladarreg_core.formats import listed_kind
from ladarreg_core.formats.parsing.begun_read import BegunRead
from ladarreg_core.formats.photos.photo_facts import PhotoFacts, header_fields

_GIVEN = ("camera", "focal_px", "focal_mm", "camera_model")


@dataclass(frozen=True, slots=True)
class FolderContents:
    """The files of a folder by their kind, in the order of their names."""

    scans: tuple[Path, ...]
    photos: tuple[Path, ...]
    cameras: tuple[Path, ...]
    """Camera files; none is used unless it is given."""


@dataclass(frozen=True, slots=True)
class PhotoEntry:
    """A photograph of a run."""

    id: str
    """Unique in the run, and name of its folder."""
    path: Path
    """Its file."""
    facts: PhotoFacts | None
    """What its header says; None: it cannot be read."""
    fault: str = ""
    """Why it cannot be read."""


@dataclass(frozen=True, slots=True)
class CameraGroup:
    """Photographs that one camera took: of one body, lens, focal length and size, as their EXIF says."""

    id: str
    """`camera-1` ..., in the order of the photographs."""
    words: str
    """Body, lens, focal length and size, for users."""
    photos: tuple[PhotoEntry, ...]
    may_pool: bool
    """Whether it is assumed by all of several photographs, so that its intrinsics can be pooled over them."""


def folder_contents(folder: str | Path) -> FolderContents:
    """Return the scans, photographs and camera files of a folder; folders in it and hidden files are left out.

    Raises:
        FormatError: if it cannot be listed.
    """
    found: dict[str, list[Path]] = {"scan": [], "photo": [], "camera": []}
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_file() and not entry.name.startswith("."))
    except OSError as error:
        raise OptionError(f"{folder} cannot be listed: {(error.strerror or 'unknown').lower()}") from None
    for name in names:
        kind = listed_kind(Path(folder, name))
        if kind in found:
            found[kind].append(Path(folder, name))
    return FolderContents(tuple(found["scan"]), tuple(found["photo"]), tuple(found["camera"]))


def photo_entries(paths: Iterable[str | Path]) -> list[PhotoEntry]:
    """Return the photographs of files, each file once, with what their headers say.

    One that cannot be read has its fault: it does not stop the others.
    """
    entries: list[PhotoEntry] = []
    seen: set[str] = set()
    for path in map(Path, paths):
        real = os.path.realpath(path)
        if real in seen:
            continue
        seen.add(real)
        name = photo_id(path.name, [entry.id for entry in entries])
        try:
            with BegunRead(header_fields, (path,), {}) as read:
                entries.append(PhotoEntry(name, path, PhotoFacts(**read.result())))
        except LadarregError as error:
            entries.append(PhotoEntry(name, path, None, str(error)))
    return entries


def camera_groups(entries: Sequence[PhotoEntry], photo_options: Mapping[str, Any] | None = None) -> list[CameraGroup]:
    """Return the cameras of photographs that can be read.

    Args:
        entries: the photographs.
        photo_options: arguments of `read_photo` for all: a camera that is given in pixels or as a file is that of all
            photographs of a size.
    """
    options = photo_options or {}
    calibrated = options.get("camera") is not None or options.get("camera_model") == "equirectangular"
    given = any(options.get(name) is not None for name in _GIVEN)
    groups: dict[tuple[Any, ...], list[PhotoEntry]] = {}
    for entry in entries:
        if entry.facts is not None:
            groups.setdefault(_camera_key(entry.facts, given=given), []).append(entry)
    return [
        CameraGroup(
            f"camera-{number}", _words(members[0]), tuple(members), not calibrated and len(members) > 1 and bool(key[0])
        )
        for number, (key, members) in enumerate(groups.items(), 1)
    ]


def _camera_key(facts: PhotoFacts, *, given: bool) -> tuple[Any, ...]:
    """Return what the photographs of one camera have in common; first, whether it may be pooled over them."""
    size = (facts.width, facts.height)
    if not may_be_turned(facts.orientation):
        return (False, facts.orientation, *size)
    stated = (facts.focal_mm, facts.film_mm)
    return (given or stated != (None, None), facts.body, facts.lens, *stated, *size)


def _words(entry: PhotoEntry) -> str:
    assert entry.facts is not None, "only those that can be read have a camera"
    return entry.facts.words
