"""3D tiles and the GLB drawn by three.js: from the camera's place they show what the photograph shows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from ladarreg.gateway.viser_backend import close_server

from ladarreg_core.camera import Camera
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from testing.workbench.open_viser import address, open_server
from testing.workbench.pages import SIZE, wait_for_pixels
from tests.unit.export.test_tiles import POSES, all_tiles, photograph, uneven_room

if TYPE_CHECKING:
    from playwright.sync_api import Page

CAMERA = Camera(2560, 1440, 1900.0, 1900.0, 1279.5, 719.5)
SHOWN = np.s_[200:700, 100:800]  # beside the viewer's panels
Z_UP = (0.5**0.5, 0.5**0.5, 0.0, 0.0)  # w x y z: what viewers of 3D tiles apply to glTF
AS_IS = (1.0, 0.0, 0.0, 0.0)
X_FORWARD = (0.5, 0.5, -0.5, -0.5)  # undoes the root node of the GLB: forward is -Z in glTF, left -X, up Y


def pattern(size_px: int = 40) -> np.ndarray:
    """Return blurred noise: it is like itself at one place only."""
    width, height = CAMERA.size
    coarse = np.random.default_rng(4).integers(40, 215, (height // size_px, width // size_px, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))


@pytest.mark.long
def test_tiles_are_drawn_where_the_photograph_shows_them(page_3d: Page, tmp_path: Path) -> None:
    pixels = pattern()
    one = photograph(CAMERA, POSES[0], "photo", pixels=pixels)
    export_to(tmp_path / "out", RegisteredScan(uneven_room(), (one,)), ["tiles"])
    folder = tmp_path / "out" / "tiles"
    root = json.loads((folder / "tileset.json").read_text(encoding="utf-8"))["root"]
    leaves = [tile for tile, _ in all_tiles(root) if not tile.get("children")]
    expected = cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA)[SHOWN].reshape(-1)

    def likeness(seen: np.ndarray) -> float:
        return float(np.corrcoef(seen[SHOWN].reshape(-1), expected)[0, 1])

    server = open_server(label="tiles")
    try:
        server.scene.world_axes.visible = False
        camera, pose = server.initial_camera, one.camera_from_scanner
        camera.position, camera.up = tuple(pose.centre), tuple(-pose.rotation[1])
        camera.look_at = tuple(pose.centre + pose.rotation[2])
        camera.fov = float(2 * np.arctan(CAMERA.height / 2 / CAMERA.fy))
        page_3d.goto(address(server))
        for tiles in ([root], leaves):
            handles: list[Any] = []
            for tile in tiles:
                name, data = tile["content"]["uri"], (folder / tile["content"]["uri"]).read_bytes()
                handles.append(server.scene.add_glb(f"/{name.replace('.', '_')}", data, wxyz=Z_UP))
            wait_for_pixels(page_3d, lambda seen: likeness(seen) > 0.9, what="the tiles")
            for handle in handles:  # control: glTF's axes taken for the tile's
                handle.wxyz = AS_IS
            wait_for_pixels(page_3d, lambda seen: not likeness(seen) > 0.5, what="the tiles, lying on their side")
            for handle in handles:
                handle.remove()
    finally:
        close_server(server)


@pytest.mark.slow
def test_the_model_has_the_detail_of_the_photograph(page_3d: Page, tmp_path: Path) -> None:
    scan, pixels = uneven_room(), pattern(10)
    one = photograph(CAMERA, POSES[0], "photo", pixels=pixels)
    handed = RegisteredScan(scan, (one,))
    export_to(tmp_path / "out", handed, ["glb"])
    expected = cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA)[SHOWN].reshape(-1)
    cell_px = CAMERA.fx * min(scan.geometry.step_rad)
    by_cells = cv2.GaussianBlur(pixels, (0, 0), cell_px)  # a texel a cell, if that
    blurred = cv2.resize(by_cells, SIZE, interpolation=cv2.INTER_AREA)[SHOWN].reshape(-1)
    assert np.corrcoef(blurred, expected)[0, 1] < 0.6, "the control: detail of the scan's cells"

    server = open_server(label="model")
    try:
        server.scene.world_axes.visible = False
        camera, pose = server.initial_camera, one.camera_from_scanner
        camera.position, camera.up = tuple(pose.centre), tuple(-pose.rotation[1])
        camera.look_at = tuple(pose.centre + pose.rotation[2])
        camera.fov = float(2 * np.arctan(CAMERA.height / 2 / CAMERA.fy))
        page_3d.goto(address(server))
        server.scene.add_glb("/model", (tmp_path / "out" / "glb" / "model.glb").read_bytes(), wxyz=X_FORWARD)
        wait_for_pixels(
            page_3d,
            lambda seen: seen[SHOWN].std() > 0 and np.corrcoef(seen[SHOWN].reshape(-1), expected)[0, 1] > 0.85,
            what="the model with the photograph's own detail",
        )
    finally:
        close_server(server)
