"""The parts of a survey: what was measured at a place, and what is known of it beforehand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import INTRINSICS
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import MIN_LINE_PX
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan

Estimate = Literal["auto", "none"] | tuple[str, ...]
"""Which intrinsics of a camera are estimated: all where nothing but an assumption is known, none, or those named."""
DRAWN_SIGMA_PX = 1.0
"""Standard deviation of a tie that is drawn by hand where nobody states another, px."""
SCAN_LINE_SIGMA_M = 0.005
"""Standard deviation of a line that is drawn in a scan where nobody states another, m: half a cell of .1 degrees at
6 m."""
_MIN_LINE_M = 0.01  # likewise in a scan
_MAX_LISTED = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanTargets:
    """Survey spheres in a scan, which say where it stood."""

    source: Path
    """CSV with the columns name, row, column, x, y, z and, where they differ, radius_m."""
    radius_m: float | None = None
    """Radius of those without one in the file."""
    sigma_m: float = 0.001
    """Standard deviation of the surveyed coordinates."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurveyScan:
    """A scan of a survey."""

    id: str
    """Unique among the scans."""
    source: Path | Scan
    """Its file, or the scan itself."""
    index: int = 0
    """Which scan of the file."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of `read_scan`."""
    world_from_scanner: Rigid | None = None
    """Where it stood, if that is known; None: what the file states, if it does."""
    fixed: bool = False
    """Whether it keeps that pose."""
    targets: ScanTargets | None = None
    """Survey spheres in it: where it stood follows from them, in the world of their coordinates."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurveyCamera:
    """A camera that one photograph or several were taken with."""

    id: str
    """Unique among the cameras."""
    source: Path | CameraModel | None = None
    """Its file, or the camera of upright pixels; None: what the photographs' EXIF states."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of `read_photo`, such as `focal_px`."""
    estimate: Estimate = "auto"
    """Which intrinsics are estimated."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PosePrior:
    """What is known of where a photograph was taken, as by GNSS or a total station."""

    pose: Rigid
    """`camera_from_world`; of a position alone only its centre counts."""
    covariance: FloatArray
    """(6, 6) of (w, c) in the world; of a position alone infinite for w."""

    @property
    def is_position(self) -> bool:
        """Whether the direction is unknown."""
        return not bool(np.isfinite(self.covariance).all())


@dataclass(frozen=True, slots=True, kw_only=True)
class RigMember:
    """That a photograph was taken by a sensor of a rig, together with others of the same frame."""

    id: str
    """The rig."""
    frame: str
    """The moment."""
    sensor: str
    """The sensor; all photographs of one have the same pose in the rig."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurveyPhoto:
    """A photograph of a survey."""

    id: str
    """Unique among the photographs, and name of its folder of results."""
    source: Path | Photo
    """Its file, or the photograph itself."""
    camera: str
    """Id of its camera."""
    initial: Rigid | None = None
    """A rough `camera_from_world`."""
    prior: PosePrior | None = None
    """What is known of its pose."""
    matches: Path | None = None
    """File of matches with the first scan, from a hand or another program."""
    rig: RigMember | None = None
    """Its place in a rig."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyTie:
    """A point marked by hand in the two photographs that show it."""

    id: str
    """Unique among the ties."""
    photos: tuple[str, str]
    """Ids of the photographs."""
    uv: tuple[tuple[float, float], tuple[float, float]]
    """Where each shows it, px; of a photograph that EXIF turns, in its upright pixels."""
    sigma_px: float = DRAWN_SIGMA_PX
    """Standard deviation of each of these, in either direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanLine:
    """A line as a scan shows it."""

    scan: str
    """Id of the scan."""
    xyz: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Two places of it, scanner frame, m."""
    sigma_m: float = SCAN_LINE_SIGMA_M
    """Standard deviation of each across the line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyLine:
    """A straight edge drawn by hand in several photographs; its ends may differ from one to another."""

    id: str
    """Unique among the lines."""
    photos: tuple[str, ...]
    """Ids of the photographs."""
    uv: tuple[tuple[tuple[float, float], tuple[float, float]], ...]
    """Two places of the edge in each, px; of a photograph that EXIF turns, in its upright pixels."""
    sigma_px: float = DRAWN_SIGMA_PX
    """Standard deviation of each of these, across the edge."""
    in_scan: ScanLine | None = None
    """The same edge in a scan."""


class SurveyParts(Protocol):
    """What a survey consists of, also before it is one."""

    @property
    def scans(self) -> Sequence[SurveyScan]:
        """The scans."""

    @property
    def cameras(self) -> Sequence[SurveyCamera]:
        """The cameras."""

    @property
    def photos(self) -> Sequence[SurveyPhoto]:
        """The photographs."""

    @property
    def rigs(self) -> Mapping[str, Mapping[str, Rigid | None]]:
        """The rigs."""

    @property
    def ties(self) -> Sequence[SurveyTie]:
        """The ties that were drawn."""

    @property
    def lines(self) -> Sequence[SurveyLine]:
        """The lines that were drawn."""


def faults_of(parts: SurveyParts) -> list[str]:
    """Return what is wrong with the parts of a survey, a clause each."""
    return [
        *_faults_of_ids(parts), *_faults_of_references(parts), *_faults_of_values(parts),
        *(fault for one in parts.lines for fault in _faults_of_line(one, parts)),
    ]  # fmt: skip


def listed_faults(what: str, faults: Sequence[str]) -> str:
    """Return faults as one sentence."""
    shown = "; ".join(faults[:_MAX_LISTED]) + (
        f"; and {len(faults) - _MAX_LISTED} more" if len(faults) > _MAX_LISTED else ""
    )
    return f"{what} has {len(faults)} fault{'' if len(faults) == 1 else 's'}, and nothing was done: {shown}"


