"""The textured model at the resolution of the photographs.

Every triangle has one texture: the photograph itself where all its corners are seen, the laser intensity elsewhere. A
texture coordinate is the exact projection of its vertex, with the lens. Between the vertices a viewer interpolates
linearly over the triangle, while the projection of a plane is not linear, and less so with a lens; triangles are
therefore divided until the difference is a fraction of a pixel. They are cut where the frame of a photograph ends.

The model is a list of parts (`model_part.ModelPart`), each with vertices, normals, pixels of its picture, faces and the
rectangle of the picture that it uses. To divide a model by region, take `part.subset(wanted)` for masks of its faces:
the result is a part again, with its own, smaller rectangle. `part.tile.pixels(longest_px)` gives the texture, reduced
if it is longer than that; `part.uv` need not change for it. Pixels are taken from the photograph only then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.components import connected_components
from ladarreg_core.surface.mesh.facets import point_facets
from ladarreg_core.surface.mesh.grid_mesh import scan_mesh
from ladarreg_core.surface.mesh.model_part import LARGEST_TILE_PX, ModelPart, model_part
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.mesh.reduced_mesh import MAX_FACES, ReducedMesh, reduced_mesh
from ladarreg_core.surface.texture.registered_texture import COLORED, Label, dimmed_picture
from ladarreg_core.surface.texture.textured_triangles import LASER, SeenBy, TexturedTriangles

UV_ERROR_PX = 0.33
"""Largest error of a texture within a triangle, px of the photograph, unless the model states a larger one."""
_STAGES = 4
_MAX_FACETS = 1_000_000
_SPECK_CELLS = 8.0
_MAX_IN_SPECKS = 0.2
_REDUCED_TO = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class ModelPhoto:
    """A photograph as the texture of a model."""

    pixels: ByteArray
    """(h, w, 3) uint8 RGB."""
    camera: CameraModel
    """The camera that took it."""
    camera_from_scanner: Rigid
    """Its pose."""
    labels: ByteArray
    """(H, W) uint8, codes of `Label`: which cells it sees."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoModel:
    """A textured model: see the module's first lines for how to divide it."""

    parts: tuple[ModelPart, ...]
    """The parts; those of the laser intensity come last."""
    tolerance_m: float
    """Largest difference along the ray between the mesh and a measured range, m; 0: the mesh is not reduced."""
    uv_error_px: float
    """Largest error of a texture coordinate within a triangle, px of the photograph."""

    @property
    def faces(self) -> int:
        """Number of triangles."""
        return sum(len(part.faces) for part in self.parts)

    @property
    def vertices(self) -> int:
        """Number of vertices, those on the borders of parts counted for each."""
        return sum(len(part.vertices) for part in self.parts)


def photo_model(
    scan: Scan,
    photos: Sequence[ModelPhoto],
    best: IntArray | None = None,
    *,
    full: bool = False,
    crop: bool = False,
    on_grid: bool = False,
    most_faces: int = MAX_FACES,
    largest_tile_px: int = LARGEST_TILE_PX,
    report: Report | None = None,
) -> PhotoModel:
    """Return the surface of a scan with the photographs as its texture.

    Components smaller than a few cells, which float beside edges, are left out, unless `full`. A scan without a surface
    becomes small triangles at its points.

    Args:
        scan: the scan.
        photos: the photographs.
        best: (H, W) integers, the photograph that colours each cell, no index of one: none; None: the first that sees
            it.
        full: keep the whole mesh, whatever its size.
        crop: leave out what no photograph covers.
        on_grid: every triangle may have a picture on the scan's grid as its texture, too: `ModelPart.grid_uv`.
        most_faces: largest number of triangles, unless `full`.
        largest_tile_px: longer side of the largest texture.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        The model; without parts if it is cropped and no photograph covers any triangle.
    """
    say = _Stages(report)
    say("the mesh")
    chosen = _first_that_sees(photos, scan.shape)
    if best is not None:
        chosen = np.where((best >= 0) & (best < len(photos)), best, LASER).astype(np.int16)
    found = _mesh(scan, chosen, full=full, most_faces=most_faces)
    mesh = found.mesh
    say("the photographs' borders")
    row, column = mesh.places
    seen_by = [
        SeenBy(photo.camera, photo.camera_from_scanner, *_seen_and_beside(photo.labels[row, column]))
        for photo in photos
    ]
    triangles = TexturedTriangles(
        mesh.vertices,
        cell_normals(scan, np.stack(mesh.places, axis=-1)),
        mesh.cells,
        mesh.faces,
        seen_by,
        chosen[row, column],
    )
    triangles.cut_at_frames()
    triangles.assign()
    if crop:
        triangles.keep(triangles.owner != LASER)
    if not full:
        triangles.keep(_without_specks(triangles))
    say("the texture coordinates")
    error = triangles.refine(UV_ERROR_PX, most_faces=None if full else most_faces, on_grid=on_grid)
    say("the textures")
    parts: list[ModelPart] = []
    shape = scan.shape if on_grid else None
    for k, photo in enumerate(photos):
        parts += _parts(triangles, k, photo.pixels, k, largest_tile_px, shape)
    if (triangles.owner == LASER).any():
        parts += _parts(triangles, LASER, dimmed_picture(scan), None, largest_tile_px, shape)
    return PhotoModel(tuple(parts), found.tolerance_m, error)


