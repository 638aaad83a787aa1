"""A pose that came from elsewhere, judged by the pictures themselves."""

from __future__ import annotations

from ladarreg_core.frames import Rigid
from ladarreg_core.matching.aligner import Aligner
from ladarreg_core.matching.pyramid import photo_levels, scan_levels, working_camera
from ladarreg_core.matching.verification import GateOptions, Verification
from ladarreg_core.matching.views import viewing_directions
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view


def verify_pose(
    scan: Scan, photo: Photo, camera_from_scanner: Rigid, *, gate: GateOptions | None = None, seed: int = 0
) -> Verification | None:
    """Return whether regions of both pictures agree under a pose; None where there is too little to compare.

    Args:
        scan: the scan.
        photo: the photograph, with the camera that the pose was found with.
        camera_from_scanner: the pose.
        gate: what it must show.
        seed: of the points drawn.
    """
    working = working_camera(scan, photo.camera)
    direction = viewing_directions(scan, working, initial=camera_from_scanner)[0]
    view = perspective_view(scan, working, view_from_scanner=direction)
    aligner = Aligner(scan_levels(scan, view), photo_levels(photo, working), gate=gate or GateOptions(), seed=seed)
    return aligner.judge(camera_from_scanner)[0] if aligner.usable else None
