"""A sweep that was composed and a photograph of the same room: registered like any other scan."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main

from ladarreg_core.acquisition.composition.sweep_composition import compose_sweeps
from ladarreg_core.acquisition.simulated.recordings import simulate_sweep
from ladarreg_core.camera import Camera
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_about, rotvec_from_rotation
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster

CENTRE = (0.3, 0.4, 0.1)


@pytest.mark.long
def test_a_photograph_is_registered_with_a_composed_sweep(tmp_path: Path) -> None:
    pans, rays = np.radians(np.arange(-90.0, 90.0, 0.5)), np.radians(np.arange(-60.0, 60.0, 0.25))
    recorded = simulate_sweep("office", 8101, pans_rad=pans, angles_rad=rays)
    made = compose_sweeps(recorded.sweeps, recorded.bench.mount, name="sweep")
    write_npz_xyz(tmp_path / "scan.npz", made.scan)
    camera = Camera(width=640, height=480, fx=576.0, fy=576.0, cx=319.5, cy=239.5)
    rotation = CAMERA_AXES_FROM_SCANNER @ rotation_about("z", np.radians(20.0)).T
    true = Rigid(rotation, -rotation @ np.array(CENTRE))
    room = recorded.bench.room
    photo = take_photograph(
        room, RayCaster(room.triangles), camera, true, lighting=Lighting(), rng=np.random.default_rng(1)
    )
    write_png(tmp_path / "photo.png", photo)
    out = tmp_path / "out"
    code = main([
        "register", str(tmp_path / "scan.npz"), str(tmp_path / "photo.png"), "--focal-px", "576", "-o", str(out)
    ])  # fmt: skip
    written = json.loads((out / "registration.json").read_text())
    assert code == 0, written["reasons"]
    assert written["accepted"]
    matrix = np.array(written["camera_from_scanner"])
    found = Rigid(matrix[:3, :3], matrix[:3, 3])
    turned = np.degrees(np.linalg.norm(rotvec_from_rotation(found.rotation @ true.rotation.T)))
    assert turned < 1.0
    assert np.linalg.norm(found.inverse.translation - CENTRE) < 0.1
