"""The pose of a camera that stands where a client looks from in the 3-D scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.frames import Rigid

if TYPE_CHECKING:
    import viser


def viewer_pose(camera: viser.CameraHandle) -> Rigid | None:
    """Return `camera_from_scanner` of a viewer; None before its browser has reported where it looks from.

    viser's cameras look along z with y down, as photographs do, and its world is the scanner's frame.
    """
    try:
        wxyz, position = camera.wxyz, camera.position
    except (AssertionError, RuntimeError):
        return None
    from viser.transforms import SO3

    scanner_from_camera = np.asarray(SO3(np.asarray(wxyz, dtype=np.float64)).as_matrix())
    return Rigid.from_centre(scanner_from_camera.T, np.asarray(position, dtype=np.float64))
