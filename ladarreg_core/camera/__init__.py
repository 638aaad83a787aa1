"""Camera models."""

from ladarreg_core.camera.pinhole import Camera

__all__ = ["Camera"]
