"""A simulated case as files, as an operator would have them."""

from __future__ import annotations

from pathlib import Path

import cv2

from ladarreg_core.errors import ExportError
from ladarreg_core.formats.camera_file import write_camera
from ladarreg_core.formats.npz import write_npz_counts
from ladarreg_core.formats.pose_file import write_pose
from ladarreg_core.simulate.case import SimulatedCase
from ladarreg_core.simulate.ladar import DR_M, GEOMETRY, R0_M


def write_case(case: SimulatedCase, folder: Path | str) -> None:
    """Write `scan.npz` (counts form), `photo.png`, `camera.json` and `truth.json` into a folder, made where absent.

    Args:
        case: what to write.
        folder: where to; files of these names are replaced.

    Raises:
        ExportError: if they cannot be written there.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        write_npz_counts(
            target / "scan.npz",
            counts=case.counts,
            intensity=case.intensity,
            geometry=GEOMETRY,
            r0_m=R0_M,
            dr_m=DR_M,
        )
        _, png = cv2.imencode(".png", case.photo.pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
        (target / "photo.png").write_bytes(png.tobytes())
        write_camera(target / "camera.json", case.photo.camera)
        write_pose(target / "truth.json", case.camera_from_scanner)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ExportError(
            f"the simulated case cannot be written to {target}: {reason}; choose a folder that can be written"
        ) from None
