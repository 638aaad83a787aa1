"""The 3-D stage in a real viser server, without a browser."""

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
from ladarreg.gateway.viser_backend import close_server
from ladarreg.scene import SimplexFrame, Stage3D
from ladarreg.scene.colours import ACCENT, BACKGROUND, MATCH_COLOURS, as_css
from ladarreg.scene.draw_queue import Wishes
from ladarreg.scene.legend import legend_html
from ladarreg.scene.picks_layer import Picks
from ladarreg.static_files import static_text

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.inspection.model_textures import Legend, model_texture
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from tests.open_viser import open_server

GEOMETRY = AzimuthElevation(40, 60, 0.01, 0.01)
CAMERA = Camera.from_focal(60, 40, 70)


def wall(*, x_m: float = 3.0) -> Scan:
    """A wall with a board before it, that hides some of it from a camera aside."""
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


class Session:
    """Keeps what was asked and answers as the workbench's does: by telling the stage."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.stage: Stage3D | None = None

    def set_model(self, **wanted: Any) -> None:
        self.asked.append(wanted)
        if wanted.get("light"):
            raise OptionError("no light here")
        assert self.stage is not None
        self.stage.set_model(**wanted)

    def job_control(self, action: str, value: float | None = None) -> None:
        self.asked.append((action, value))

    def hover(self, pick_id: str | None) -> None:
        self.asked.append(pick_id)


class Client:
    """Who clicked."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def add_notification(self, title: str, body: str, **_: object) -> None:
        self.told.append(body)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    opened = open_server(label="test")
    yield opened
    close_server(opened)


@pytest.fixture
def session() -> Session:
    return Session()


@pytest.fixture
def stage(server: viser.ViserServer, session: Session, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage3D]:
    monkeypatch.setattr("ladarreg.scene.model_layer.REPLACED_AFTER_S", 0.1)
    monkeypatch.setattr("ladarreg.scene.model_layer.REPLACED_BY_COARSE_AFTER_S", 0.1)
    monkeypatch.setattr("ladarreg.scene.scene.FINE_AGAIN_S", 0.1)
    server.scene.reset()
    server.gui.reset()
    session.stage = Stage3D(server, session)  # type: ignore[arg-type]
    yield session.stage
    session.stage.close()


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
        assert time.monotonic() < end, "it did not come to pass"
        time.sleep(0.02)


def gui(server: viser.ViserServer, label: str) -> Any:
    return next(h for h in server.gui._gui_input_handle_from_uuid.values() if getattr(h, "label", None) == label)


def press(handle: Any, value: object, client: Client) -> None:
    """Do what viser does when a browser changes a value."""
    handle._impl.value = value
    for callback in handle._impl.update_cb:
        callback(viser.GuiEvent(client, 1, handle))  # type: ignore[arg-type]


def click(server: viser.ViserServer, place: list[float]) -> None:
    """Do what viser does when somebody clicks in the scene, looking from one metre behind the scanner."""
    direction = (place[0] + 1.0, place[1], place[2])
    for entry in server.scene._scene_pointer_cb[-1:]:
        entry.callback(viser.SceneClickEvent(None, 1, (-1.0, 0, 0), direction, (0.5, 0.5), None))  # type: ignore[arg-type]


def test_what_stands_there_has_its_name(server: viser.ViserServer, stage: Stage3D) -> None:
    assert stage.settle()
    assert not models(server)
    stage.show_scan(SCAN)
    assert stage.settle()
    assert len(models(server)) == 1
    assert "/scanner" in nodes(server)
    assert not {"/camera", "/matches/points"} & set(nodes(server))
    stage.show_registration(SCAN, PHOTO, pose(), name="photo")
    assert stage.settle()
    assert {"/scanner", "/camera", "/matches/points", "/matches/scanner_rays", "/matches/camera_rays"} <= set(
        nodes(server)
    )
    assert isinstance(nodes(server)["/camera"], viser.CameraFrustumHandle)
    np.testing.assert_allclose(nodes(server)["/camera"].position, pose().camera_from_scanner.centre)
    stage.show_scan(None)
    assert stage.settle()
    assert not models(server)
    assert not {"/scanner", "/camera", "/matches/points"} & set(nodes(server))


