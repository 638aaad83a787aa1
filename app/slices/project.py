"""Types of the slices on the project, its scan and files, its jobs and the people at work (docs/workbench.md)."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

from ladarreg_core.formats.file_info import FileKind
from ladarreg_core.project.document import MeasurementKind

from .choices import Control, InputKind, JobState, ModelDetail, SettingOf, SmoothingShow
from .photographs import Numbers


class Project(TypedDict):
    """The slice `project`."""

    id: str
    start: bool
    name: str
    folder: str
    saved_at: str
    unsaved: bool
    unsaved_why: str
    amiss: str
    undo: str | None
    redo: str | None
    opened: str


class HistoryEntry(TypedDict):
    """A step of the history."""

    n: int
    label: str
    author: str
    when: str


class History(TypedDict):
    """The slice `history`."""

    at: int
    entries: list[HistoryEntry]


class ScanView(TypedDict):
    """A view of the scan: a pinhole at the scanner."""

    label: str
    width: int
    height: int
    f: float
    cx: float
    cy: float
    rotation: Numbers


class Strip(TypedDict):
    """The elevations of the borders of the full turn, rad."""

    low: float
    high: float


class WorldPlace(TypedDict):
    """Where the scanner stands in the world, in words."""

    position: str
    heading: str
    tilt: str


class ReadScan(TypedDict):
    """The slice `scan`."""

    id: str
    grid: str
    name: str
    files: list[str]
    rows: int
    columns: int
    returns: int
    notes: list[str]
    world: WorldPlace | None
    has_color: bool
    has_intensity: bool
    views: list[ScanView]
    strip: Strip | None


class LostScan(TypedDict):
    """The slice `scan`, if the file can no longer be read or viewed."""

    id: str
    name: str
    files: list[str]
    notes: list[str]
    views: list[ScanView]
    error: str


class PreviewedRange(TypedDict):
    """A range that smoothing would replace."""

    id: str
    ray: Numbers
    uv: Numbers | None
    before_m: float
    after_m: float
    sigma_m: float
    edge: bool


class SmoothingPreview(TypedDict):
    """What the accepted pose of a photograph would replace."""

    photo: str
    name: str
    station: str
    show: SmoothingShow
    rev: str
    stale: str
    nothing: str
    ranges: list[PreviewedRange]


class Smoothing(TypedDict):
    """The slice `smoothing`."""

    station: str
    replaced: int
    sentence: str
    preview: SmoothingPreview | None


class MeasurementPlace(TypedDict):
    """A picked place: a ray of the scan, or a pixel of a photograph."""

    photo: NotRequired[str]
    uv: NotRequired[Numbers]
    sigma_px: NotRequired[float]
    ray: NotRequired[Numbers]
    sigma_rad: NotRequired[float]


class Measurement(TypedDict):
    """An entry of the slice `measurements`."""

    id: str
    station: str
    name: str
    kind: MeasurementKind
    places: list[MeasurementPlace]


class MeasuredValue(TypedDict):
    """What was measured, or why nothing was."""

    value: str
    interval: str
    notes: list[str]
    refusal: str


class Drawing(TypedDict):
    """What is drawn of a measurement; of a photograph, null where it is outside of the picture or hidden."""

    ends: list[Numbers | None]
    lines: list[list[Numbers | None]]


class Drawings(TypedDict):
    """A measurement as its own scanner sees it, and in photographs by their ids."""

    drawn: Drawing | None
    in_photo: dict[str, Drawing]


class Measured(MeasuredValue, Drawings):
    """An entry of the slice `measured`."""

    id: str


class Choice(TypedDict):
    """A choice of a setting."""

    value: str
    label: str


class Setting(TypedDict):
    """A setting with its field."""

    value: str | float | bool | None
    label: str
    kind: Literal["number", "choice", "switch"]
    least: float | None
    most: float | None
    step: float | None
    whole: bool
    empty: bool
    choices: list[Choice]
    unit: str
    step_of: SettingOf
    said: str


class WaitingJob(TypedDict):
    """A job that begins after the present one."""

    id: str
    label: str
    photo: str
    author: str


class JobStep(TypedDict):
    """A step of a job."""

    name: str
    label: str
    seconds: float
    said: str


class Job(TypedDict):
    """The slice `job`."""

    id: str
    kind: str
    label: str
    photo: str
    author: str
    state: JobState
    done: int
    total: int
    said: str
    seconds: float
    can: list[Control]
    speed: float
    steps: list[JobStep]
    waiting: list[WaitingJob]


class ServedFile(TypedDict):
    """A file of the served folder."""

    path: str
    size: int
    kind: FileKind


class Served(TypedDict):
    """The slice `served`."""

    label: str
    files: list[ServedFile]


class WaitingFile(TypedDict):
    """An entry of the slice `waiting`."""

    id: str
    name: str
    size: int
    kind: FileKind | Literal["part"]
    said: str
    lacks: list[str]
    takes: list[str]
    scans: NotRequired[list[str]]


class ReadingField(TypedDict):
    """A field of the form for what a file does not state."""

    label: str
    hint: str
    example: str
    kind: InputKind


class FileFormats(TypedDict):
    """An entry of the slice `formats`."""

    kind: Literal["scan", "photo", "camera", "matches"]
    label: str
    names: list[str]
    extensions: list[str]


class EmbeddedPicture(TypedDict):
    """An entry of the slice `embedded`."""

    index: int
    name: str
    said: str
    usable: bool
    taken: bool


class Limits(TypedDict):
    """The slice `limits`."""

    upload_bytes: int
    photos: int


class Person(TypedDict):
    """A connected client."""

    id: str
    name: str
    colour: int
    photo: str | None
    follows: str | None
    read_only: bool


class People(TypedDict):
    """The slice `people`."""

    count: int
    you: str
    clients: list[Person]


class TextureOption(TypedDict):
    """A texture to choose from."""

    value: str
    label: str
    usable: bool
    said: str


class Sheet(TypedDict):
    """The net that bears a photograph before its camera."""

    photo: str
    centre: Numbers
    distance: float
    columns: int
    corners: list[Numbers | None]


class ModelDisplay(TypedDict):
    """How a client has the model displayed."""

    texture: str
    z_buffer: bool
    detail: ModelDetail
    cameras: bool
    matches: bool
    rays: bool
    residuals: bool
    hidden_stations: list[str]


class ModelOfPhoto(TypedDict):
    """What the model shows of a photograph."""

    rev: str
    accepted: bool
    choices: list[TextureOption]
    sheet: Sheet | None


class Model(ModelDisplay, ModelOfPhoto):
    """The slice `model`."""
