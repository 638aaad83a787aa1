"""Camera models: pinhole (`Camera`), fisheye and equirectangular, behind one interface."""

from ladarreg_core.camera.equirectangular import EquirectangularCamera
from ladarreg_core.camera.fisheye import FisheyeCamera
from ladarreg_core.camera.model import CameraModel, camera_from_model_fields
from ladarreg_core.camera.pinhole import Camera

__all__ = ["Camera", "CameraModel", "EquirectangularCamera", "FisheyeCamera", "camera_from_model_fields"]
