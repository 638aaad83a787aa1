"""A mosaic of the full turn is a scan like any other: across its seam and near its poles, too."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main

from ladarreg_core.acquisition.composition.mosaic_composition import compose_mosaic
from ladarreg_core.acquisition.simulated.recordings import SimulatedMosaic, simulate_mosaic
from ladarreg_core.camera import Camera
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.formats.parsing.json_file import write_json
from ladarreg_core.formats.scans.npz import write_npz_panorama
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_about
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from testing.scenes.mosaic_pieces import placed

pytestmark = pytest.mark.long
STEP = np.radians(0.3)
PIECE = AzimuthElevation(128, 183, STEP, STEP)
CAMERA = Camera(width=480, height=360, fx=390.0, fy=390.0, cx=239.5, cy=179.5)


@pytest.fixture(scope="module")
def made() -> SimulatedMosaic:
    pans, tilts = np.radians(np.arange(-180, 180, 45.0)), np.radians([-66.0, -33, 0, 33])
    return simulate_mosaic("office", 3, pans_rad=pans, tilts_rad=tilts, geometry=PIECE, angle_error_rad=0.0)


@pytest.fixture(scope="module")
def scan(made: SimulatedMosaic, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the panorama."""
    pieces = [placed(piece.scan, piece.world_from_scanner) for piece in made.pieces]
    composed = compose_mosaic(pieces)
    path = tmp_path_factory.mktemp("mosaic") / "scan.npz"
    write_npz_panorama(path, composed.scan, piece=composed.piece_of_cell)
    return path


@pytest.mark.parametrize(
    ("name", "azimuth", "elevation", "rough"),
    [
        ("nadir", 40, -80, True),
        ("seam", 180, -5, False),
    ],
)
def test_a_photograph_is_registered_and_exported(
    made: SimulatedMosaic, scan: Path, tmp_path: Path, name: str, azimuth: float, elevation: float, rough: bool
) -> None:
    turn = rotation_about("z", np.radians(azimuth)) @ rotation_about("y", -np.radians(elevation))
    rotation = CAMERA_AXES_FROM_SCANNER @ turn.T
    centre = np.array([0.1, 0.2, 0.1])
    true = Rigid(rotation, -rotation @ centre)
    room = made.bench.room
    photo = take_photograph(
        room, RayCaster(room.triangles), CAMERA, true, lighting=Lighting(), rng=np.random.default_rng(1)
    )
    write_png(tmp_path / "photo.png", photo)
    options = ["--focal-px", "390"]
    if rough:  # a floor of equal tiles: only where it was taken from tells one tile from the next
        near = Rigid.from_rotvec(np.radians([1.5, -2, 1]), [0.03, 0.02, -0.03]) @ true
        write_json(tmp_path / "near.json", {"camera_from_scanner": near.matrix.tolist()})
        options += ["--initial", str(tmp_path / "near.json")]
    out = tmp_path / "out"
    code = main(["register", str(scan), str(tmp_path / "photo.png"), *options, "-o", str(out), "--quiet"])
    written = json.loads((out / "registration.json").read_text())
    assert code == 0, (name, written["reasons"])
    matrix = np.array(written["camera_from_scanner"])
    found = Rigid(matrix[:3, :3], matrix[:3, 3])
    assert np.degrees(found.angle_to(true)) < 0.6
    assert found.distance_to(true) < 0.03
    for target in ("glb", "e57"):
        arguments = [
            str(out),
            "--scan",
            str(scan),
            "--photo",
            str(tmp_path / "photo.png"),
            "--to",
            target,
            "-o",
            str(tmp_path / target),
        ]
        assert main(["export", *arguments, "--quiet"]) == 0
        assert any((tmp_path / target).iterdir())