def test_nothing_is_coloured_before_it_is_accepted(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_scan(SCAN)
    assert stage.settle()
    gray, count = glb(server), len(models(server))
    stage.show_registration(SCAN, PHOTO, pose(accepted=False), name="photo")
    assert stage.settle()
    assert glb(server) == gray
    assert len(models(server)) == count, "the same model is not sent again"
    assert not isinstance(nodes(server)["/camera"], viser.CameraFrustumHandle), "it would carry the photograph"
    label = nodes(server)["/camera_name"]
    assert isinstance(label, viser.LabelHandle)
    assert label.text == "photo: not accepted"
    stage.show_registration(SCAN, PHOTO, pose())
    assert stage.settle()
    assert glb(server) != gray
    assert "/camera_name" not in nodes(server)


def test_the_model_is_exchanged_and_its_predecessor_goes(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_registration(SCAN, PHOTO, pose())
    assert stage.settle()
    seen = {glb(server)}
    for wanted in ({"z_buffer": False}, {"texture": "label"}, {"texture": "range"}, {"texture": "uncertainty"}):
        stage.set_model(**wanted)  # type: ignore[arg-type]
        assert stage.settle()
        seen.add(glb(server))
        assert len(models(server)) == 1
    assert len(seen) == 5
    with pytest.raises(OptionError, match="one of colour"):
        stage.set_model(texture="glitter")


def test_of_many_wishes_few_are_drawn_and_always_the_last(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_registration(SCAN, PHOTO, pose())
    assert stage.settle()
    first = stage._model._count
    for k in range(100):
        stage.set_model(texture=("range", "label")[k % 2])
    stage.set_model(texture="intensity")
    assert stage.settle()
    assert stage._model._count - first < 30
    assert stage._model.legend == model_texture(SCAN, "intensity").legend


def test_another_scan_takes_everything_of_the_last_one_away(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_registration(SCAN, PHOTO, pose())
    stage.show_picks([[3, 0, 0]], [[1, 2, 3]], [True], ["p"])
    assert stage.settle()
    where = np.array(server.initial_camera.position)
    stage.show_scan(wall(x_m=9.0))
    wait(lambda: len(models(server)) == 1 and "/matches/points" not in nodes(server))
    assert stage.settle()
    assert "/camera" not in nodes(server)
    assert np.linalg.norm(server.initial_camera.position - where) > 0.5


def test_a_scan_without_surface_is_shown_as_points(server: viser.ViserServer, stage: Stage3D) -> None:
    ranges = np.full((40, 60), np.nan)
    ranges[::4, ::4] = 3.0
    stage.show_scan(Scan(GEOMETRY, ranges, np.ones((40, 60))))
    assert stage.settle()
    cloud = nodes(server)[models(server)[0]]
    assert isinstance(cloud, viser.PointCloudHandle)
    assert len(cloud.points) == np.isfinite(ranges).sum()


def test_switches_hide_and_show(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_registration(SCAN, PHOTO, pose())
    stage.set_model(cameras=False, matches=False)
    assert stage.settle()
    for name in ("/scanner", "/camera", "/matches/points", "/matches/scanner_rays"):
        assert not nodes(server)[name].visible, name
    stage.set_model(cameras=True, matches=True)
    assert stage.settle()
    for name in ("/scanner", "/camera", "/matches/points", "/matches/scanner_rays"):
        assert nodes(server)[name].visible, name


def test_picks_have_their_colours_and_answer_clicks(
    server: viser.ViserServer, stage: Stage3D, session: Session
) -> None:
    stage.show_registration(SCAN, PHOTO, None)
    points = np.array([[3, 0, 0], [np.nan, 0, 0], [3, 0.5, 0], [3, -0.5, 0]])
    colours = np.array(MATCH_COLOURS[:4], np.uint8)
    stage.show_picks(points, colours, [True, True, False, True], ["a", "b", "c", "d"])
    assert stage.settle()
    cloud: Any = nodes(server)["/matches/points"]
    np.testing.assert_allclose(cloud.points, points[[0, 2, 3]], atol=0.1)
    np.testing.assert_array_equal(cloud.colors[[0, 2]], colours[[0, 3]])
    assert cloud.colors[1].astype(int).sum() < colours[2].astype(int).sum(), "what is off is dimmed"
    click(server, [3, -0.5, 0])
    click(server, [3, 0.2, 0.4])
    assert session.asked == ["d"]
    stage.highlight("d")
    assert stage.settle()
    marked: Any = nodes(server)["/highlight/point"]
    np.testing.assert_allclose(marked.points, points[[3]], atol=0.12)
    for nobody in ("b", "nobody", None):
        stage.highlight(nobody)
        assert stage.settle()
        assert "/highlight/point" not in nodes(server)


def test_a_highlight_outlives_a_change_of_the_picks(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_scan(SCAN)
    stage.show_picks([[3, 0, 0]], [[9, 9, 9]], [True], ["a"])
    stage.highlight("a")
    stage.show_picks([[3, 0, 0], [3, 1, 0]], [[9, 9, 9]] * 2, [True, True], ["b", "a"])
    assert stage.settle()
    marked: Any = nodes(server)["/highlight/point"]
    np.testing.assert_allclose(marked.points, [[3, 1, 0]], atol=0.12)


def test_controls_ask_the_session_and_follow_it_without_a_loop(
    server: viser.ViserServer, stage: Stage3D, session: Session
) -> None:
    stage.show_registration(SCAN, PHOTO, pose())
    assert stage.settle()
    client = Client()
    press(gui(server, "Texture"), "Visibility class", client)
    press(gui(server, "Cameras"), False, client)
    assert stage.settle()
    assert session.asked == [{"texture": "label"}, {"cameras": False}]
    stage.set_model(texture="range", cameras=True, z_buffer=False)
    assert stage.settle()
    assert gui(server, "Texture").value == "Range"
    assert gui(server, "Cameras").value is True
    assert gui(server, "Z-buffer").value is False
    assert len(session.asked) == 2, "what the session says is not said back to it"
    press(gui(server, "Light model"), True, client)
    assert client.told == ["no light here"]


def frames(count: int) -> list[SimplexFrame]:
    there = [ThesisParameters(0.3 + 0.5 * 0.97**k, 0.1, 0.1, 0.1 * 0.95**k, 0, 0).pose for k in range(count)]
    return [SimplexFrame(k + 1, p, (p,) * 6, 10.0 * 0.9**k, "4 of 4 matches") for k, p in enumerate(there)]


def test_a_walk_is_throttled_and_its_last_step_kept(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_registration(SCAN, PHOTO, None)
    assert stage.settle()
    assert not stage._folder._folder.visible
    stage.simplex_started()
    assert stage.settle()
    assert stage._folder._folder.visible
    drawn: list[int] = []
    draw = stage._folder.draw
    stage._folder.draw = lambda curves, frame, state: (drawn.append(frame.iteration), draw(curves, frame, state))  # type: ignore[assignment, func-returns-value]
    walk = frames(400)
    begun = time.monotonic()
    for frame in walk:
        stage.simplex_step(frame)
        time.sleep(0.002)
    assert stage.settle()
    seconds = time.monotonic() - begun
    assert 2 <= len(drawn) <= seconds / 0.04 + 2
    assert drawn[-1] == 400
    assert drawn == sorted(drawn)
    assert stage._folder._parameters.data[0][-1] == 400
    np.testing.assert_allclose(nodes(server)["/simplex/best"].position, walk[-1].best.centre, atol=1e-5)
    lines: Any = nodes(server)["/simplex/vertices"]
    assert lines.points.shape == (48, 2, 3)
    assert "/simplex/start" in nodes(server)
    stage.simplex_ended(walk[-1])
    assert stage.settle()
    assert stage._folder._parameters.data[0][-1] == 400, "the last step is not told twice"
    assert {n for n in nodes(server) if n.startswith("/simplex/")} == {"/simplex/best"}
    assert "done" in stage._folder._status.content
    stage.show_registration(SCAN, PHOTO, pose())
    assert stage.settle()
    assert "/simplex/best" not in nodes(server), "the pose that is shown says it better"


def test_a_walk_that_came_to_nothing_leaves_nothing(server: viser.ViserServer, stage: Stage3D) -> None:
    stage.show_registration(SCAN, PHOTO, None)
    stage.simplex_started()
    stage.simplex_step(frames(1)[0])
    stage.simplex_ended(None)
    assert stage.settle()
    assert not {n for n in nodes(server) if n.startswith("/simplex/")}
    stage.simplex_paused(paused=True)
    assert stage.settle()
    assert not gui(server, "Walk").visible, "what has ended cannot be paused"


def test_the_model_is_coarse_while_something_moves(server: viser.ViserServer, stage: Stage3D) -> None:
    geometry = AzimuthElevation(150, 200, 0.004, 0.004)
    stage.show_registration(Scan(geometry, 3 / geometry.rays[..., 0], np.ones((150, 200))), PHOTO, None)
    assert stage.settle()
    fine = len(glb(server))
    stage.simplex_started()
    assert stage.settle()
    assert len(glb(server)) < 0.6 * fine
    stage.simplex_ended(None)
    assert stage.settle()
    assert len(glb(server)) == fine


def test_the_walks_controls_reach_the_job(server: viser.ViserServer, stage: Stage3D, session: Session) -> None:
    stage.simplex_started()
    assert stage.settle()
    client, buttons = Client(), gui(server, "Walk")
    for name in ("Pause", "Step", "Keep best"):
        press(buttons, name, client)
    stage.simplex_paused(paused=True)
    assert stage.settle()
    assert buttons.options == ("Resume", "Step", "Keep best")
    press(buttons, "Resume", client)
    stage.simplex_paused(paused=False)
    press(gui(server, "Steps a second"), 30, client)
    press(gui(server, "Steps a second"), 200, client)
    assert session.asked == [
        ("pause", None), ("step", None), ("stop", None), ("resume", None), ("speed", 30.0), ("speed", 0.0),
    ]  # fmt: skip


def test_frames_are_those_of_the_descent() -> None:
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
        assert f"of {len(step.inliers)} matches" in frame.said


def test_closing_leaves_no_thread(server: viser.ViserServer) -> None:
    before = set(threading.enumerate())
    server.gui.reset()
    other = Stage3D(server, Session())  # type: ignore[arg-type]
    other.show_registration(SCAN, PHOTO, pose())
    mine = [thread for thread in threading.enumerate() if thread.name == "stage3d" and thread not in before]
    assert len(mine) == 1
    other.close()
    assert not mine[0].is_alive()
    other.show_scan(None)
    other.close()


def test_one_failed_drawing_does_not_end_the_others(caplog: pytest.LogCaptureFixture) -> None:
    wishes, done = Wishes("test wishes"), threading.Event()

    def fail() -> None:
        raise ValueError("no luck")

    wishes.wish("a", fail)
    wishes.wish("b", done.set)
    assert wishes.settle(10)
    wishes.close()
    assert done.is_set()
    assert "no luck" in caplog.text


def test_wishes_wait_for_their_time_and_the_newest_wins() -> None:
    wishes, drawn = Wishes("test wishes"), []
    begun = time.monotonic()
    for k in range(50):
        wishes.wish("late", lambda k=k: drawn.append((k, time.monotonic() - begun)), after_s=0.15)  # type: ignore[misc]
    wishes.wish("never", lambda: drawn.append((-1, 0.0)), after_s=0.05)
    wishes.forget("never")
    assert wishes.settle(10)
    wishes.close()
    assert [k for k, _ in drawn] == [49]
    assert drawn[0][1] >= 0.15


class Tags(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.seen.append(tag)


def test_words_cannot_inject_html(server: viser.ViserServer, stage: Stage3D) -> None:
    attack = "<img src=x onerror=alert(1)>\"'&"
    tags = Tags()
    tags.feed(legend_html(Legend(attack, (((1, 2, 3), attack),), ((0, 0, 0),), attack, attack), attack))
    assert "img" not in tags.seen
    stage.simplex_started()
    stage.simplex_step(dataclasses.replace(frames(1)[0], said=attack))
    assert stage.settle()
    status = Tags()
    status.feed(stage._folder._status.content)
    assert "img" not in status.seen
    assert "&lt;img" in stage._folder._status.content


def test_picks_of_a_line_share_their_id() -> None:
    picks = Picks.of([[1, 0, 0], [2, 0, 0], [np.nan] * 3], [[1, 1, 1]] * 3, [True] * 3, ["l", "l", "m"])
    assert picks.ids == ("l", "l")


def test_the_colours_are_the_tokens() -> None:
    tokens = static_text("tokens.css")
    for k, colour in enumerate(MATCH_COLOURS, start=1):
        assert f"--lr-match-{k}: {as_css(colour)};" in tokens
    assert f"--lr-accent: {as_css(ACCENT)};" in tokens
    assert f"--lr-background: {as_css(BACKGROUND)};" in tokens


def test_a_pose_far_away_is_no_obstacle(server: viser.ViserServer, stage: Stage3D) -> None:
    far = dataclasses.replace(pose(), camera_from_scanner=Rigid(np.eye(3), [0.0, 0.0, 1e6]))
    stage.show_registration(SCAN, PHOTO, far)
    assert stage.settle()
    assert "/camera" in nodes(server)
