"""The document: a scan, its photographs, their picks and their poses. It is frozen; edits return a new one.

Everything in it is plain and small except the arrays of a pose's matches, which successive documents share.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, get_args

import msgspec

from ladarreg_core.matches import Pick
from ladarreg_core.project.drawn import AdjustedLineEntry, AdjustedTieEntry, LineEntry, TieEntry
from ladarreg_core.project.settings import Settings
from ladarreg_core.project.source import Source
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.results.registration import StageId
from ladarreg_core.results.verdict_words import Evidence

VERSION = 1
STAGES: tuple[StageId, ...] = get_args(StageId)
"""All stages in display order."""
Part = Literal["free", "held", "out"]
"""How a photograph takes part in an adjustment: its pose is solved for, it keeps its pose and holds the others, or it
was taken out."""
Numbers = tuple[float, ...]
Rows = tuple[Numbers, ...]
MeasurementKind = Literal["point", "distance", "polyline", "angle", "area", "height"]
"""As `ladarreg_core.inspection.measuring.measurement.MeasurementKind`, which is above this package."""


class CameraGiven(msgspec.Struct, frozen=True, kw_only=True):
    """Camera data given by the operator; empty: the photograph's EXIF is used."""

    file: Source | None = None
    """Camera file."""
    name: str | None = None
    """Name of the camera in a file with several; None: chosen by the photograph."""
    focal_px: float | None = None
    """Focal length, pixels."""
    focal_mm: float | None = None
    """Focal length, mm; with `sensor_mm`."""
    sensor_mm: float | None = None
    """Sensor width, mm."""
    model: Literal["pinhole", "equirectangular"] | None = None
    """Camera model, where there is no camera file; None: as the photograph says, or else a pinhole."""


class PickEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A pick as saved in the document."""

    id: str
    """Stable id."""
    number: int
    """Number on the screen; never reused within a photograph."""
    kind: Literal["point", "line"]
    """`point` or `line`."""
    scan: Rows
    """Unit rays, scanner frame."""
    photo: Rows
    """Photo pixels."""
    on: bool = True
    """Whether solvers use it."""
    weight: float = 1.0
    """Relative weight."""
    origin: str = "manual"
    """Who created it: the operator, a file or a detector."""
    lengths_m: Numbers | None = None
    """Distances from the scanner that came with it, m; None: the scan's own ranges are used."""
    name: str = ""
    """Name for users, e.g. of a target; empty: none."""

    def as_pick(self) -> Pick:
        """Return the input of the solvers.

        Raises:
            ShapeError: if the pick is invalid.
        """
        return Pick(
            self.id,
            self.kind,
            self.scan,  # type: ignore[arg-type]
            self.photo,  # type: ignore[arg-type]
            self.on,
            self.weight,
            self.origin,
            self.lengths_m,  # type: ignore[arg-type]
            self.name,
        )


class PoseEntry(msgspec.Struct, frozen=True, kw_only=True):
    """The complete result of one estimator; see `project.results`."""

    stage: StageId
    """Stage of the estimator."""
    method: str
    """Registration method."""
    arrays: StoredArrays
    """Matches, inliers and residuals."""
    camera_from_scanner: Rows
    """Pose matrix (4, 4)."""
    camera: dict[str, Any]
    """Intrinsics used or estimated."""
    world_from_scanner: Rows | None = None
    """The scanner's pose in the world (4, 4) when this was solved; None: not known."""
    covariance: Rows
    """Covariance (6, 6) of the pose; empty: not known, as of a pose that was given."""
    chi2_per_dof: float | None
    """None if undefined."""
    sigma_px: float
    """Pixel noise used, px."""
    sigma_range_m: float
    """Range noise used, m."""
    camera_sigmas: dict[str, float] = {}
    """Standard deviations of the estimated intrinsics."""
    camera_uncertainty: dict[str, Any] | None = None
    """`CameraUncertainty.as_fields` of a camera that was not calibrated."""
    accepted: bool = False
    """Whether the pose is accepted as registered."""
    evidence: Evidence = "none"
    """Kind of evidence for it."""
    reasons: tuple[str, ...] = ()
    """Reasons of the verdict, in sentences."""
    diagnostics: dict[str, Any] = {}
    """Diagnostics, JSON-ready."""
    steps: tuple[StepEntry, ...] = ()
    """Steps of the registration."""
    options: dict[str, Any] = {}
    """Options used, JSON-ready."""
    seed: int = 0
    """Random seed used."""
    seconds: float = 0.0
    """Wall time."""
    note: str = ""
    """Remark of the estimator."""
    clouds: int = 1
    """Number of clouds of the scan that it was solved on."""
    ranges: str = ""
    """Name of the ranges of the scan that it holds for, as `Source.ranges`: those that it was solved on, or those that
    it replaced itself."""
    carried_from: str = ""
    """Name of the pose at another station that it states here, without its matches; empty: it was found here."""

    @property
    def name(self) -> str:
        """What the pose is called, wherever it is stated: the name of its arrays where it was found."""
        return self.carried_from or self.arrays.name


class StepEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A step of a registration, without its matches."""

    name: str
    """Name of the step."""
    seconds: float
    """Wall time."""
    detail: dict[str, Any] = {}
    """Details, JSON-ready."""


class StationWork(msgspec.Struct, frozen=True, kw_only=True):
    """What was done on a photograph beside the scan of a station, while it is beside another one."""

    station: str
    """Id of the station; empty: the scan of the project."""
    stated_pose: Rows | None = None
    """This and all else as of a photograph."""
    stated_by: str = ""
    picks: tuple[PickEntry, ...] = ()
    numbered: int = 0
    poses: tuple[PoseEntry, ...] = ()
    shown_stage: StageId | None = None


class PhotoEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A photograph with its own matches and poses, which belong to the scan of its station."""

    id: str
    """Stable id of letters and digits."""
    source: Source
    """Image file."""
    camera: CameraGiven = CameraGiven()
    """Camera data given by the operator."""
    stated_pose: Rows | None = None
    """Pose `camera_from_scanner` (4, 4) that the scan's file or the operator states for it; nobody has verified it."""
    stated_by: str = ""
    """Name of the file that states it; empty: the scan's."""
    picks: tuple[PickEntry, ...] = ()
    """Picks in the order of their creation."""
    numbered: int = 0
    """Last number given to a pick."""
    poses: tuple[PoseEntry, ...] = ()
    """Latest result of each stage."""
    shown_stage: StageId | None = None
    """Stage whose pose is the current one."""
    part: Part = "free"
    """How it takes part in an adjustment."""
    camera_held: dict[str, Any] | None = None
    """Intrinsics that adjustments keep; None: they estimate them as far as they are assumed."""
    station: str = ""
    """Id of the station that it is matched with; empty: the scan of the project."""
    station_given: bool = False
    """Whether the operator chose it, so that no other is chosen unasked."""
    elsewhere: tuple[StationWork, ...] = ()
    """What was done on it beside the scans of other stations."""

    @property
    def photo_options(self) -> dict[str, Any]:
        """What was given for reading the photograph, as arguments of `read_photo`; its camera file by its name."""
        given = self.camera
        return {
            "camera": None if given.file is None else given.file.name,
            "camera_name": given.name,
            "focal_px": given.focal_px,
            "focal_mm": given.focal_mm,
            "sensor_mm": given.sensor_mm,
            "camera_model": given.model,
            "temperature_unit": self.source.temperature_unit,
        }

    @property
    def pose(self) -> PoseEntry | None:
        """The current pose."""
        return self.stage(self.shown_stage) if self.shown_stage else None

    def stage(self, stage: str) -> PoseEntry | None:
        """Return the result of a stage; None where it has none."""
        return next((pose for pose in self.poses if pose.stage == stage), None)

    def pick(self, pick_id: str) -> PickEntry | None:
        """Return a pick by its id; None if there is none."""
        return next((pick for pick in self.picks if pick.id == pick_id), None)


class MeasuredPlace(msgspec.Struct, frozen=True, kw_only=True):
    """A point that was picked to be measured."""

    at: Numbers
    """Unit ray, scanner frame; or pixel (u, v) of a photograph."""
    photo: str = ""
    """Id of the photograph; empty: it was picked in the scan."""
    sigma: float = 0.0
    """Standard deviation of the pick along each axis, rad of a ray or pixels, as the picture was shown; 0: as usual."""


