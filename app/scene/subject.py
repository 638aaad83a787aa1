"""The subject of the scene: scan, photograph and pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ladarreg_core.camera import Camera, CameraModel, axial_pinhole
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.viewpoints import (
    Viewpoint,
    from_pose,
    inside,
    is_all_around,
    overview,
    typical_range,
)
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View, perspective_view

_FRUSTUM_PX, _DEFAULT_FOCAL_PX = 512, 150.0
_FRUSTUM_DEPTH = 0.17  # per root of the range: nearer scenes need relatively longer ones


@dataclass(frozen=True, eq=False)
class ScanShown:
    """Data that depend on the scan alone: computed once, and kept while the scan is shown."""

    scan: Scan
    """The scan."""
    axis: FloatArray
    """(3,) direction of its first perspective view, unit."""
    name: str = ""
    """Which scan it is, whatever becomes of its ranges; empty: another one than any other."""

    def is_of(self, other: ScanShown) -> bool:
        """Return whether it is the same scan, though its ranges may have changed."""
        return self is other or bool(self.name and self.name == other.name)

    @cached_property
    def range_m(self) -> float:
        """The median range."""
        return typical_range(self.scan)

    @cached_property
    def all_around(self) -> bool:
        """Whether its content lies around the scanner."""
        return is_all_around(self.scan)

    @property
    def frustum_depth_m(self) -> float:
        """Depth of the drawn camera frusta, m."""
        return float(_FRUSTUM_DEPTH * self.range_m**0.5)


@dataclass(frozen=True, eq=False)
class CameraShown:
    """A photograph with an accepted pose, as a frustum with a small picture."""

    photo: str
    """Id of the photograph."""
    camera: CameraModel
    """Its intrinsics."""
    camera_from_scanner: Rigid
    """Its pose."""
    picture: ByteArray | None
    """(h, w, 3) uint8 RGB; None: an outline alone."""
    covariance: FloatArray | None = None
    """(3, 3) of its position, m^2; None: not known."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A scan, with a photograph and a pose if there are any."""

    shown: ScanShown
    """The scan."""
    photo: Photo | None = None
    """The photograph."""
    result: PoseResult | None = None
    """Pose of the photograph, accepted or not."""
    name: str = ""
    """Name of the photograph."""

    @property
    def scan(self) -> Scan:
        """The scan itself."""
        return self.shown.scan

    @property
    def scanner_centre(self) -> FloatArray:
        """(3,) position of the scanner, m."""
        return Rigid.identity().centre

    @property
    def accepted(self) -> PoseResult | None:
        """The pose if it is accepted, and may be shown as registered."""
        return self.result if self.result is not None and self.result.accepted else None

    @property
    def camera(self) -> CameraModel | None:
        """The photograph's camera, as estimated if there is a pose."""
        if self.result is not None:
            return self.result.camera
        return self.photo.camera if self.photo is not None else None

    @cached_property
    def view(self) -> View:
        """Perspective view of the scan, as the scanner's frustum shows it."""
        camera = self.camera
        if camera is None:
            return perspective_view(self.scan, Camera.from_focal(2, 2, _DEFAULT_FOCAL_PX), whole_scan=True)
        reduced = axial_pinhole(camera).scaled(min(1.0, _FRUSTUM_PX / max(camera.size)))
        return perspective_view(self.scan, reduced)

    def from_scanner(self) -> Viewpoint:
        """Return the viewpoint of the scanner, along the scan pane's picture if it looks all around."""
        if self.shown.all_around:
            return inside(self.scan, self.scanner_centre, self.shown.axis)
        return from_pose(self.scan, self.view.camera, self.view.view_from_scanner)

    def from_camera(self) -> Viewpoint | None:
        """Return the viewpoint of the camera; None without an accepted pose."""
        if self.accepted is None:
            return None
        return from_pose(self.scan, self.accepted.camera, self.accepted.camera_from_scanner)

    def overview(self) -> Viewpoint:
        """Return a viewpoint from the side that shows everything; a refused pose only if it is not far away."""
        result = self.result
        if result is not None and not result.accepted:
            scanner = Rigid.identity()
            result = result if result.camera_from_scanner.distance_to(scanner) <= self.shown.range_m else None
        return overview(self.scan, None if result is None else result.camera_from_scanner.centre)

    def start(self) -> Viewpoint:
        """Return the first viewpoint: along the camera if its pose is accepted, else along the scan pane's picture."""
        accepted = self.accepted
        pose = None if accepted is None else accepted.camera_from_scanner
        centre = self.scanner_centre if pose is None else pose.centre
        forward = self.shown.axis if pose is None else pose.rotation[2]
        if self.shown.all_around:
            return inside(self.scan, centre, forward)
        return overview(self.scan, None if pose is None else centre, forward=forward)
