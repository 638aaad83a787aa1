"""The 3-D scene as a browser shows it: colours, clicks on matches, and the moving simplex."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from ladarreg.gateway.viser_backend import close_server
from ladarreg.scene import Scene3D, SimplexFrame

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from tests.e2e.pages import wait_for_pixels
from tests.open_viser import address, open_server

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.slow

SIZE = (640, 480)
GEOMETRY = AzimuthElevation(60, 90, 0.01, 0.01)
WALL = Scan(GEOMETRY, 3 / GEOMETRY.rays[..., 0], np.ones((60, 90)))
CAMERA = Camera.from_focal(300, 200, 330.0)
POSE = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, [0.0, 0.2, 0.0])
COLOURS = np.array([(180, 140, 100), (64, 128, 64), (120, 60, 140), (128, 128, 128)], np.uint8)


class Session:
    """Records the actions."""

    def __init__(self) -> None:
        self.hovered: list[str | None] = []

    def set_model(self, **_: Any) -> None:
        """Not used here."""

    def job_control(self, action: str, value: float | None = None) -> None:
        """Not used here."""

    def hover(self, pick_id: str | None) -> None:
        self.hovered.append(pick_id)


@pytest.fixture
def session() -> Session:
    return Session()


@pytest.fixture
def shown(page: Page, session: Session) -> Iterator[Scene3D]:
    """A scene in a page of its own."""
    server = open_server(label="scene")
    scene = Scene3D(server, session)  # type: ignore[arg-type]
    page.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})
    page.goto(address(server) + "/?fixedDpr=0.5")
    page.get_by_text("Viewpoint").wait_for(timeout=60_000)
    yield scene
    scene.close()
    close_server(server)


def quarters() -> PoseResult:
    """An exact pose."""
    rays = GEOMETRY.ray_at(np.array([[10.0, 10], [20, 30], [30, 50], [5, 40]]))
    ranges = 3 / rays[:, 0]
    return PoseResult(
        camera_from_scanner=POSE,
        camera=CAMERA,
        matches=Matches(rays, ranges, CAMERA.project(POSE @ (rays * ranges[:, None]))),
        inliers=np.ones(4, bool),
        residuals_px=np.zeros((4, 2)),
        residuals_m=np.zeros(4),
        stereo_depth_error_m=np.zeros(4),
        covariance=np.diag([1e-9] * 6),
        chi2_per_dof=1.0,
        sigma_px=0.5,
        sigma_range_m=0.01,
        accepted=True,
        evidence="statistics",
    )


def photo_of_quarters() -> Photo:
    return Photo(np.kron(COLOURS.reshape(2, 2, 3), np.ones((100, 150, 1), np.uint8)), CAMERA)


def at(points: np.ndarray) -> np.ndarray:
    """Return the positions of points (N, 3) in the page, seen from the camera."""
    focal = min(SIZE[1] * 330 / 200, SIZE[0] * 330 / 300)
    seen = POSE @ points
    return np.rint(np.array(SIZE) / 2 + focal * seen[:, :2] / seen[:, 2:]).astype(int)


def test_the_model_has_the_photographs_colours_and_its_matches_can_be_touched(
    page: Page, shown: Scene3D, session: Session
) -> None:
    shown.set_model(cameras=False)
    shown.show_registration(WALL, photo_of_quarters(), quarters())
    places = np.array([[3, y, z] for z in (0.12, -0.12) for y in (0.32, 0.08)])
    picked = np.array([[3, 0.05, -0.25]])
    shown.show_picks(picked, [[255, 211, 77]], [True], ["p7"])
    assert shown.settle()
    page.get_by_text("Camera", exact=True).first.click()
    spots = at(places)

    def error(seen: np.ndarray) -> np.ndarray:
        return np.abs(seen[spots[:, 1], spots[:, 0]].astype(int) - COLOURS).max(axis=-1)

    seen = wait_for_pixels(page, lambda seen: bool((error(seen) < 60).all()), what="four colours")
    assert error(seen).max() <= 3, error(seen)

    u, v = at(picked)[0].tolist()
    assert np.abs(seen[v, u].astype(int) - [255, 211, 77]).max() <= 15, "the mark, blended at its edge"
    page.mouse.move(u + 1, v)
    page.wait_for_timeout(300)
    page.mouse.click(u, v)
    end = time.monotonic() + 20
    while not session.hovered and time.monotonic() < end:
        page.wait_for_timeout(50)
    assert session.hovered == ["p7"]


def test_the_curves_reach_the_last_step(page: Page, shown: Scene3D) -> None:
    shown.show_registration(WALL, photo_of_quarters(), None)
    shown.simplex_started()
    assert shown.settle()
    page.get_by_text("running").wait_for(timeout=30_000)
    frames = []
    for k in range(150):
        best = ThesisParameters(0.5 * 0.97**k, 0.1, 0.1, 0.1 * 0.95**k, 0.01, 0.02).pose
        frames.append(SimplexFrame(k + 1, best, (best,) * 6, 0.9**k))
    for frame in frames:
        shown.simplex_step(frame)
        page.wait_for_timeout(5)
    shown.simplex_ended(frames[-1])
    page.get_by_text("done").wait_for(timeout=30_000)
    charts = "Object.values(window.__viserTestpoints.uplots).map(o => o.chart)"
    ends = f"{charts}.map(c => c.data.map(column => column.at(-1)))"
    page.wait_for_function(f"() => {ends}.every(end => end[0] === 150)")
    last = page.evaluate(ends)
    drawn = page.evaluate(f"{charts}.map(c => [c.scales.x.min, c.scales.x.max])")
    assert drawn == [[1, 150], [1, 150]]
    assert len(last) == 2
    parameters = frames[-1].parameters
    assert last[0][1:4] == pytest.approx([parameters.Tx, parameters.Ty, parameters.Tz])
    assert last[1][1] == pytest.approx(149 * np.log10(0.9))
