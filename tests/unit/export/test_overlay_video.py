"""The overlay video of a rig: returns lie where the pose projects them, coloured by range, in bounded frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.camera import Camera, FisheyeCamera
from ladarreg_core.errors import OptionError
from ladarreg_core.export.overlay_video import (
    MAX_FRAMES,
    MAX_SIDE_PX,
    OverlayFrame,
    overlay_picture,
    write_overlay_video,
)
from ladarreg_core.frames import Rigid

POSE = Rigid(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3)
)  # the camera looks along the scanner's X axis


def frame(camera: Camera | FisheyeCamera, label: str = "a") -> OverlayFrame:
    """Return two walls of returns, 4 m and 20 m away, left and right of the middle, before a gray photograph."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(0.2, 1, 30), np.linspace(-0.5, 0.5, 30)))
    near = np.stack([np.full_like(y, 4.0), y, z], axis=-1)
    far = 5 * near * [1, -1, 1]
    points = np.concatenate([near, far])
    pixels = np.full((camera.height, camera.width, 3), 100, np.uint8)
    return OverlayFrame(lr.Scan.from_points(points), lr.Photo(pixels, camera, calibrated=True), label)


@pytest.mark.parametrize("camera", [
    Camera.from_focal(600, 400, 500.0), FisheyeCamera(600, 400, 300.0, 300.0, 299.5, 199.5),
])  # fmt: skip
def test_returns_are_drawn_where_they_project_and_the_rest_is_the_photograph(camera: Camera | FisheyeCamera) -> None:
    picture = overlay_picture(frame(camera), POSE, near_m=4, far_m=20).astype(int)
    drawn = (np.ptp(picture[:400], axis=-1) > 20).nonzero()
    u = drawn[1]
    left, _right = u[u < 300], u[u >= 300]
    expected = camera.project(POSE @ np.array([[4.0, 1.0, 0], [4.0, 0.2, 0]]))[:, 0]
    assert abs(left.min() - expected[0]) < 4
    assert abs(left.max() - expected[1]) < 4
    near, far = (picture[drawn][side].mean(axis=0) for side in (u < 300, u >= 300))
    assert near[0] > near[2], "yellow is near"
    assert far[2] > far[0], "blue is far"
    untouched = picture[:400][np.ptp(picture[:400], axis=-1) == 0]
    assert (untouched == 72).mean() > 0.99, "the photograph, dimmed"


def test_frames_are_bounded_in_number_and_size(tmp_path: Path) -> None:
    frames = [frame(Camera.from_focal(1600, 1000, 900.0), f"{k}") for k in range(3)]
    write_overlay_video(tmp_path / "a.webp", frames, POSE)
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.n_frames == 3  # type: ignore[attr-defined]
        assert max(picture.size) <= MAX_SIDE_PX
    many = [frame(Camera.from_focal(96, 64, 80.0))] * (MAX_FRAMES - 1) + [frame(Camera.from_focal(64, 96, 80.0))] * 9
    write_overlay_video(tmp_path / "b.webp", many, POSE)
    with Image.open(tmp_path / "b.webp") as picture:
        assert picture.n_frames <= MAX_FRAMES  # type: ignore[attr-defined]
        assert picture.size[0] == 96
    with pytest.raises(OptionError, match="no frames"):
        write_overlay_video(tmp_path / "c.webp", [], POSE)