def _faults_of_ids(survey: SurveyParts) -> list[str]:
    from ladarreg_core.storage.replacement import is_file_name

    faults = [f"it has no {what}" for what in ("scans", "photos") if not getattr(survey, what)]
    for what in ("scans", "cameras", "photos", "ties", "lines"):
        ids = [one.id for one in getattr(survey, what)]
        faults += [f"{count} {what} have the id {name!r}" for name, count in Counter(ids).items() if count > 1]
        if what in ("ties", "lines"):
            continue
        faults += [
            f"the id {name!r:.60} of one of the {what} is no name of a file"
            for name in ids if not is_file_name(name) or "/" in name
        ]  # fmt: skip
    return faults


def _faults_of_references(survey: SurveyParts) -> list[str]:
    cameras = {one.id for one in survey.cameras}
    faults = [f"the photo {one.id} has the camera {one.camera!r:.60}, which is not listed"
              for one in survey.photos if one.camera not in cameras]  # fmt: skip
    places: Counter[tuple[str, str, str]] = Counter()
    for one in survey.photos:
        if one.rig is None:
            continue
        sensors = survey.rigs.get(one.rig.id)
        if sensors is None:
            faults.append(f"the photo {one.id} is of the rig {one.rig.id!r:.60}, which is not listed")
        elif one.rig.sensor not in sensors:
            faults.append(f"the photo {one.id} is of the sensor {one.rig.sensor!r:.60}, which its rig does not have")
        places[(one.rig.id, one.rig.frame, one.rig.sensor)] += 1
    photos = {one.id for one in survey.photos}
    for tie in survey.ties:
        faults += [f"the tie {tie.id} names the photo {name!r:.60}, which is not listed"
                   for name in tie.photos if name not in photos]  # fmt: skip
        if tie.photos[0] == tie.photos[1]:
            faults.append(f"the tie {tie.id} names the photo {tie.photos[0]!r:.60} twice; it needs two photos")
    faults += [f"{count} photos are of the rig {rig}, frame {frame}, sensor {sensor}"
               for (rig, frame, sensor), count in places.items() if count > 1]  # fmt: skip
    return faults


def _faults_of_values(survey: SurveyParts) -> list[str]:
    faults = []
    for camera in survey.cameras:
        if isinstance(camera.estimate, tuple):
            unknown = [name for name in camera.estimate if name not in INTRINSICS]
            if unknown:
                faults.append(
                    f"the camera {camera.id} is to have {', '.join(map(repr, unknown))} estimated; "
                    f"these can be: {', '.join(INTRINSICS)}"
                )
    for scan in survey.scans:
        stated = scan.world_from_scanner is not None or (
            isinstance(scan.source, Scan) and scan.source.world_from_scanner is not None
        )
        if scan.fixed and isinstance(scan.source, Scan) and not stated:
            faults.append(f"the scan {scan.id} is fixed, but its pose is not stated")
        if scan.targets is not None and scan.fixed:
            faults.append(
                f"the scan {scan.id} is fixed and has targets, which move it within their covariance; leave out one"
            )
    for tie in survey.ties:
        if not np.isfinite(tie.uv).all():
            faults.append(f"the tie {tie.id} has no place in one of its photos: its uv must be numbers")
        if not (np.isfinite(tie.sigma_px) and tie.sigma_px > 0):
            faults.append(f"the tie {tie.id} has the sigma_px {tie.sigma_px:g}; it must be positive")
    for photo in survey.photos:
        if photo.prior is not None and np.shape(photo.prior.covariance) != (6, 6):
            faults.append(f"the prior of the photo {photo.id} has a covariance that is not 6 x 6")
    return faults


def _faults_of_line(line: SurveyLine, survey: SurveyParts) -> list[str]:
    """Return what is wrong with a line, a clause each."""
    photos = {one.id for one in survey.photos}
    faults = [f"the line {line.id} names the photo {name!r:.60}, which is not listed"
              for name in line.photos if name not in photos]  # fmt: skip
    least = 1 if line.in_scan is not None else 2
    if len(line.photos) < least or len(set(line.photos)) < len(line.photos):
        faults.append(f"the line {line.id} must name {least} or more photos, each of them once")
    if len(line.uv) != len(line.photos) or not np.isfinite(line.uv).all():
        faults.append(f"the line {line.id} needs two pixels in each of its photos: its uv must be numbers")
    elif any(np.hypot(u - s, v - t) < MIN_LINE_PX for (u, v), (s, t) in line.uv):
        faults.append(f"the line {line.id} is shorter than {MIN_LINE_PX:g} px in one of its photos")
    if not (np.isfinite(line.sigma_px) and line.sigma_px > 0):
        faults.append(f"the line {line.id} has the sigma_px {line.sigma_px:g}; it must be positive")
    if line.in_scan is not None:
        if line.in_scan.scan not in {one.id for one in survey.scans}:
            faults.append(f"the line {line.id} names the scan {line.in_scan.scan!r:.60}, which is not listed")
        first, second = np.array(line.in_scan.xyz)
        if not np.linalg.norm(second - first) >= _MIN_LINE_M:  # also of what is no number
            faults.append(f"the line {line.id} is shorter than {1000 * _MIN_LINE_M:g} mm in its scan")
        if not (np.isfinite(line.in_scan.sigma_m) and line.in_scan.sigma_m > 0):
            faults.append(
                f"the line {line.id} has the sigma_m {line.in_scan.sigma_m:g} in its scan; it must be positive"
            )
    return faults
