"""Types of the slices on several photographs and scans together, and on the acquisition (docs/workbench.md)."""

from __future__ import annotations

from typing import Literal, TypedDict

from ladarreg_core.acquisition.plan import PlanFields
from ladarreg_core.registration.stations.results import PairVerdict, StationState

from .choices import AcquisitionState
from .photographs import Numbers


class StationPlace(TypedDict):
    """Where a station stands in the frame of the one that is shown."""

    x: float
    y: float
    z: float
    yaw_deg: float


class Station(TypedDict):
    """A station; the one that is shown has no id."""

    id: str | None
    name: str
    files: list[str]
    index: int
    colour: str | None
    state: Literal["waiting"] | StationState
    sigma_mm: float | None
    sigma_deg: float | None
    place: StationPlace | None
    rough: bool


class StationPair(TypedDict):
    """How two stations fit together."""

    first: str
    second: str
    verdict: PairVerdict
    reasons: list[str]
    overlap: float | None
    sigma_mm: float | None
    sigma_deg: float | None


class StationLoop(TypedDict):
    """Pairs that lead back to where they began."""

    stations: list[str]
    error_mm: float
    error_deg: float


class StationCheck(TypedDict):
    """A photograph's pose carried over to another station."""

    photo: str
    name: str
    station: str
    outcome: Literal["verified", "contradicted", "undecidable"]
    sentence: str
    fraction: float | None
    stale: bool


class StationsStep(TypedDict):
    """The tick of the step with its sentences."""

    done: bool
    status: str
    missing: str


class Stations(StationsStep):
    """The slice `stations`."""

    stations: list[Station]
    stale: bool
    registered: bool
    pairs: list[StationPair]
    loops: list[StationLoop]
    reasons: list[str]
    checks: list[StationCheck]


class PartnerChoice(TypedDict):
    """A station that the photograph may be matched with."""

    station: str
    name: str
    index: int
    sees: float | None


class Partner(TypedDict):
    """The slice `partner`."""

    station: str
    choices: list[PartnerChoice]


class DrawnTie(TypedDict):
    """An entry of the slice `drawn_ties`."""

    id: str
    track: str
    photos: list[str]
    uv: list[Numbers]
    sigma_px: float
    agrees: bool | None
    residual_px: float | None
    reason: str


class LineInScan(TypedDict):
    """A line as a scan shows it."""

    station: str | None
    name: str
    xyz: list[Numbers]
    sigma: str


class DrawnLine(TypedDict):
    """An entry of the slice `drawn_lines`."""

    id: str
    photos: list[str]
    uv: list[list[Numbers]]
    sigma_px: float
    in_scan: LineInScan | None
    agrees: bool | None
    residuals_px: dict[str, float]
    scan_residual: str | None
    reason: str


class SurveyPhoto(TypedDict):
    """What solving everything together said of a photograph."""

    id: str
    name: str
    verdict: str
    accepted: bool
    reasons: list[str]
    ties: int
    ties_left_out: int
    median_px: float | None
    partners: list[str]
    camera: str
    sigma_m: float | None
    position: str | None
    angle: str | None
    moved: str | None
    changed: bool


class WorstPhoto(TypedDict):
    """The photograph with the largest residual."""

    id: str
    name: str
    median_px: float


class SurveyCamera(TypedDict):
    """What solving everything together said of a camera."""

    id: str
    focal_px: float | None
    sigma_px: float | None
    width: int | None
    height: int | None
    photos: list[str]
    used: int
    median_px: float | None
    worst: WorstPhoto | None
    held: bool


class SurveyScan(TypedDict):
    """What solving everything together said of a scan."""

    name: str
    state: Literal["fixed", "placed", "not connected"]
    position: str | None
    angle: str | None


class Survey(TypedDict):
    """The slice `survey`."""

    accepted: int
    photos: list[SurveyPhoto]
    cameras: list[SurveyCamera]
    scans: list[SurveyScan]
    chi2_per_dof: float | None
    sigma_px: float | None
    since: str


class Driver(TypedDict):
    """The client that drives the devices."""

    id: str
    name: str


class Devices(TypedDict):
    """The devices that are connected."""

    unit: str
    simulated: bool
    lowest_deg: Numbers
    highest_deg: Numbers
    step_deg: Numbers
    scanner: str | None
    has_intensity: bool


class AcquiredRun(TypedDict):
    """A run in the project's folder."""

    name: str
    done: int
    total: int
    complete: bool
    photos: int


class Acquisition(TypedDict):
    """The slice `acquisition`."""

    state: AcquisitionState
    offered: bool
    said: str
    driver: Driver | None
    devices: Devices | None
    plan: PlanFields | None
    at_deg: Numbers | None
    done: int
    total: int
    seconds_left: int
    complete: bool
    run: str
    picture: str | None
    points: int
    runs: list[AcquiredRun]
