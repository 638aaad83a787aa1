"""What stands on the stage, and how it is to be shown."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.model_textures import (
    ModelTexture,
    TextureKind,
    model_texture,
    registered_texture,
    usable_texture,
)
from ladarreg_core.inspection.viewpoints import Viewpoint, from_pose, overview, typical_range
from ladarreg_core.photo import Photo
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh import Mesh, scan_mesh
from ladarreg_core.surface.perspective import View, perspective_view
from ladarreg_core.surface.texture import RegisteredTexture

from .model_view import ModelChoice

_VERTICES, _LIGHT_VERTICES, _COARSE_VERTICES = 150_000, 60_000, 12_000
_TEXTURE_PX, _LIGHT_TEXTURE_PX, _COARSE_TEXTURE_PX = 8192, 1536, 1024
_FRUSTUM_PX, _COARSE_FOCAL_PX = 512, 150.0
_FRUSTUM_DEPTH = 0.17  # of the root of the range: nearer scenes need relatively larger ones


@dataclass(frozen=True, slots=True)
class ModelNow(ModelChoice):
    """How the model is shown at this moment."""

    coarse: bool = False
    """Whether a coarse model is wanted for now: as a first look, or since something moves in the scene. Every step
    draws the model again, which a browser without a graphics card does 15 times a second only where it is coarse."""

    @property
    def most_vertices(self) -> int:
        """Of the mesh."""
        return _COARSE_VERTICES if self.coarse else _LIGHT_VERTICES if self.light else _VERTICES

    @property
    def most_texture_px(self) -> int:
        """The longer side of its picture."""
        return _COARSE_TEXTURE_PX if self.coarse else _LIGHT_TEXTURE_PX if self.light else _TEXTURE_PX


@dataclass(frozen=True, eq=False)
class ScanShown:
    """What depends on the scan alone: made once, for as long as it stands on the stage."""

    scan: Scan
    """The scan."""

    meshes: dict[int, Mesh] = field(default_factory=dict, repr=False)
    """Made so far, by how many vertices they may have."""

    def mesh(self, choice: ModelNow) -> Mesh:
        """Return the model, as fine as this choice allows."""
        most = choice.most_vertices
        if most not in self.meshes:
            self.meshes[most] = scan_mesh(self.scan, max_vertices=most)
        return self.meshes[most]

    @cached_property
    def range_m(self) -> float:
        """The median range."""
        return typical_range(self.scan)

    @property
    def frustum_depth_m(self) -> float:
        """How long cameras are drawn."""
        return float(_FRUSTUM_DEPTH * self.range_m**0.5)


@dataclass(frozen=True, eq=False)
class Subject:
    """A scan, and where there are any a photograph and a pose."""

    shown: ScanShown
    """The scan."""
    photo: Photo | None = None
    """The photograph."""
    result: PoseResult | None = None
    """Its pose, accepted or not."""
    name: str = ""
    """What to call the photograph."""

    @property
    def scan(self) -> Scan:
        """The scan itself."""
        return self.shown.scan

    @property
    def scanner_centre(self) -> FloatArray:
        """(3,) the scanner's own place, m."""
        return Rigid.identity().centre

    @property
    def accepted(self) -> PoseResult | None:
        """The pose, if it may be shown as registered."""
        return self.result if self.result is not None and self.result.accepted else None

    @property
    def camera(self) -> Camera | None:
        """The photograph's camera, as estimated where it was."""
        if self.result is not None:
            return self.result.camera
        return self.photo.camera if self.photo is not None else None

    @cached_property
    def registered(self) -> RegisteredTexture | None:
        """The photograph on the scan's grid; None where nothing may be coloured by it."""
        if self.accepted is None or self.photo is None:
            return None
        return registered_texture(self.scan, self.photo, self.accepted)

    @cached_property
    def view(self) -> View:
        """The scan's intensity as the scanner's own frustum shows it."""
        camera = self.camera
        if camera is None:
            return perspective_view(self.scan, Camera.from_focal(2, 2, _COARSE_FOCAL_PX), whole_scan=True)
        reduced = camera.without_distortion().scaled(min(1.0, _FRUSTUM_PX / max(camera.size)))
        return perspective_view(self.scan, reduced)

    def texture_kind(self, choice: ModelNow) -> TextureKind:
        """Return what the model can show of what is wished."""
        kind = usable_texture(choice.texture, self.result)
        return "intensity" if kind in ("colour", "label") and self.photo is None else kind

    def texture(self, choice: ModelNow) -> ModelTexture:
        """Return what is painted on the model."""
        kind = self.texture_kind(choice)
        needs_it = kind == "label" or (kind == "colour" and choice.z_buffer)
        return model_texture(
            self.scan,
            kind,
            photo=self.photo,
            result=self.result,
            z_buffer=choice.z_buffer,
            registered=self.registered if needs_it else None,
        )

    def from_scanner(self) -> Viewpoint:
        """Return the scanner's own view."""
        return from_pose(self.scan, self.view.camera, self.view.view_from_scanner)

    def from_camera(self) -> Viewpoint | None:
        """Return the photograph's own view; None without an accepted pose."""
        if self.accepted is None:
            return None
        return from_pose(self.scan, self.accepted.camera, self.accepted.camera_from_scanner)

    def overview(self) -> Viewpoint:
        """Return a view from aside that holds all; a refused pose only if it lies nowhere absurd."""
        shown = self.result
        if shown is not None and not shown.accepted:
            scanner = Rigid.identity()
            shown = shown if shown.camera_from_scanner.distance_to(scanner) <= self.shown.range_m else None
        return overview(self.scan, None if shown is None else shown.camera_from_scanner.centre)
