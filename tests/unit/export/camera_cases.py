"""Registered photographs of every camera model, with truths that do not depend on any writer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.photo import Photo
from testing.scenes.small_registration import POSE, sample_registration, sample_scan

PINHOLE = (120, 90, 100.0, 101.0, 59.0, 45.0)
TILTED = Rigid(rotation_from_rotvec((0.05, -0.1, 0.4)) @ POSE.rotation, POSE.translation + 0.1)
CAMERAS: dict[str, CameraModel] = {
    "0 terms": Camera(*PINHOLE),
    "4 terms": Camera(*PINHOLE, (0.1, -0.02, 0.003, 0.001)),
    "5 terms": Camera(*PINHOLE, (0.1, -0.02, 0.003, 0.001, 0.004)),
    "8 terms": Camera(*PINHOLE, (0.1, -0.02, 0.003, 0.001, 0.004, 0.02, -0.003, 0.001)),
    "12 terms": Camera(*PINHOLE, (0.1, -0.02, 0, 0, 0, 0.02, 0, 0, 0.01, -0.003, 0.008, 0.002)),
    "fisheye": FisheyeCamera(160, 100, 60.0, 61.0, 80.0, 49.0, (0.02, -0.01, 0.003, -0.0004)),
    "equirectangular": EquirectangularCamera(360, 180),
    "window": EquirectangularCamera(200, 100, (-70.0, 40.0, 80.0, -35.0)),
}
WORLD = Rigid(rotation_from_rotvec((0.02, 0.01, 1.2)), np.array([431_234.567, 5_412_345.678, 412.3]))


def photograph(camera: CameraModel, photo_id: str, *, pose: Rigid = TILTED, given: bool = False) -> RegisteredPhoto:
    """Return a photograph whose colours are its pixels' positions: red about u, green about v."""
    width, height = camera.size
    v, u = np.mgrid[:height, :width]
    factor = 250 / max(width, height)
    pixels = np.rint(np.stack([factor * u, factor * v, 128 + 0 * u], axis=-1)).astype(np.uint8)
    registration = replace(sample_registration(), camera=camera, camera_from_scanner=pose)
    if given:
        registration = replace(registration, accepted=False, evidence="given")
    return RegisteredPhoto(photo_id, Photo(pixels, camera, name=f"Größe {photo_id}\n.jpg"), registration)


def handed_over(*photos: RegisteredPhoto, frame: FrameName = "scanner") -> RegisteredScan:
    """Return them with the sample's scan; its world has coordinates of millions of metres."""
    scan = replace(sample_scan(), world_from_scanner=WORLD)
    return RegisteredScan(scan, photos, frame=OutputFrame.of(scan, frame))


def scanner_points(handed: RegisteredScan) -> np.ndarray:
    """Return the returns of the scan (N, 3), scanner frame, float64."""
    return handed.scan.points[handed.scan.valid].astype(np.float64)


def world_points(handed: RegisteredScan) -> np.ndarray:
    """Return them as an exported file has them, by arithmetic of its own."""
    points = scanner_points(handed)
    if handed.frame.name == "scanner":
        return points
    return points @ WORLD.rotation.T + (WORLD.translation - np.array(handed.frame.offset_m))
