"""The document: a scan, its photographs, what was drawn on them and what was found. Frozen; edits make new ones.

Everything in it is plain and small, but for the arrays of a pose's matches, which successive documents share.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import msgspec

from ladarreg_core.matches import Pick
from ladarreg_core.project.settings import Settings
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.results import StageId

VERSION = 1
STAGES: tuple[StageId, ...] = get_args(StageId)
"""In the order in which they are listed."""
Numbers = tuple[float, ...]
Rows = tuple[Numbers, ...]


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """A file that was opened."""

    path: str
    """Absolute, or relative to the project's folder where the file lies in it."""
    name: str
    """What the operator calls it."""
    size: int
    """Bytes."""
    index: int = 0
    """Which scan of a file with several."""


class CameraGiven(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a photograph's camera beside its own file; nothing: its EXIF tells."""

    file: Source | None = None
    """A camera file."""
    focal_px: float | None = None
    """Focal length, pixels."""
    focal_mm: float | None = None
    """Focal length, mm; with `sensor_mm`."""
    sensor_mm: float | None = None
    """The sensor's width, mm."""


class PickEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A pick as it is kept."""

    id: str
    """Stable name."""
    number: int
    """What it is called on the screen; never used twice for one photograph."""
    kind: Literal["point", "line"]
    """`point` or `line`."""
    scan: Rows
    """Unit rays, scanner frame."""
    photo: Rows
    """Pixels."""
    on: bool = True
    """Whether a solver may use it."""
    weight: float = 1.0
    """Relative weight."""
    origin: str = "manual"
    """Who put it down."""

    def as_pick(self) -> Pick:
        """Return what a solver eats.

        Raises:
            ShapeError: if it is no sound pick.
        """
        return Pick(self.id, self.kind, self.scan, self.photo, self.on, self.weight, self.origin)  # type: ignore[arg-type]


class PoseEntry(msgspec.Struct, frozen=True, kw_only=True):
    """What one estimator answered, whole; see `project.results`."""

    stage: StageId
    """Which estimator."""
    method: str
    """The registration method it belongs to."""
    arrays: StoredArrays
    """Matches, inliers and residuals."""
    camera_from_scanner: Rows
    """(4, 4)."""
    camera: dict[str, Any]
    """Intrinsics used or estimated."""
    covariance: Rows
    """(6, 6)."""
    chi2_per_dof: float | None
    """None where there is none."""
    sigma_px: float
    """Pixel noise used."""
    sigma_range_m: float
    """Range noise used, m."""
    camera_sigmas: dict[str, float] = {}
    """Of the intrinsics that were estimated."""
    accepted: bool = False
    """Whether it may be shown as registered."""
    evidence: Literal["image", "statistics", "none"] = "none"
    """By what."""
    reasons: tuple[str, ...] = ()
    """The verdict in sentences."""
    diagnostics: dict[str, Any] = {}
    """JSON-ready."""
    steps: tuple[StepEntry, ...] = ()
    """How it was found."""
    options: dict[str, Any] = {}
    """The options used, JSON-ready."""
    seed: int = 0
    """The seed used."""
    seconds: float = 0.0
    """How long it took."""
    note: str = ""
    """A sentence of the estimator."""


class StepEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A step of a registration, without its matches."""

    name: str
    """The step's name."""
    seconds: float
    """Wall time."""
    detail: dict[str, Any] = {}
    """JSON-ready."""


class PhotoEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A photograph with its own matches and poses."""

    id: str
    """Stable name, made of letters and digits."""
    source: Source
    """Its file."""
    camera: CameraGiven = CameraGiven()
    """What is known of its camera."""
    picks: tuple[PickEntry, ...] = ()
    """In the order in which they were put down."""
    numbered: int = 0
    """The last number that a pick got."""
    poses: tuple[PoseEntry, ...] = ()
    """The last answer of each stage."""
    shown_stage: StageId | None = None
    """Which of them counts."""

    @property
    def pose(self) -> PoseEntry | None:
        """The answer that counts."""
        return self.stage(self.shown_stage) if self.shown_stage else None

    def stage(self, stage: str) -> PoseEntry | None:
        """Return the answer of a stage."""
        return next((pose for pose in self.poses if pose.stage == stage), None)

    def pick(self, pick_id: str) -> PickEntry | None:
        """Return a pick by its id."""
        return next((pick for pick in self.picks if pick.id == pick_id), None)


class Document(msgspec.Struct, frozen=True, kw_only=True):
    """All of the work."""

    version: int = VERSION
    """Of the file format."""
    name: str = "untitled"
    """What the operator calls it."""
    scan: Source | None = None
    """The scan."""
    photos: tuple[PhotoEntry, ...] = ()
    """The photographs, in order."""
    numbered: int = 0
    """The last number that a photograph's id got."""
    settings: Settings = Settings()
    """Thresholds and choices."""

    def photo(self, photo_id: str) -> PhotoEntry | None:
        """Return a photograph by its id."""
        return next((photo for photo in self.photos if photo.id == photo_id), None)
