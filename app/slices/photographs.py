"""Types of the slices on a photograph, its matches and its poses (docs/workbench.md)."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.picks.lengths import Comparability
from ladarreg_core.project.document import Part
from ladarreg_core.project.work_steps import StepName
from ladarreg_core.quality.findings import Level
from ladarreg_core.quality.verdict import Action, Light
from ladarreg_core.registration.self_test.trials import TrialKind
from ladarreg_core.results.registration import StageId
from ladarreg_core.results.verdict_words import Evidence
from ladarreg_core.survey.audit import AuditFields

Numbers = list[float]
"""A ray [x, y, z], a pixel [u, v], or a row of a matrix."""


class PhotoCamera(TypedDict):
    """The camera of a photograph."""

    model: str
    width: int
    height: int
    distortion: Numbers
    calibrated: bool
    said: str
    short: str


class FocalPhotoCamera(PhotoCamera):
    """A camera with a focal length."""

    fx: float
    fy: float
    cx: float
    cy: float


class PanoramaCamera(PhotoCamera):
    """The camera of a panorama."""

    window: Numbers | None


class Photo(TypedDict):
    """An entry of the slice `photos`."""

    id: str
    name: str
    width: int
    height: int
    camera: FocalPhotoCamera | PanoramaCamera | None
    notes: list[str]
    thermal: bool
    state: Literal["empty", "solved", "accepted", "refused", "stale"]
    stale: NotRequired[str]
    light: NotRequired[Light]
    light_words: NotRequired[str]
    position: NotRequired[str]
    rev: str
    part: Part
    station: str
    stated_pose: NotRequired[list[Numbers]]
    camera_error: NotRequired[str]
    error: NotRequired[str]


class Pick(TypedDict):
    """An entry of the slice `picks:pID`."""

    id: str
    number: int
    kind: Literal["point", "line"]
    scan: list[Numbers]
    photo: list[Numbers]
    on: bool
    weight: float
    origin: str
    name: NotRequired[str]


class JudgedPick(TypedDict):
    """The errors of a match under the shown pose."""

    px: float | None
    mm: float | None
    depth_m: float | None
    inlier: bool | None
    agrees: bool | None
    influence: float | None


class SampledLine(TypedDict):
    """The samples of a line on the scan: its rays, and whether each has a range."""

    scan_samples: list[tuple[Numbers, bool]]
    sampled: int
    used: int


class Thresholds(TypedDict):
    """The errors above which matches may be disabled."""

    depth: float | None
    px: float | None


class JudgedLength(TypedDict):
    """A length that came with a match, beside the scan's own range."""

    length_m: float
    scan_range_m: float | None
    difference_m: float | None
    tolerance_m: float
    state: Comparability
    beyond: bool


class Judged(TypedDict):
    """The slice `judged:pID`."""

    stage: StageId | None
    by_pick: dict[str, JudgedPick]
    thresholds: Thresholds
    predicted: dict[str, list[Numbers | None]]
    lines: dict[str, SampledLine]
    lengths: dict[str, JudgedLength]
    losses: list[str]
    cautions: list[str]


class NextStep(TypedDict):
    """What to do next about a pose."""

    sentence: str
    action: Action
    stage: StageId | None


class Summary(TypedDict):
    """What the page says of a pose at a glance."""

    light: Light
    words: str
    line: str
    position: str
    pixels: str
    matches: str
    next_step: NextStep
    other: NextStep | None


class ImageOutcome(TypedDict):
    """The outcome of verifying a pose against the images."""

    outcome: Literal["verified", "contradicted", "undecidable"]
    sentence: str


class Parameter(TypedDict):
    """One of the six parameters of a pose, rounded."""

    name: str
    unit: str
    value: str
    sigma: str


class StageStep(TypedDict):
    """A step of the registration that gave a pose."""

    name: str
    label: str
    seconds: float


class Finding(TypedDict):
    """A statement on the quality of a pose."""

    what: str
    level: Level
    sentence: str
    what_to_do: str


class Advice(TypedDict):
    """Where a further match would help."""

    uv: Numbers
    ray: Numbers
    sentence: str


class AssessedStage(TypedDict):
    """What is known of a stage once its pose has been verified against the images, and assessed."""

    image: NotRequired[ImageOutcome]
    findings: NotRequired[list[Finding]]
    uncertainty: NotRequired[str]
    check: NotRequired[str]
    check_pick: NotRequired[str | None]
    advice: NotRequired[list[Advice]]
    absent: NotRequired[dict[str, str]]


class SolvedStage(AssessedStage):
    """A stage of the slice `poses:pID`."""

    stage: StageId
    label: str
    method: str
    accepted: bool
    evidence: Evidence
    verdict: str
    reasons: list[str]
    wants_frames: bool
    stale: str
    summary: Summary
    note: str
    parameters: list[Parameter]
    matches: int
    inliers: int
    median_px: float | None
    rms_px: float | None
    rms_depth_m: float | None
    cost: float | None
    centre: Numbers
    in_world: str | None
    focal_px: float
    camera_sigmas: dict[str, float]
    seconds: float
    regions: list[Numbers]
    steps: list[StageStep]


class LostStage(TypedDict):
    """A stage whose arrays are missing."""

    stage: StageId
    label: str
    accepted: bool
    verdict: str
    stale: str
    summary: Summary


Stage = SolvedStage | LostStage


class Poses(TypedDict):
    """The slice `poses:pID`."""

    shown: StageId | None
    stages: list[Stage]


class WorkStep(TypedDict):
    """A step of the work on a photograph."""

    name: StepName
    done: bool
    status: str
    missing: str


class Progress(TypedDict):
    """The slices `progress` and `progress:pID`."""

    steps: list[WorkStep]
    needed: str
    next_action: str
    exported: dict[str, FrameName]


class Solving(TypedDict):
    """The slice `solving:pID`."""

    busy: bool
    sentence: str


class Outline(TypedDict):
    """The slice `outline:pID`."""

    rays: list[Numbers]
    registered: bool


class Corners(TypedDict):
    """The slice `corners:pID`."""

    scan: list[Numbers]
    photo: list[Numbers]


class Audit(AuditFields):
    """The slice `audit:pID`."""

    judged: str


class SelfTestRow(TypedDict):
    """A registration of a rendered or unrelated photograph."""

    kind: TrialKind
    right: bool
    accepted: bool
    error_mm: float | None
    error_deg: float | None
    error_px: float | None
    off_deg: float
    seconds: float


class SelfTest(TypedDict):
    """The slice `self_test:pID`."""

    sentence: str
    advice: str
    counts: str
    rows: list[SelfTestRow]
