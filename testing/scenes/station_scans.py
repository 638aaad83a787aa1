"""Two stations in one furnished room, and a photograph taken there: small enough for the tests of the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.formats.cameras.camera_file import write_camera
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose

POSES = (upright_pose(np.array([-0.8, -0.4, 0.0]), 0.2), upright_pose(np.array([0.7, 0.6, 0.1]), -0.3))
"""Where the scanners stood in the room."""


def write_station_scans(folder: Path) -> tuple[list[Path], Path, Path]:
    """Write the scans, the photograph and its camera into a folder, and return their paths."""
    room = station_room("office", 3)
    paths = []
    for name, scan in zip(
        ("hall", "window"), scan_stations(room, POSES, seed=4, step_deg=0.4, width_deg=140), strict=True
    ):
        paths.append(folder / f"{name}.npz")
        write_npz_xyz(paths[-1], scan)
    camera = Camera(640, 480, 480.0, 480.0, 319.5, 239.5)
    in_room = Rigid.from_centre(look_along([1.0, 0.15, -0.05]), np.array([-0.6, -0.1, 0.1]))
    pixels = take_photograph(*room, camera, in_room, lighting=Lighting(), rng=np.random.default_rng(3))
    photo, camera_file = folder / "photo.png", folder / "camera.json"
    write_png(photo, pixels)
    write_camera(camera_file, camera)
    return paths, photo, camera_file
