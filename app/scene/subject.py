"""The subject of the scene (scan, photograph and pose), and the level of detail that it is drawn with."""

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

_VERTICES, _COARSE_MESH_VERTICES, _DRAFT_VERTICES = 150_000, 60_000, 12_000
_TEXTURE_PX, _COARSE_MESH_TEXTURE_PX, _DRAFT_TEXTURE_PX = 8192, 1536, 1024
_FRUSTUM_PX, _DEFAULT_FOCAL_PX = 512, 150.0
_FRUSTUM_DEPTH = 0.17  # per root of the range: nearer scenes need relatively longer ones


@dataclass(frozen=True, slots=True)
class RenderChoice(ModelChoice):
    """Settings that the model is drawn with at this moment, including the level of detail."""

    draft: bool = False
    """True if a draft is drawn for now: as a first impression, or while something moves in the scene. Every movement
    redraws the model, which a browser without a graphics card can do 15 times a second only for a draft."""

    @property
    def most_vertices(self) -> int:
        """Largest number of vertices of the mesh."""
        return _DRAFT_VERTICES if self.draft else _COARSE_MESH_VERTICES if self.light else _VERTICES

    @property
    def most_texture_px(self) -> int:
        """Longer side of the texture."""
        return _DRAFT_TEXTURE_PX if self.draft else _COARSE_MESH_TEXTURE_PX if self.light else _TEXTURE_PX


@dataclass(frozen=True, eq=False)
class ScanShown:
    """Data that depend on the scan alone: computed once, and kept while the scan is shown."""

    scan: Scan
    """The scan."""

    meshes: dict[int, Mesh] = field(default_factory=dict, repr=False)
    """Meshes computed so far, by their largest number of vertices."""

    def mesh(self, choice: RenderChoice) -> Mesh:
        """Return the mesh, as fine as this choice allows."""
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
        """Depth of the drawn camera frusta, m."""
        return float(_FRUSTUM_DEPTH * self.range_m**0.5)


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
    def camera(self) -> Camera | None:
        """The photograph's camera, as estimated if there is a pose."""
        if self.result is not None:
            return self.result.camera
        return self.photo.camera if self.photo is not None else None

    @cached_property
    def registered(self) -> RegisteredTexture | None:
        """The photograph on the scan's grid; None without an accepted pose."""
        if self.accepted is None or self.photo is None:
            return None
        return registered_texture(self.scan, self.photo, self.accepted)

    @cached_property
    def view(self) -> View:
        """Perspective view of the scan, as the scanner's frustum shows it."""
        camera = self.camera
        if camera is None:
            return perspective_view(self.scan, Camera.from_focal(2, 2, _DEFAULT_FOCAL_PX), whole_scan=True)
        reduced = camera.without_distortion().scaled(min(1.0, _FRUSTUM_PX / max(camera.size)))
        return perspective_view(self.scan, reduced)

    def texture_kind(self, choice: RenderChoice) -> TextureKind:
        """Return the texture to show: the requested one if it is available."""
        kind = usable_texture(choice.texture, self.result)
        return "intensity" if kind in ("colour", "resolution", "label") and self.photo is None else kind

    def texture(self, choice: RenderChoice) -> ModelTexture:
        """Return the texture of the model."""
        kind = self.texture_kind(choice)
        needs_photo = kind in ("resolution", "label") or (kind == "colour" and choice.z_buffer)
        return model_texture(
            self.scan,
            kind,
            photo=self.photo,
            result=self.result,
            z_buffer=choice.z_buffer,
            registered=self.registered if needs_photo else None,
        )

    def from_scanner(self) -> Viewpoint:
        """Return the viewpoint of the scanner."""
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
