"""All slices by their names (docs/workbench.md)."""

from __future__ import annotations

from typing import TypedDict

from .photographs import (
    Audit,
    Corners,
    Judged,
    Numbers,
    Outline,
    Photo,
    Pick,
    Poses,
    Progress,
    SelfTest,
    Solving,
)
from .project import (
    EmbeddedPicture,
    FileFormats,
    History,
    Job,
    Limits,
    LostScan,
    Measured,
    Measurement,
    Model,
    People,
    Project,
    ReadingField,
    ReadScan,
    Served,
    Setting,
    Smoothing,
    WaitingFile,
)
from .several import Acquisition, DrawnLine, DrawnTie, Partner, Stations, Survey

Scan = ReadScan | LostScan


class QuickSlices(TypedDict):
    """Slices that all clients share and that are published at once, but for those on photographs."""

    history: History
    scan: Scan | None
    settings: dict[str, Setting]
    job: Job | None
    served: Served | None
    waiting: list[WaitingFile]
    formats: list[FileFormats]
    reading: dict[str, ReadingField]
    embedded: list[EmbeddedPicture]
    acquisition: Acquisition
    stations: Stations | None
    measurements: list[Measurement]
    drawn_ties: list[DrawnTie]
    drawn_lines: list[DrawnLine]
    progress: Progress
    limits: Limits


class PhotoSlices(TypedDict):
    """Slices on all photographs together."""

    photos: list[Photo]
    survey: Survey | None


class SlowSlices(TypedDict):
    """Slices that take time to compute."""

    measured: list[Measured]


class OwnSlices(TypedDict):
    """Slices that differ between the clients."""

    project: Project
    shown: str | None
    partner: Partner
    beside: Scan | None
    smoothing: Smoothing
    people: People
    model: Model


class Slices(QuickSlices, PhotoSlices, SlowSlices, OwnSlices):
    """All slices but those of each photograph."""


class KeptOfPhoto(TypedDict):
    """Slices of one photograph that follow from the document; the name in the protocol has its id behind a colon."""

    picks: list[Pick]
    poses: Poses
    progress: Progress
    outline: Outline | None
    ties: list[Numbers] | None


class AskedOfPhoto(TypedDict):
    """Slices of one photograph that jobs know."""

    solving: Solving
    corners: Corners | None
    self_test: SelfTest | None
    audit: Audit | None


class SlowOfPhoto(TypedDict):
    """Slices of one photograph that take time to compute."""

    judged: Judged


class OfPhoto(KeptOfPhoto, AskedOfPhoto, SlowOfPhoto):
    """All slices of one photograph."""
