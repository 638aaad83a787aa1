"""The overview strip: its picture without a seam, and outlines of photographs on the scanned surface."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera, EquirectangularCamera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.inspection.panorama import photo_outline, strip_of, strip_picture
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid

CAMERA = Camera.from_focal(600, 400, 500.0)
STEP = float(np.radians(1.0))


def cylinder(radius_m: float = 4.0) -> Scan:
    """A round room; its intensity rises towards the left half of the turn."""
    grid = SphericalGrid(81, 360, STEP, STEP, 0.0, 40 * STEP)
    ranges = radius_m / np.hypot(grid.rays[..., 0], grid.rays[..., 1])
    light = np.where(grid.rays[..., 1] > 0, 2.0, 1.0) / ranges**2
    return Scan(grid, ranges.astype(np.float32), light.astype(np.float32))


def test_the_picture_closes_at_the_seam_and_has_left_on_the_left() -> None:
    picture = strip_picture(cylinder(), width=720)
    assert picture.shape[1] == 720
    inside = picture[6:-6].astype(int)
    assert inside.min() > 11 or np.ptp(inside[:, 400:]) < 20, "every direction of the strip has a return"
    assert inside[:, 20:340].mean() > inside[:, 380:700].mean() + 50
    rays = strip_of(cylinder()).directions(720)
    assert rays[0, 0, 2] > 0 > rays[-1, 0, 2]
    assert rays[40, 180, 1] > 0.5, "a quarter from the left border looks left"


@pytest.mark.parametrize("towards", [(1.0, 0.2, 0.1), (-1.0, 0.0, -0.1), (0.1, -1.0, 0.2)])
def test_an_outline_lies_where_the_camera_sees_the_surface(towards: tuple[float, float, float]) -> None:
    pose = Rigid.from_centre(look_along(towards), [0.3, -0.4, 0.2])
    scan = cylinder()
    rays = photo_outline(scan, CAMERA, pose)
    level = np.hypot(rays[:, 0], rays[:, 1])
    seen = CAMERA.project(pose @ (rays * (4.0 / level)[:, None]))  # the exact surface
    off = np.minimum.reduce(
        [abs(seen[:, 0] + 0.5), abs(seen[:, 0] - 599.5), abs(seen[:, 1] + 0.5), abs(seen[:, 1] - 399.5)]
    )
    assert off.max() < 12
    at_infinity = CAMERA.project(rays @ pose.rotation.T)
    assert np.abs(at_infinity - seen).max() > 15, "a control: the surface is near enough to matter"


def test_a_camera_that_looks_all_around_has_no_outline() -> None:
    assert len(photo_outline(cylinder(), EquirectangularCamera(400, 200), Rigid.identity())) == 0


def test_absurd_widths_are_refused() -> None:
    with pytest.raises(OptionError, match="1 px wide"):
        strip_picture(cylinder(), width=1)