class MeasurementEntry(msgspec.Struct, frozen=True, kw_only=True):
    """What the operator measured, as it was picked: values follow from scan and poses as they are."""

    id: str
    """Stable id of letters and digits."""
    number: int
    """Number on the screen; never reused."""
    kind: MeasurementKind
    """What is measured."""
    places: tuple[MeasuredPlace, ...]
    """The points, in order."""
    name: str = ""
    """Name that the operator gave it; empty: kind and number."""
    station: str = ""
    """Id of the station on whose scan it was measured; empty: the scan of the project."""

    @property
    def title(self) -> str:
        """Its name for display."""
        return self.name or f"{self.kind.capitalize()} {self.number}"


class StationEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A further station: a scan of the same place from elsewhere, beside the project's own."""

    id: str
    """Stable id of letters and digits."""
    source: Source
    """Its file."""
    rough: Rows | None = None
    """Rough pose (4, 4) of its scanner in the frame of the scan that is shown, where a search may begin."""
    photos: tuple[PhotoEntry, ...] = ()
    """The photographs with their matches and poses as they were when this station was shown last, by versions of the
    program that did not keep them with the photographs."""
    measurements: tuple[MeasurementEntry, ...] = ()
    """What was measured on its scan, by versions of the program that kept it here, see `with_one_list`."""


class Survey(msgspec.Struct, frozen=True, kw_only=True):
    """The stations registered to each other, as they were then."""

    scans: tuple[Source, ...]
    """The scans in the order of the result; the first one is fixed."""
    fields: dict[str, Any]
    """`StationNetwork.as_fields`; `station_edits.checked_survey` checks it."""
    checks: tuple[PhotoCheck, ...] = ()
    """What the photographs' poses are worth at the other stations."""


class PhotoCheck(msgspec.Struct, frozen=True, kw_only=True):
    """The verdict on a photograph's pose, carried over to another station, by that station's scan."""

    photo: str
    """Id of the photograph."""
    name: str
    """Its display name."""
    scan: Source
    """The scan."""
    pose: str
    """Name of the arrays of the pose that was carried over."""
    outcome: Literal["verified", "contradicted", "undecidable"]
    """What the images say."""
    sentence: str
    """The same with its reason."""
    fraction: float | None = None
    """Fraction of the regions that agree; None: too little of the photograph is seen from there."""


class AdjustedPhotoEntry(msgspec.Struct, frozen=True, kw_only=True):
    """What solving everything together says of a photograph."""

    verdict: str
    """As a sentence."""
    accepted: bool
    """Whether its pose may be used."""
    reasons: tuple[str, ...] = ()
    """Of the verdict, in sentences."""
    ties: int = 0
    """Ties with other photographs that agree."""
    ties_left_out: int = 0
    """Ties that do not."""
    median_px: float | None = None
    """Median residual of its ties, px; None: it has none."""
    partners: tuple[str, ...] = ()
    """Ids of the accepted photographs that it is tied to."""
    camera: str = ""
    """Id of its camera among `Adjusted.cameras`."""
    sigma_m: float | None = None
    """Standard deviation of its position, m; None: it is not accepted."""
    sigma_rad: float | None = None
    """Standard deviation of its direction, rad."""
    pose: str = ""
    """Name of the arrays of the pose that it got, or that was held; empty: none."""
    former_centre: Numbers | None = None
    """Where the camera was before, m, in the frame of the scan that was shown; None: its pose was not accepted."""
    moved_m: float | None = None
    """How far the adjustment moved it."""
    moved_rad: float | None = None
    """How far the adjustment turned it."""


class AdjustedScanEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Where a scanner stood."""

    source: Source
    """Its file."""
    world_from_scanner: Rows | None = None
    """Its pose (4, 4); None: nothing connects it to the others."""
    sigma_m: float | None = None
    """Standard deviation of its position, m; None: it is fixed, or has no place."""
    sigma_rad: float | None = None
    """Standard deviation of its direction, rad."""


class AdjustedCameraEntry(msgspec.Struct, frozen=True, kw_only=True):
    """A camera as its photographs determine it together."""

    camera: dict[str, Any]
    """Its intrinsics."""
    sigmas: dict[str, float] = {}
    """Standard deviations of those that were estimated."""
    photos: tuple[str, ...] = ()
    """Ids of the accepted photographs that it took."""


class Adjusted(msgspec.Struct, frozen=True, kw_only=True):
    """All photographs and scans solved together, as they were then."""

    scans: tuple[AdjustedScanEntry, ...]
    """The scans; that which was shown first."""
    photos: dict[str, AdjustedPhotoEntry]
    """By the ids of the photographs."""
    cameras: dict[str, AdjustedCameraEntry] = {}
    """By their own ids."""
    chi2_per_dof: float | None = None
    """Of everything that was kept."""
    sigma_px: float | None = None
    """Noise of the ties, px; None: there were none."""
    ties: StoredArrays | None = None
    """Where the photographs show ties: `AdjustedPhoto.tie_marks` by their ids; None: there were none."""

    drawn: dict[str, AdjustedTieEntry] = {}
    """The ties that were drawn, by their ids."""
    drawn_lines: dict[str, AdjustedLineEntry] = {}
    """Likewise the lines."""

    def scan(self, source: Source) -> AdjustedScanEntry | None:
        """Return what is known of a scan; None: it was not among them."""
        return next((one for one in self.scans if one.source == source), None)


class Document(msgspec.Struct, frozen=True, kw_only=True):
    """Complete state of a project."""

    version: int = VERSION
    """Version of the file format."""
    name: str = "untitled"
    """Project name."""
    scan: Source | None = None
    """The scan."""
    photos: tuple[PhotoEntry, ...] = ()
    """The photographs in display order."""
    numbered: int = 0
    """Last number used in a photograph's id."""
    settings: Settings = Settings()
    """Thresholds and choices."""
    stations: tuple[StationEntry, ...] = ()
    """Further stations in display order."""
    numbered_stations: int = 0
    """Last number used in a station's id."""
    survey: Survey | None = None
    """Where the stations stand; None before they were registered."""
    adjusted: Adjusted | None = None
    """What solving everything together gave; None before that was done."""
    measurements: tuple[MeasurementEntry, ...] = ()
    """What was measured on the scans, in the order of its making."""
    numbered_measurements: int = 0
    """Last number given to a measurement."""
    ties: tuple[TieEntry, ...] = ()
    """Places that two photographs show, in the order in which they were drawn."""
    numbered_ties: int = 0
    """Last number used in a tie's id."""
    lines: tuple[LineEntry, ...] = ()
    """Straight edges that photographs show, in the order in which they were drawn."""
    numbered_lines: int = 0
    """Last number used in a line's id."""

    @property
    def clouds(self) -> int:
        """Number of clouds that the scan consists of; 0 without a scan."""
        return 0 if self.scan is None else len(self.scan.paths)

    @property
    def ranges(self) -> str:
        """Name of the scan's ranges, see `Source.ranges`."""
        return "" if self.scan is None else self.scan.ranges

    @property
    def sources(self) -> Iterator[Source]:
        """The files that it refers to: scans, photographs and cameras, of all stations."""
        if self.scan is not None:
            yield self.scan
        yield from (station.source for station in self.stations)
        for photo in (*self.photos, *(photo for station in self.stations for photo in station.photos)):
            yield photo.source
            if photo.camera.file is not None:
                yield photo.camera.file

    @property
    def work(self) -> Iterator[PhotoEntry | StationWork]:
        """What was done on its photographs, beside the scans of all stations."""
        for photo in (*self.photos, *(photo for station in self.stations for photo in station.photos)):
            yield photo
            yield from photo.elsewhere

    def photo(self, photo_id: str) -> PhotoEntry | None:
        """Return a photograph by its id; None if there is none."""
        return next((photo for photo in self.photos if photo.id == photo_id), None)

    def beside(self, photo: PhotoEntry | None) -> Document:
        """Return the document with the scan that a photograph is matched with as its scan.

        Only that photograph, and others beside the same scan, may be looked at in it: poses are in the frames of the
        scans that they were found on.
        """
        if photo is None or not photo.station:
            return self
        source = next((station.source for station in self.stations if station.id == photo.station), None)
        return self if source is None else msgspec.structs.replace(self, scan=source)
