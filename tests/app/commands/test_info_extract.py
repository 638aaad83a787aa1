"""`ladarreg info --extract`: images of an E57 file are extracted, and never overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest
from ladarreg.cli import main

from ladarreg_core.formats.cameras.camera_file import read_camera


def test_embedded_images_are_extracted_with_their_cameras(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = real_data / "e57_fixtures" / "PinholeImageWithDistortionParameters.e57"
    assert main(["info", str(source), "--extract", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.count("extracted") >= 1
    pictures = list((tmp_path / "out").glob("*.jpg"))
    assert pictures
    assert all(picture.read_bytes()[:2] == b"\xff\xd8" for picture in pictures)
    assert read_camera(next((tmp_path / "out").glob("*.camera.json"))).focal_px > 0
    # A second time nothing is overwritten.
    assert main(["info", str(source), "--extract", str(tmp_path / "out")]) == 2
    assert "exists already" in capsys.readouterr().err
