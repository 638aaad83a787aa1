"""What is known of a photograph without its pixels, and how that is kept on disk."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError

if TYPE_CHECKING:
    from ladarreg_core.camera import CameraModel


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    """What is known of a photograph without its pixels, which need not be in memory."""

    width: int
    """Of its pixels."""
    height: int
    """Of its pixels."""
    is_thermal: bool
    """Whether its pixels are temperatures."""
    notes: tuple[str, ...]
    """Remarks on the file."""
    camera: CameraModel | None
    """Its camera; None: its focal length is unknown, or the camera does not fit."""
    calibrated: bool = False
    """Whether the camera comes from a calibration."""
    camera_error: str = ""
    """Why there is no camera."""


def header_fields(header: PhotoHeader) -> dict[str, Any]:
    """Return a header as it is kept on disk."""
    camera = None if header.camera is None else json.dumps(header.camera.as_fields())
    return {**asdict(replace(header, camera=None)), "notes": list(header.notes), "camera": camera}


def header_of(fields: Any) -> PhotoHeader | None:
    """Return a header that was kept; None: it is of another version."""
    from ladarreg_core.formats.cameras.camera_file import camera_from_fields

    if not isinstance(fields, dict):
        return None
    try:
        camera = None if fields["camera"] is None else camera_from_fields(json.loads(fields["camera"]))
        return PhotoHeader(**{**fields, "camera": camera, "notes": tuple(fields["notes"])})
    except (LadarregError, TypeError, KeyError, ValueError):
        return None
