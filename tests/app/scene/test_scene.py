"""The 3-D scene in a real viser server, without a browser."""

from __future__ import annotations

import dataclasses
import html.parser
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import viser
from ladarreg.gateway.pages import static_text
from ladarreg.gateway.viser_backend import close_server
from ladarreg.scene import Scene3D, SimplexFrame
from ladarreg.scene.draw_queue import DrawQueue
from ladarreg.scene.legend import legend_html
from ladarreg.scene.picks_layer import Picks

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.inspection.model_textures import Legend, model_texture
from ladarreg_core.matches import Matches
from ladarreg_core.palette import ACCENT, BACKGROUND, MATCHES, as_css
from ladarreg_core.photo import Photo
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from tests.open_viser import open_server

GEOMETRY = AzimuthElevation(40, 60, 0.01, 0.01)
CAMERA = Camera.from_focal(60, 40, 70)


def wall(*, x_m: float = 3.0) -> Scan:
    """A wall with a board in front, which hides part of it from a camera at the side."""
    depth = np.full((40, 60), x_m)
    depth[10:30, 20:35] = 0.6 * x_m
    return Scan(GEOMETRY, depth / GEOMETRY.rays[..., 0], np.random.default_rng(0).random((40, 60)))


SCAN = wall()
PHOTO = Photo(np.full((40, 60, 3), (200, 30, 30), np.uint8), CAMERA)


def pose(*, accepted: bool = True) -> PoseResult:
    rays = GEOMETRY.ray_at(np.array([[10, 10], [20, 30], [30, 50], [5, 40]], float))
    return PoseResult(
        camera_from_scanner=ThesisParameters(0.3, -0.05, 0.1, 0.1, -0.02, 0.01).pose,
        camera=CAMERA,
        matches=Matches(rays, 3 / rays[:, 0], np.ones((4, 2)), ("a", "b", "b", "c")),
        inliers=np.array([True, True, True, False]),
        residuals_px=np.full((4, 2), 0.3),
        residuals_m=np.zeros(4),
        stereo_depth_error_m=np.zeros(4),
        covariance=np.diag([1e-8] * 3 + [1e-6] * 3),
        chi2_per_dof=1.0,
        sigma_px=0.5,
        sigma_range_m=0.01,
        accepted=accepted,
        evidence="statistics" if accepted else "none",
    )


