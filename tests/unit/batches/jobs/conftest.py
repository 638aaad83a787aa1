"""Jobs that are done quickly."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import ladarreg_core as lr
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.formats.scans.npz import write_npz_xyz
from testing.scenes.small_registration import sample_photo, sample_scan


@pytest.fixture
def jobs(tmp_path: Path) -> list[lr.Job]:
    """Three pairs that are refused quickly, of one scan, and one that cannot be read."""
    write_npz_xyz(tmp_path / "scan.npz", sample_scan())
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps(sample_photo().camera.as_fields()))
    photos = [tmp_path / f"p{k}.png" for k in range(3)]
    for k, path in enumerate(photos):
        write_png(path, sample_photo().pixels[:, ::-1] if k else sample_photo().pixels)
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(photos[0].read_bytes()[:900])
    return [
        lr.Job(id=path.stem, scan=tmp_path / "scan.npz", photos=(path,), options={"camera": camera})
        for path in (*photos, damaged)
    ]
