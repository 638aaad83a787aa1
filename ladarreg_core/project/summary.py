"""What a list of projects says of each: read from its folder without opening it."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ladarreg_core.errors import FormatError
from ladarreg_core.project.checksum import verify_checksum

_PROJECT = "project.json"


class _Pose(msgspec.Struct):
    stage: str = ""
    accepted: bool = False


class _Photo(msgspec.Struct):
    poses: list[_Pose] = []
    shown_stage: str | None = None


class _Document(msgspec.Struct):
    name: str = "untitled"
    scan: dict[str, Any] | None = None
    photos: list[_Photo] = []


@dataclass(frozen=True, slots=True)
class ProjectSummary:
    """State of a project in short."""

    name: str
    """Its name."""
    scan: str | None
    """File name of its scan."""
    photos: int
    """Number of its photographs."""
    solved: int
    """Number of those with a pose."""
    accepted: int
    """Number of those whose shown pose is accepted."""
    edited: str
    """Time of the last edit, ISO 8601."""

    @property
    def is_empty(self) -> bool:
        """Whether nothing was opened in it."""
        return self.scan is None and self.photos == 0

    def describe(self) -> str:
        """Return its state in one phrase."""
        if self.is_empty:
            return "empty"
        if self.scan is None:
            return "no scan yet"
        if self.photos == 0:
            return "no photograph yet"
        many = "photograph" if self.photos == 1 else "photographs"
        if self.solved == 0:
            return f"{self.photos} {many}, not solved"
        if self.photos == 1:
            return "accepted" if self.accepted else "solved, not accepted"
        return f"{self.accepted} of {self.photos} photographs accepted"


def read_summary(folder: Path) -> ProjectSummary:
    """Summarise a project, which another program may have open.

    Raises:
        FormatError: if there is none, or its `project.json` cannot be read; opening it may still repair it.
    """
    path = folder / _PROJECT
    try:
        data = path.read_bytes()
        edited = path.stat().st_mtime
    except OSError as error:
        raise FormatError(f"{folder.name} cannot be read: {error.strerror or error}") from None
    try:
        found = msgspec.json.decode(verify_checksum(data).data, type=_Document)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise FormatError(
            f"the {_PROJECT} of {folder.name} is damaged; open the project, which repairs it from its history"
        ) from None
    shown = [{pose.stage: pose for pose in photo.poses}.get(photo.shown_stage or "") for photo in found.photos]
    return ProjectSummary(
        name=found.name,
        scan=None if found.scan is None else str(found.scan.get("name", "")),
        photos=len(found.photos),
        solved=sum(pose is not None for pose in shown),
        accepted=sum(pose is not None and pose.accepted for pose in shown),
        edited=datetime.datetime.fromtimestamp(edited).astimezone().isoformat(timespec="seconds"),
    )