class Actions:
    """Records the actions, and answers as the workbench does: by calling the scene."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.scene: Scene3D | None = None

    def set_model(self, **wanted: Any) -> None:
        self.calls.append(wanted)
        if wanted.get("light"):
            raise OptionError("no light here")
        assert self.scene is not None
        self.scene.set_model(**wanted)

    def job_control(self, action: str, value: float | None = None) -> None:
        self.calls.append((action, value))

    def hover(self, pick_id: str | None) -> None:
        self.calls.append(pick_id)


class Client:
    """The client that clicked."""

    def __init__(self) -> None:
        self.notifications: list[str] = []

    def add_notification(self, title: str, body: str, **_: object) -> None:
        self.notifications.append(body)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    opened = open_server(label="test")
    yield opened
    close_server(opened)


@pytest.fixture
def actions() -> Actions:
    return Actions()


@pytest.fixture
def scene(server: viser.ViserServer, actions: Actions, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene3D]:
    monkeypatch.setattr("ladarreg.scene.model_layer.REPLACED_AFTER_S", 0.1)
    monkeypatch.setattr("ladarreg.scene.model_layer.REPLACED_BY_DRAFT_AFTER_S", 0.1)
    monkeypatch.setattr("ladarreg.scene.scene.FINE_AFTER_SIMPLEX_S", 0.1)
    server.scene.reset()
    server.gui.reset()
    actions.scene = Scene3D(server, actions)  # type: ignore[arg-type]
    yield actions.scene
    actions.scene.close()


def nodes(server: viser.ViserServer) -> dict[str, viser.SceneNodeHandle]:
    return {name: node for name, node in server.scene._handle_from_node_name.items() if not node._impl.removed}


def models(server: viser.ViserServer) -> list[str]:
    return [name for name in nodes(server) if name.startswith("/model/")]


def glb(server: viser.ViserServer) -> bytes:
    handle = nodes(server)[models(server)[-1]]
    assert isinstance(handle, viser.GlbHandle)
    return handle.glb_data


def wait(what: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.02)


def gui(server: viser.ViserServer, label: str) -> Any:
    return next(h for h in server.gui._gui_input_handle_from_uuid.values() if getattr(h, "label", None) == label)


def press(handle: Any, value: object, client: Client) -> None:
    """Do what viser does when a browser changes a value."""
    handle._impl.value = value
    for callback in handle._impl.update_cb:
        callback(viser.GuiEvent(client, 1, handle))  # type: ignore[arg-type]


def click(server: viser.ViserServer, place: list[float]) -> None:
    """Do what viser does on a click in the scene, viewed from one metre behind the scanner."""
    direction = (place[0] + 1.0, place[1], place[2])
    for entry in server.scene._scene_pointer_cb[-1:]:
        entry.callback(viser.SceneClickEvent(None, 1, (-1.0, 0, 0), direction, (0.5, 0.5), None))  # type: ignore[arg-type]


def test_nodes_have_their_names(server: viser.ViserServer, scene: Scene3D) -> None:
    assert scene.settle()
    assert not models(server)
    scene.show_scan(SCAN)
    assert scene.settle()
    assert len(models(server)) == 1
    assert "/scanner" in nodes(server)
    assert not {"/camera", "/matches/points"} & set(nodes(server))
    scene.show_registration(SCAN, PHOTO, pose(), name="photo")
    assert scene.settle()
    assert {"/scanner", "/camera", "/matches/points", "/matches/scanner_rays", "/matches/camera_rays"} <= set(
        nodes(server)
    )
    assert isinstance(nodes(server)["/camera"], viser.CameraFrustumHandle)
    np.testing.assert_allclose(nodes(server)["/camera"].position, pose().camera_from_scanner.centre)
    scene.show_scan(None)
    assert scene.settle()
    assert not models(server)
    assert not {"/scanner", "/camera", "/matches/points"} & set(nodes(server))


def test_nothing_is_coloured_without_an_accepted_pose(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_scan(SCAN)
    assert scene.settle()
    gray, count = glb(server), len(models(server))
    scene.show_registration(SCAN, PHOTO, pose(accepted=False), name="photo")
    assert scene.settle()
    assert glb(server) == gray
    assert len(models(server)) == count, "the same model is not sent again"
    assert not isinstance(nodes(server)["/camera"], viser.CameraFrustumHandle), "a frustum would show the photograph"
    label = nodes(server)["/camera_name"]
    assert isinstance(label, viser.LabelHandle)
    assert label.text == "photo: not accepted"
    scene.show_registration(SCAN, PHOTO, pose())
    assert scene.settle()
    assert glb(server) != gray
    assert "/camera_name" not in nodes(server)


def test_the_model_is_replaced_and_its_predecessor_removed(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_registration(SCAN, PHOTO, pose())
    assert scene.settle()
    seen = {glb(server)}
    for wanted in ({"z_buffer": False}, {"texture": "label"}, {"texture": "range"}, {"texture": "uncertainty"}):
        scene.set_model(**wanted)  # type: ignore[arg-type]
        assert scene.settle()
        seen.add(glb(server))
        assert len(models(server)) == 1
    assert len(seen) == 5
    with pytest.raises(OptionError, match="one of colour"):
        scene.set_model(texture="glitter")


def test_of_many_requests_few_are_drawn_and_always_the_last(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_registration(SCAN, PHOTO, pose())
    assert scene.settle()
    first = scene._model._count
    for k in range(100):
        scene.set_model(texture=("range", "label")[k % 2])
    scene.set_model(texture="intensity")
    assert scene.settle()
    assert scene._model._count - first < 30
    assert scene._model.legend == model_texture(SCAN, "intensity").legend


def test_another_scan_removes_everything_of_the_last_one(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_registration(SCAN, PHOTO, pose())
    scene.show_picks([[3, 0, 0]], [[1, 2, 3]], [True], ["p"])
    assert scene.settle()
    where = np.array(server.initial_camera.position)
    scene.show_scan(wall(x_m=9.0))
    wait(lambda: len(models(server)) == 1 and "/matches/points" not in nodes(server))
    assert scene.settle()
    assert "/camera" not in nodes(server)
    assert np.linalg.norm(server.initial_camera.position - where) > 0.5


def test_a_scan_without_surface_is_shown_as_points(server: viser.ViserServer, scene: Scene3D) -> None:
    ranges = np.full((40, 60), np.nan)
    ranges[::4, ::4] = 3.0
    scene.show_scan(Scan(GEOMETRY, ranges, np.ones((40, 60))))
    assert scene.settle()
    cloud = nodes(server)[models(server)[0]]
    assert isinstance(cloud, viser.PointCloudHandle)
    assert len(cloud.points) == np.isfinite(ranges).sum()


def test_switches_hide_and_show(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_registration(SCAN, PHOTO, pose())
    scene.set_model(cameras=False, matches=False)
    assert scene.settle()
    for name in ("/scanner", "/camera", "/matches/points", "/matches/scanner_rays"):
        assert not nodes(server)[name].visible, name
    scene.set_model(cameras=True, matches=True)
    assert scene.settle()
    for name in ("/scanner", "/camera", "/matches/points", "/matches/scanner_rays"):
        assert nodes(server)[name].visible, name


def test_picks_have_their_colours_and_are_clickable(
    server: viser.ViserServer, scene: Scene3D, actions: Actions
) -> None:
    scene.show_registration(SCAN, PHOTO, None)
    points = np.array([[3, 0, 0], [np.nan, 0, 0], [3, 0.5, 0], [3, -0.5, 0]])
    colours = np.array(MATCHES[:4], np.uint8)
    scene.show_picks(points, colours, [True, True, False, True], ["a", "b", "c", "d"])
    assert scene.settle()
    cloud: Any = nodes(server)["/matches/points"]
    np.testing.assert_allclose(cloud.points, points[[0, 2, 3]], atol=0.1)
    np.testing.assert_array_equal(cloud.colors[[0, 2]], colours[[0, 3]])
    assert cloud.colors[1].astype(int).sum() < colours[2].astype(int).sum(), "matches that are off are dimmed"
    click(server, [3, -0.5, 0])
    click(server, [3, 0.2, 0.4])
    assert actions.calls == ["d"]
    scene.highlight("d")
    assert scene.settle()
    marked: Any = nodes(server)["/highlight/point"]
    np.testing.assert_allclose(marked.points, points[[3]], atol=0.12)
    for nobody in ("b", "nobody", None):
        scene.highlight(nobody)
        assert scene.settle()
        assert "/highlight/point" not in nodes(server)


def test_a_highlight_survives_a_change_of_the_picks(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_scan(SCAN)
    scene.show_picks([[3, 0, 0]], [[9, 9, 9]], [True], ["a"])
    scene.highlight("a")
    scene.show_picks([[3, 0, 0], [3, 1, 0]], [[9, 9, 9]] * 2, [True, True], ["b", "a"])
    assert scene.settle()
    marked: Any = nodes(server)["/highlight/point"]
    np.testing.assert_allclose(marked.points, [[3, 1, 0]], atol=0.12)


def test_controls_call_actions_and_follow_the_state_without_a_loop(
    server: viser.ViserServer, scene: Scene3D, actions: Actions
) -> None:
    scene.show_registration(SCAN, PHOTO, pose())
    assert scene.settle()
    client = Client()
    press(gui(server, "Texture"), "Visibility class", client)
    press(gui(server, "Cameras"), False, client)
    assert scene.settle()
    assert actions.calls == [{"texture": "label"}, {"cameras": False}]
    scene.set_model(texture="range", cameras=True, z_buffer=False)
    assert scene.settle()
    assert gui(server, "Texture").value == "Range"
    assert gui(server, "Cameras").value is True
    assert gui(server, "Hide occluded").value is False
    assert len(actions.calls) == 2, "updates from the workbench are not sent back to it"
    press(gui(server, "Coarse mesh"), True, client)
    assert client.notifications == ["no light here"]


def frames(count: int) -> list[SimplexFrame]:
    there = [ThesisParameters(0.3 + 0.5 * 0.97**k, 0.1, 0.1, 0.1 * 0.95**k, 0, 0).pose for k in range(count)]
    return [SimplexFrame(k + 1, p, (p,) * 6, 10.0 * 0.9**k, "4 of 4 inliers") for k, p in enumerate(there)]


def test_simplex_drawing_is_throttled_and_its_last_frame_kept(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_registration(SCAN, PHOTO, None)
    assert scene.settle()
    assert not scene._folder._folder.visible
    scene.simplex_started()
    assert scene.settle()
    assert scene._folder._folder.visible
    drawn: list[int] = []
    draw = scene._folder.draw
    scene._folder.draw = lambda curves, frame, state: (drawn.append(frame.iteration), draw(curves, frame, state))  # type: ignore[assignment, func-returns-value]
    walk = frames(400)
    begun = time.monotonic()
    for frame in walk:
        scene.simplex_step(frame)
        time.sleep(0.002)
    assert scene.settle()
    seconds = time.monotonic() - begun
    assert 2 <= len(drawn) <= seconds / 0.04 + 2
    assert drawn[-1] == 400
    assert drawn == sorted(drawn)
    assert scene._folder._parameters.data[0][-1] == 400
    np.testing.assert_allclose(nodes(server)["/simplex/best"].position, walk[-1].best.centre, atol=1e-5)
    lines: Any = nodes(server)["/simplex/vertices"]
    assert lines.points.shape == (48, 2, 3)
    assert "/simplex/start" in nodes(server)
    scene.simplex_ended(walk[-1])
    assert scene.settle()
    assert scene._folder._parameters.data[0][-1] == 400, "the last frame is not added twice"
    assert {n for n in nodes(server) if n.startswith("/simplex/")} == {"/simplex/best"}
    assert "done" in scene._folder._status.content
    scene.show_registration(SCAN, PHOTO, pose())
    assert scene.settle()
    assert "/simplex/best" not in nodes(server), "the pose that is shown replaces it"


def test_a_simplex_without_result_leaves_nothing(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show_registration(SCAN, PHOTO, None)
    scene.simplex_started()
    scene.simplex_step(frames(1)[0])
    scene.simplex_ended(None)
    assert scene.settle()
    assert not {n for n in nodes(server) if n.startswith("/simplex/")}
    scene.simplex_paused(paused=True)
    assert scene.settle()
    assert not gui(server, "Simplex run").visible, "a finished simplex cannot be paused"


def test_the_model_is_a_draft_while_the_simplex_moves(server: viser.ViserServer, scene: Scene3D) -> None:
    geometry = AzimuthElevation(150, 200, 0.004, 0.004)
    scene.show_registration(Scan(geometry, 3 / geometry.rays[..., 0], np.ones((150, 200))), PHOTO, None)
    assert scene.settle()
    fine = len(glb(server))
    scene.simplex_started()
    assert scene.settle()
    assert len(glb(server)) < 0.6 * fine
    scene.simplex_ended(None)
    assert scene.settle()
    assert len(glb(server)) == fine


def test_the_simplex_controls_reach_the_job(server: viser.ViserServer, scene: Scene3D, actions: Actions) -> None:
    scene.simplex_started()
    assert scene.settle()
    client, buttons = Client(), gui(server, "Simplex run")
    for name in ("Pause", "Step", "Keep best"):
        press(buttons, name, client)
    scene.simplex_paused(paused=True)
    assert scene.settle()
    assert buttons.options == ("Resume", "Step", "Keep best")
    press(buttons, "Resume", client)
    scene.simplex_paused(paused=False)
    press(gui(server, "Steps per second"), 30, client)
    press(gui(server, "Steps per second"), 200, client)
    assert actions.calls == [
        ("pause", None), ("step", None), ("stop", None), ("resume", None), ("speed", 30.0), ("speed", 0.0),
    ]  # fmt: skip


def test_frames_agree_with_the_descent() -> None:
    from ladarreg_core.pose.thesis.stereo_simplex import SimplexOptions, descend

    rng = np.random.default_rng(4)
    result = pose()
    rays = GEOMETRY.ray_at(rng.uniform(0, 39, (20, 2)))
    ranges = rng.uniform(2, 5, 20)
    uv = CAMERA.project(result.camera_from_scanner @ (rays * ranges[:, None]))
    steps = list(descend(Matches(rays, ranges, uv), CAMERA, SimplexOptions(residual="epipolar")))
    for step in steps[:: max(1, len(steps) // 10)]:
        frame = SimplexFrame.of(step, iteration=7)
        assert frame.iteration == 7
        assert len(frame.others) == 6
        assert frame.best.angle_to(step.camera_from_scanner) < 1e-12
        assert frame.best.distance_to(step.camera_from_scanner) < 1e-12
        assert frame.cost == step.simplex.cost
        assert f"of {len(step.inliers)} inliers" in frame.note


def test_closing_leaves_no_thread(server: viser.ViserServer) -> None:
    before = set(threading.enumerate())
    server.gui.reset()
    other = Scene3D(server, Actions())  # type: ignore[arg-type]
    other.show_registration(SCAN, PHOTO, pose())
    mine = [thread for thread in threading.enumerate() if thread.name == "scene" and thread not in before]
    assert len(mine) == 1
    other.close()
    assert not mine[0].is_alive()
    other.show_scan(None)
    other.close()


def test_one_failed_drawing_does_not_end_the_thread(caplog: pytest.LogCaptureFixture) -> None:
    queue, done = DrawQueue("test"), threading.Event()

    def fail() -> None:
        raise ValueError("no luck")

    queue.request("a", fail)
    queue.request("b", done.set)
    assert queue.settle(10)
    queue.close()
    assert done.is_set()
    assert "no luck" in caplog.text


def test_requests_wait_for_their_time_and_the_latest_wins() -> None:
    queue, drawn = DrawQueue("test"), []
    begun = time.monotonic()
    for k in range(50):
        queue.request("late", lambda k=k: drawn.append((k, time.monotonic() - begun)), after_s=0.15)  # type: ignore[misc]
    queue.request("never", lambda: drawn.append((-1, 0.0)), after_s=0.05)
    queue.cancel("never")
    assert queue.settle(10)
    queue.close()
    assert [k for k, _ in drawn] == [49]
    assert drawn[0][1] >= 0.15


class Tags(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.seen.append(tag)


def test_text_cannot_inject_html(server: viser.ViserServer, scene: Scene3D) -> None:
    attack = "<img src=x onerror=alert(1)>\"'&"
    tags = Tags()
    tags.feed(legend_html(Legend(attack, (((1, 2, 3), attack),), ((0, 0, 0),), attack, attack), attack))
    assert "img" not in tags.seen
    scene.simplex_started()
    scene.simplex_step(dataclasses.replace(frames(1)[0], note=attack))
    assert scene.settle()
    status = Tags()
    status.feed(scene._folder._status.content)
    assert "img" not in status.seen
    assert "&lt;img" in scene._folder._status.content


def test_picks_of_a_line_share_their_id() -> None:
    picks = Picks.of([[1, 0, 0], [2, 0, 0], [np.nan] * 3], [[1, 1, 1]] * 3, [True] * 3, ["l", "l", "m"])
    assert picks.ids == ("l", "l")


def test_the_colours_are_the_style_tokens() -> None:
    tokens = static_text("tokens.css")
    for k, colour in enumerate(MATCHES, start=1):
        assert f"--lr-match-{k}: {as_css(colour)};" in tokens
    assert f"--lr-accent: {as_css(ACCENT)};" in tokens
    assert f"--lr-background: {as_css(BACKGROUND)};" in tokens


def test_a_distant_pose_is_drawn(server: viser.ViserServer, scene: Scene3D) -> None:
    far = dataclasses.replace(pose(), camera_from_scanner=Rigid(np.eye(3), [0.0, 0.0, 1e6]))
    scene.show_registration(SCAN, PHOTO, far)
    assert scene.settle()
    assert "/camera" in nodes(server)
