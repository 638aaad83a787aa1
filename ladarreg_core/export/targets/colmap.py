"""The target `colmap`: the photographs with their poses and the laser's points as a COLMAP reconstruction.

Next to it, if a lens has a distortion, stands the same with undistorted pictures, in the layout of COLMAP's
`image_undistorter`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ladarreg_core.camera import CameraModel, axial_pinhole
from ladarreg_core.export.photo_files import WrittenPhoto, shown_names
from ladarreg_core.export.registered_scan import Registered, RegisteredPhoto
from ladarreg_core.export.targets.colmap_files import (
    ColmapModel,
    colmap_parameters,
    write_cameras,
    write_images,
    write_points,
)
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.reconstruction import Reconstruction
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report
from ladarreg_core.storage.replacement import OFFSET_FILE

_FILES: tuple[tuple[str, Callable[[Path, ColmapModel], None]], ...] = (
    ("cameras", write_cameras),
    ("images", write_images),
    ("points3D", write_points),
)


def colmap_refusal(handed: Registered, options: ExportOptions) -> str | None:
    """Return a sentence if a camera has no model in COLMAP and cannot be undistorted to one."""
    del options
    found = [one for one in handed.photos if not has_colmap_camera(one)]
    if not found:
        return None
    return (
        f"{shown_names(found)} is a part of a panorama, and COLMAP's EQUIRECTANGULAR is the whole sphere; leave it "
        "out, export it to nerfstudio, or cut perspective views out of it"
    )


def colmap_files(handed: Registered, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the reconstruction, the pictures and, if a lens has a distortion, the undistorted reconstruction."""
    del options
    written = [WrittenPhoto(one, _colmap_camera(one), report=report) for one in handed.photos]
    jobs: list[FileJob] = [(f"images/{each.name}", each.write) for each in written]
    jobs += model_files("sparse/0", Reconstruction(handed, written, report))
    wide = [one for one in handed.photos if one.camera.as_panorama is not None]
    flat = [WrittenPhoto(one, axial_pinhole(one.camera), report=report) for one in handed.photos if one not in wide]
    if any(each.is_undistorted for each in flat):
        jobs += [(f"undistorted/images/{each.name}", each.write) for each in flat]
        jobs += model_files("undistorted/sparse", Reconstruction(handed, flat, report))
    if handed.frame.name == "world":
        jobs.append((OFFSET_FILE, handed.frame.write))
    return jobs


def model_files(folder: str, reconstruction: Reconstruction) -> list[FileJob]:
    """Return cameras, images and points3D of a reconstruction, binary and text."""

    def writer(write: Callable[[Path, ColmapModel], None]) -> Callable[[Path], None]:
        return lambda path: write(path, reconstruction.model)

    return [(f"{folder}/{name}{end}", writer(write)) for name, write in _FILES for end in (".bin", ".txt")]


def has_colmap_camera(one: RegisteredPhoto) -> bool:
    """Return whether a photograph can be written for COLMAP, as it is or undistorted."""
    return colmap_parameters(_colmap_camera(one)) is not None


def _colmap_camera(one: RegisteredPhoto) -> CameraModel:
    """Return the camera of the written picture: without its lens where COLMAP has none like it."""
    camera = one.camera
    pinhole = camera.as_pinhole
    if colmap_parameters(camera) is None and pinhole is not None:
        return pinhole.without_distortion()
    return camera