class _Stages:
    """Reports one stage after the other."""

    def __init__(self, report: Report | None) -> None:
        self._report, self._done = report, 0

    def __call__(self, what: str) -> None:
        if self._report is not None:
            self._report(Progress(self._done, _STAGES, f"model: {what}"))
        self._done += 1


def _first_that_sees(photos: Sequence[ModelPhoto], shape: tuple[int, int]) -> IntArray:
    best = np.full(shape, LASER, np.int16)
    for k in range(len(photos) - 1, -1, -1):
        best[np.isin(photos[k].labels, COLORED)] = k
    return best


def _mesh(scan: Scan, groups: IntArray, *, full: bool, most_faces: int) -> ReducedMesh:
    if full:
        found = ReducedMesh(scan_mesh(scan, closed=True), 0.0)
    else:
        found = reduced_mesh(scan, most_faces=max(1000, int(_REDUCED_TO * most_faces)), groups=groups)
    if len(found.mesh.faces):
        return found
    return ReducedMesh(point_facets(scan, max_vertices=_MAX_FACETS), 0.0)


def _seen_and_beside(labels: ByteArray) -> tuple[BoolArray, BoolArray]:
    """Return which vertices a photograph sees, and which are only beside it."""
    return np.isin(labels, COLORED), labels == Label.OUT_OF_FRAME


def _without_specks(triangles: TexturedTriangles) -> BoolArray:
    """Return the triangles (F,) that are not in tiny components."""
    faces = triangles.faces
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    component = connected_components(edges, len(triangles.vertices))[faces[:, 0]]
    a, b, c = (triangles.cells.take(faces[:, k], axis=0) for k in range(3))
    areas = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    size = np.bincount(component, areas)
    kept: BoolArray = size[component] >= _SPECK_CELLS
    few = float(areas[~kept].sum()) < _MAX_IN_SPECKS * float(areas.sum())
    return kept if few else np.ones(len(faces), np.bool_)  # of a sparse scan, small components are all there is


def _parts(
    triangles: TexturedTriangles, owner: int, picture: ByteArray, photo: int | None, largest_px: int,
    shape: tuple[int, int] | None,
) -> list[ModelPart]:  # fmt: skip
    vertex, pixels, faces = triangles.textured(owner)
    if not len(faces):
        return []
    vertices: FloatArray = triangles.vertices.take(vertex, axis=0)
    normals: FloatArray = triangles.normals.take(vertex, axis=0)
    grid_uv = None
    if shape is not None:
        cells: FloatArray = triangles.cells.take(vertex, axis=0)[:, ::-1]
        grid_uv = ((cells + np.float32(0.5)) / np.array(shape[::-1], np.float32)).astype(np.float32)
    whole = model_part(vertices, normals, pixels, faces, picture=picture, photo=photo, grid_uv=grid_uv)
    return whole.divided(largest_px)
