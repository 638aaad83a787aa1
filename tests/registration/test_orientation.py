"""EXIF orientation beside a camera that was calibrated on the stored pixels: both turns have the same size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ladarreg_core as lr
from testing.scenes.simulated import simulated

_CUT = 80  # columns of the left that are cut off, so that the principal point is not in the middle
_EXIF_ORIENTATION = 274


@pytest.mark.slow
@pytest.mark.parametrize("calibrated_on", ["stored", pytest.param("upright", marks=pytest.mark.long)])
def test_a_camera_of_the_stored_or_of_the_upright_pixels_is_told_by_the_images(
    tmp_path: Path, calibrated_on: str
) -> None:
    case = simulated("office", seed=2)
    upright = case.photo.pixels[:, _CUT:]
    image = Image.fromarray(upright[::-1, ::-1])
    exif = image.getexif()
    exif[_EXIF_ORIENTATION] = 3
    image.save(tmp_path / "turned.png", exif=exif)
    height, width = upright.shape[:2]
    camera = case.photo.camera.as_fields() | {"width": width, "cx": case.photo.camera.cx - _CUT}
    if calibrated_on == "stored":
        camera |= {"cx": width - 1 - camera["cx"], "cy": height - 1 - camera["cy"]}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    photo = lr.read_photo(tmp_path / "turned.png", camera=tmp_path / "camera.json")
    result = lr.register(case.scan, photo)
    assert result.accepted, result.reasons
    assert abs(result.camera.cx - (case.photo.camera.cx - _CUT)) < _CUT / 8, "the other turn has it 80 px away"
    offset = result.camera_from_scanner.centre - case.camera_from_scanner.centre
    assert np.linalg.norm(offset) < 4 * result.sigma_position_m
