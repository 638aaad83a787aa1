"""The triangles of a mesh that a camera sees, with the photograph as their texture."""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import Mesh
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.texture.photo_model import UV_ERROR_PX, ModelPhoto
from ladarreg_core.surface.texture.registered_texture import COLORED, Label
from ladarreg_core.surface.texture.textured_triangles import SeenBy, TexturedTriangles

_STEPS_PER_PX = 16
_WORTH_WHILE = 1.2  # times the detail of the scan's cells


def shows_more_detail(scan: Scan, camera: CameraModel, *, photo_px: int, texture_px: int) -> bool:
    """Return whether a photograph of `photo_px` pixels shows more than a texture with a texel a cell.

    Args:
        scan: the scan.
        camera: the photograph's camera.
        photo_px: the photograph is shown with at most so many pixels on its longer side.
        texture_px: the texture has at most so many texels on its longer side.
    """
    of_photo = camera.focal_px * min(1.0, photo_px / max(camera.size))
    of_texture = min(1.0, texture_px / max(scan.shape)) / max(scan.geometry.step_rad)
    return of_photo > _WORTH_WHILE * of_texture


def photo_layer(scan: Scan, mesh: Mesh, photo: ModelPhoto, *, shown_px: int, most_faces: int) -> Mesh:
    """Return the triangles that a camera sees, divided where the photograph would be distorted within them.

    They lie in the triangles of the mesh, and are drawn over it.

    Args:
        scan: the scan.
        mesh: its surface.
        photo: the photograph.
        shown_px: the photograph is shown with at most so many pixels on its longer side.
        most_faces: largest number of triangles that the division may lead to; the texture errs more then.

    Returns:
        A mesh whose cells are places in the photograph, in sixteenths of its pixels, so that its texture coordinates
        are those of the photograph. Columns lie beyond the picture where a triangle crosses the seam of a panorama.
        It has no faces if the camera sees no triangle.
    """
    places = mesh.places
    labels = photo.labels[places]
    seen = np.isin(labels, COLORED)
    seen_by = SeenBy(photo.camera, photo.camera_from_scanner, seen, labels == Label.OUT_OF_FRAME)
    best = np.where(seen, 0, -1)
    triangles = TexturedTriangles(
        mesh.vertices, cell_normals(scan, np.stack(places, axis=-1)), mesh.cells, mesh.faces, [seen_by], best
    )
    triangles.cut_at_frames()
    triangles.assign()
    triangles.keep(triangles.owner == 0)
    width, height = photo.camera.size
    scale = max(1.0, max(width, height) / shown_px)
    triangles.refine(UV_ERROR_PX * scale, most_faces=most_faces)
    vertex, pixels, faces = triangles.textured(0)
    cells = np.rint((pixels[:, ::-1] + 0.5) * _STEPS_PER_PX - 0.5).astype(np.int32)
    return Mesh(triangles.vertices[vertex], faces, cells, (height * _STEPS_PER_PX, width * _STEPS_PER_PX))
