"""The viewer shows the colours of the photograph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from ladarreg.gateway.viser_backend import close_server

from ladarreg_core.export.models.glb import glb_bytes
from ladarreg_core.foundations.palette import BACKGROUND
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.mesh.grid_mesh import scan_mesh
from testing.workbench.open_viser import address, open_server
from testing.workbench.pages import SIZE, wait_for_pixels

if TYPE_CHECKING:
    from playwright.sync_api import Page

PATCHES = np.array(
    [
        [(0, 0, 0), (32, 32, 32), (64, 64, 64), (96, 96, 96), (128, 128, 128), (160, 160, 160)],
        [(192, 192, 192), (224, 224, 224), (240, 240, 240), (128, 64, 64), (64, 128, 64), (64, 64, 128)],
        [(180, 140, 100), (90, 120, 150), (200, 180, 60), (120, 60, 140), (60, 150, 150), (210, 120, 110)],
        [(139, 69, 19), (85, 107, 47), (47, 79, 79), (222, 184, 135), (176, 196, 222), (105, 105, 105)],
    ],
    dtype=np.uint8,
)
_CELL = 12
_STEP_RAD = 0.008


@pytest.mark.slow
def test_colors_on_the_screen_are_within_three_levels(page: Page) -> None:
    rows, columns = PATCHES.shape[0] * _CELL, PATCHES.shape[1] * _CELL
    geometry = AzimuthElevation(rows, columns, _STEP_RAD, _STEP_RAD)
    wall = Scan(geometry, 2.0 / geometry.rays[..., 0], np.ones((rows, columns)))
    picture = np.repeat(np.repeat(PATCHES, _CELL, axis=0), _CELL, axis=1)

    server = open_server(label="colours")
    try:
        server.gui.configure_theme(dark_mode=True)
        server.scene.world_axes.visible = False
        server.scene.set_background_image(np.full((2, 2, 3), BACKGROUND, np.uint8), format="png")
        server.scene.add_glb("/wall", glb_bytes(scan_mesh(wall), picture, for_viser=True))
        fov = 0.75
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = (0.0, 0, 0), (2.0, 0, 0), fov

        focal = SIZE[1] / 2 / np.tan(fov / 2)
        centres = np.stack(np.mgrid[: PATCHES.shape[0], : PATCHES.shape[1]], axis=-1) * _CELL + (_CELL - 1) / 2
        ray = geometry.ray_at(centres)
        u = np.rint(SIZE[0] / 2 - focal * ray[..., 1] / ray[..., 0]).astype(int)
        v = np.rint(SIZE[1] / 2 - focal * ray[..., 2] / ray[..., 0]).astype(int)

        page.goto(address(server))
        shown = wait_for_pixels(
            page, lambda seen: bool(seen[20, SIZE[0] // 2].max() < 50 < seen[v[1, 1], u[1, 1]].min()), what="the wall"
        )
        error = np.abs(shown[v, u].astype(int) - PATCHES)
        assert error.max() <= 3, f"{error.max(axis=-1)} at\n{PATCHES[error.max(axis=-1) > 3]}"
        np.testing.assert_array_equal(shown[20, SIZE[0] // 2], BACKGROUND)
    finally:
        close_server(server)
