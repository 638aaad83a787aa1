"""A simulated case as files, as an operator would have them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from ladarreg_core.errors import ExportError
from ladarreg_core.formats.camera_file import write_camera
from ladarreg_core.formats.json_file import write_json
from ladarreg_core.formats.npz import write_npz_counts
from ladarreg_core.formats.pose_file import POSE_FIELD
from ladarreg_core.photo import Photo
from ladarreg_core.simulate.case import SimulatedCase
from ladarreg_core.simulate.ladar import DR_M, GEOMETRY, R0_M
from ladarreg_core.thermal import centikelvin


def write_case(case: SimulatedCase, folder: Path | str) -> None:
    """Write `scan.npz` (counts form), `photo.png`, `camera.json` and `truth.json` into a folder, made where absent.

    A thermal photo is a gray PNG of 16 bits in centikelvin, as thermal cameras write it; a gamma photo one of 8 bits
    that counts photons, and its `truth.json` also has the sources as `hot_spots_m`.

    Args:
        case: what to write.
        folder: where to; files of these names are replaced.

    Raises:
        ExportError: if they cannot be written there.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        for name, write in case_files(case):
            write(target / name)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ExportError(
            f"the simulated case cannot be written to {target}: {reason}; choose a folder that can be written"
        ) from None


def case_files(case: SimulatedCase) -> list[tuple[str, Callable[[Path], None]]]:
    """Return the names of a case's files, and what writes each to a path."""
    truth: dict[str, Any] = {POSE_FIELD: case.camera_from_scanner.matrix.tolist(), "made_by": "simulate"}
    if case.hot_spots_m is not None:
        truth["hot_spots_m"] = case.hot_spots_m.tolist()

    def scan(path: Path) -> None:
        write_npz_counts(path, counts=case.counts, intensity=case.intensity, geometry=GEOMETRY, r0_m=R0_M, dr_m=DR_M)

    def photo(path: Path) -> None:
        path.write_bytes(_png_of(case.photo))

    return [
        ("scan.npz", scan),
        ("photo.png", photo),
        ("camera.json", lambda path: write_camera(path, case.photo.camera)),
        ("truth.json", lambda path: write_json(path, truth)),
    ]


def _png_of(photo: Photo) -> bytes:
    """Return a PNG: 8-bit colour, 8-bit gray where the channels are equal, or 16-bit centikelvin."""
    pixels = photo.pixels[..., ::-1]
    picture: NDArray[Any] = pixels[..., 0] if (pixels == pixels[..., :1]).all() else pixels
    if photo.temperature_k is not None:
        picture = centikelvin(photo.temperature_k)
    _, png = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return png.tobytes()
