"""Camera models: pinhole (`Camera`), fisheye and equirectangular, behind one interface."""

from ladarreg_core.camera.equirectangular import EquirectangularCamera
from ladarreg_core.camera.faces import Face, axial_pinhole, cube_faces
from ladarreg_core.camera.fisheye import FisheyeCamera
from ladarreg_core.camera.model import (
    CameraModel,
    camera_from_json,
    camera_from_model_fields,
    describe_in_short,
    require_camera,
    require_pinhole,
)
from ladarreg_core.camera.pinhole import Camera

__all__ = [
    "Camera",
    "CameraModel",
    "EquirectangularCamera",
    "Face",
    "FisheyeCamera",
    "axial_pinhole",
    "camera_from_json",
    "camera_from_model_fields",
    "cube_faces",
    "describe_in_short",
    "require_camera",
    "require_pinhole",
]
