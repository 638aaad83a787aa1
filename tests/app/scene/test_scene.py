"""The 3-D scene in a real viser server, without a browser."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from ladarreg.gateway.page.folder import static_text
from ladarreg.gateway.viser_backend import close_server
from ladarreg.scene import CameraShown, Person, Picks, ScanShown, Scene3D, Shown, SimplexFrame, SmoothingShown, Subject
from ladarreg.scene.draw_queue import DrawQueue
from ladarreg.scene.model_view import ModelChoice
from ladarreg.scene.picks_layer import residual_colors

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.palette import ACCENT, BACKGROUND, BAD, MATCHES, WARN, as_css
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from testing.workbench.open_viser import open_server

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


AXIS = np.array([1.0, 0, 0])


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    opened = open_server(label="test")
    yield opened
    close_server(opened)


@pytest.fixture
def clicks() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def scene(server: viser.ViserServer, clicks: list[tuple[str, str]]) -> Iterator[Scene3D]:
    """A scene with one view, of Ann, drawn on the server."""
    server.scene.reset()
    opened = Scene3D(server, lambda person, pick: clicks.append((person, pick)))
    opened.add_view(1, server, "ann")
    opened.set_people({"ann": Person("p1")})
    yield opened
    opened.close()


def shown(result: PoseResult | None, *, scan: Scan = SCAN, picks: Picks | None = None) -> dict[str | None, Shown]:
    """Return what is shown of a scan alone, and of it with one photograph."""
    of_scan = ScanShown(scan, AXIS)
    return {None: Shown(Subject(of_scan)), "p1": Shown(Subject(of_scan, PHOTO, result, "photo"), picks)}


def drawn(scene: Scene3D, server: viser.ViserServer) -> dict[str, viser.SceneNodeHandle]:
    assert scene.settle()
    return {name: node for name, node in server.scene._handle_from_node_name.items() if not node._impl.removed}


def click(server: viser.ViserServer, place: list[float]) -> None:
    """Do what viser does on a click in the scene, viewed from one metre behind the scanner."""
    direction = (place[0] + 1.0, place[1], place[2])
    for entry in server.scene._scene_pointer_cb[-1:]:
        entry.callback(viser.SceneClickEvent(None, 1, (-1.0, 0, 0), direction, (0.5, 0.5), None))  # type: ignore[arg-type]


class Viewer:
    """A client of viser with a camera, drawn on the server."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.scene, self.atomic = server.scene, server.atomic
        self.camera = SimpleNamespace(aspect=1.0, position=np.zeros(3), look_at=AXIS)

    def faces(self, direction: np.ndarray) -> float:
        """Return the cosine between the horizontal viewing direction and another."""
        along = (np.asarray(self.camera.look_at) - self.camera.position)[:2]
        return float(along @ direction[:2] / np.linalg.norm(along) / np.linalg.norm(direction[:2]))


def test_everybody_shares_an_empty_node_for_the_model(server: viser.ViserServer, scene: Scene3D) -> None:
    model = drawn(scene, server)["/model"]
    assert isinstance(model, viser.GlbHandle)
    assert len(model.glb_data) < 3000, "the page fetches the model itself"


def test_the_frusta_of_all_accepted_photographs_stay(server: viser.ViserServer, scene: Scene3D) -> None:
    picture = np.full((20, 30, 3), 90, np.uint8)
    own, other = (CameraShown(name, CAMERA, pose().camera_from_scanner, picture) for name in ("p1", "p2"))
    scene.show(shown(pose()), [own, other])
    nodes = drawn(scene, server)
    assert "/camera" in nodes
    assert [name for name in nodes if name.startswith("/cameras/")] == ["/cameras/p2"], "one's own is drawn once"
    before = nodes["/cameras/p2"]
    scene.set_people({"ann": Person("p2")})
    assert [name for name in drawn(scene, server) if name.startswith("/cameras/")] == ["/cameras/p1"]
    scene.set_people({"ann": Person("p1", ModelChoice(cameras=False))})
    assert not drawn(scene, server)["/cameras/p2"].visible
    scene.show(shown(pose()), [own])
    assert not [name for name in drawn(scene, server) if name.startswith("/cameras/")]
    assert before._impl.removed


def test_the_frusta_without_pictures_are_one_node(server: viser.ViserServer, scene: Scene3D) -> None:
    picture = np.full((20, 30, 3), 90, np.uint8)
    own, *others = (
        CameraShown(name, CAMERA, pose().camera_from_scanner, shown)
        for name, shown in (("p1", picture), ("p2", None), ("p3", picture), ("p4", None))
    )
    scene.show(shown(pose()), [own, *others])
    nodes = drawn(scene, server)
    assert sorted(name for name in nodes if name.startswith("/cameras/")) == ["/cameras/outlines", "/cameras/p3"]
    assert nodes["/cameras/outlines"].points.shape == (2 * 8, 2, 3)
    scene.show(shown(pose()), [own, others[0]])
    assert drawn(scene, server)["/cameras/outlines"].points.shape == (8, 2, 3)
    scene.set_people({"ann": Person("p1", ModelChoice(cameras=False))})
    assert not drawn(scene, server)["/cameras/outlines"].visible
    scene.show(shown(pose()), [own])
    assert not [name for name in drawn(scene, server) if name.startswith("/cameras/")]


@pytest.mark.parametrize("pictured", [True, False])
def test_a_click_on_a_frustum_flies_to_its_photograph(server: viser.ViserServer, *, pictured: bool) -> None:
    server.scene.reset()
    chosen: list[tuple[str, str]] = []
    scene = Scene3D(server, lambda _person, _pick: None, on_camera=lambda *of: chosen.append(of))
    viewer = Viewer(server)
    scene.add_view(1, viewer, "ann")  # type: ignore[arg-type]
    scene.set_people({"ann": Person("p1")})
    picture = np.full((20, 30, 3), 90, np.uint8) if pictured else None
    other = CameraShown("p2", CAMERA, pose().camera_from_scanner, picture)
    scene.show(shown(pose()), [other])
    nodes = drawn(scene, server)
    if pictured:
        frustum = nodes["/cameras/p2"]
        forward = other.camera_from_scanner.rotation[2]
        at = other.camera_from_scanner.centre + frustum.scale * frustum.compute_canonical_frustum_size()[2] * forward
    else:
        at = nodes["/cameras/outlines"].points[4:8, 0].mean(axis=0)
    click(server, [-3.0, 1.0, 0.0])
    assert not chosen
    click(server, list(at))
    assert chosen == [("ann", "p2")]
    assert viewer.camera.position == pytest.approx(other.camera_from_scanner.centre)
    scene.close()


def test_nodes_have_their_names(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show(shown(None))
    nodes = drawn(scene, server)
    assert "/scanner" in nodes
    assert not {"/camera", "/matches/points"} & set(nodes)
    scene.show(shown(pose()))
    nodes = drawn(scene, server)
    assert {"/scanner", "/camera", "/matches/points"} <= set(nodes)
    assert not {"/matches/scanner_rays", "/matches/camera_rays"} & set(nodes), "rays are shown on demand"
    assert isinstance(nodes["/camera"], viser.CameraFrustumHandle)
    np.testing.assert_allclose(nodes["/camera"].position, pose().camera_from_scanner.centre)
    scene.set_people({"ann": Person("p1", ModelChoice(rays=True))})
    assert {"/matches/scanner_rays", "/matches/camera_rays"} <= set(drawn(scene, server))
    scene.show({})
    assert not {"/scanner", "/camera", "/matches/points"} & set(drawn(scene, server))


def test_a_refused_pose_is_a_dashed_outline(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show(shown(pose(accepted=False)))
    nodes = drawn(scene, server)
    assert not isinstance(nodes["/camera"], viser.CameraFrustumHandle), "a frustum would show the photograph"
    label = nodes["/camera_name"]
    assert isinstance(label, viser.LabelHandle)
    assert label.text == "photo: not accepted"
    scene.show(shown(pose()))
    assert "/camera_name" not in drawn(scene, server)


def test_each_person_sees_the_own_photograph_and_highlight(server: viser.ViserServer, scene: Scene3D) -> None:
    clients = {name: Viewer(server) for name in ("bob", "eve")}
    for viewer in clients.values():
        viewer.scene = type(server.scene)(
            server, thread_executor=server._thread_executor, event_loop=server._event_loop
        )
    scene.remove_view(1)
    for k, (name, viewer) in enumerate(clients.items()):
        scene.add_view(k, viewer, name)
    picks = Picks.of([[3, 0, 0]], [[255, 0, 0]], [True], ["a"])
    photos = shown(pose(), picks=picks)
    photos["p2"] = Shown(Subject(photos[None].subject.shown, PHOTO, None, "other"))
    scene.show(photos)
    scene.set_people({"bob": Person("p1"), "eve": Person("p2")})
    scene.highlight("bob", "a")
    assert scene.settle()
    bob, eve = (
        {name for name, node in viewer.scene._handle_from_node_name.items() if not node._impl.removed}
        for viewer in clients.values()
    )
    assert {"/scanner", "/camera", "/matches/points", "/highlight/point"} <= bob
    assert "/scanner" in eve
    assert not {"/camera", "/matches/points", "/highlight/point"} & eve


def test_a_camera_that_is_placed_by_hand_is_drawn_for_its_client_and_tells_where_it_is_dragged(
    server: viser.ViserServer,
) -> None:
    server.scene.reset()
    moves: list[tuple[str, Rigid]] = []
    scene = Scene3D(server, lambda _person, _pick: None, on_draft=lambda person, pose: moves.append((person, pose)))
    scene.add_view(1, server, "ann")
    scene.set_people({"ann": Person("p1")})
    scene.show(shown(None))
    placed = Rigid.from_centre(np.eye(3), [0.3, 0.2, 0.1])
    scene.place_camera("bob", placed)
    assert "/draft" not in drawn(scene, server), "another one places his"
    scene.place_camera("ann", placed)
    nodes = drawn(scene, server)
    assert "/draft/camera" in nodes
    np.testing.assert_allclose(nodes["/draft"].position, [0.3, 0.2, 0.1])
    further = Rigid.from_centre(np.eye(3), [0.5, 0.2, 0.1])
    scene.place_camera("ann", further)
    np.testing.assert_allclose(drawn(scene, server)["/draft"].position, [0.5, 0.2, 0.1])
    assert moves == [], "what the page itself has moved is not told to it"
    handle = nodes["/draft"]
    handle.position = (0.9, 0.0, 0.0)  # as a drag does before the callbacks
    for callback in handle._impl_aux.update_cb:  # type: ignore[attr-defined]
        callback(None)
    ((person, pose),) = moves
    assert person == "ann"
    np.testing.assert_allclose(pose.centre, [0.9, 0.0, 0.0], atol=1e-9)
    scene.place_camera("ann", None)
    assert not {"/draft", "/draft/camera"} & set(drawn(scene, server))
    scene.close()


def test_settings_are_checked() -> None:
    for wanted in ({"texture": "glitter"}, {"detail": "huge"}, {"smell": True}, {"rays": "yes"}):
        with pytest.raises(OptionError):
            ModelChoice().changed(wanted)
    assert ModelChoice().changed({"detail": "dense", "texture": "range"}).detail == "dense"
    assert not ModelChoice().rays


def test_switches_hide_and_show(server: viser.ViserServer, scene: Scene3D) -> None:
    names = ("/scanner", "/camera", "/matches/points", "/matches/scanner_rays")
    scene.show(shown(pose()))
    for visible in (False, True):
        scene.set_people({"ann": Person("p1", ModelChoice(cameras=visible, matches=visible, rays=True))})
        nodes = drawn(scene, server)
        for name in names:
            assert nodes[name].visible == visible, name


def test_picks_have_their_colors_and_are_clickable(
    server: viser.ViserServer, scene: Scene3D, clicks: list[tuple[str, str]]
) -> None:
    points = np.array([[3, 0, 0], [np.nan, 0, 0], [3, 0.5, 0], [3, -0.5, 0]])
    colors = np.array(MATCHES[:4], np.uint8)
    residuals = residual_colors([0.1, 1, np.nan, 4])
    picks = Picks.of(points, colors, [True, True, False, True], ["a", "b", "c", "d"], by_residual=residuals)
    scene.show(shown(None, picks=picks))
    cloud: Any = drawn(scene, server)["/matches/points"]
    np.testing.assert_allclose(cloud.points, points[[0, 2, 3]], atol=0.1)
    np.testing.assert_array_equal(cloud.colors[[0, 2]], colors[[0, 3]])
    assert cloud.colors[1].astype(int).sum() < colors[2].astype(int).sum(), "matches that are off are dimmed"
    click(server, [3, -0.5, 0])
    click(server, [3, 0.2, 0.4])
    assert clicks == [("ann", "d")]
    marked: Any = drawn(scene, server)["/highlight/point"]
    np.testing.assert_allclose(marked.points, points[[3]], atol=0.12)
    for nobody in ("b", "nobody", None):
        scene.highlight("ann", nobody)
        assert "/highlight/point" not in drawn(scene, server)
    scene.set_people({"ann": Person("p1", ModelChoice(residuals=True))})
    cloud = drawn(scene, server)["/matches/points"]
    np.testing.assert_array_equal(cloud.colors[[0, 2]], residuals[[0, 3]])
    assert len({tuple(color) for color in residuals.tolist()}) == 4


def test_a_highlight_survives_a_change_of_the_picks(server: viser.ViserServer, scene: Scene3D) -> None:
    scene.show(shown(None, picks=Picks.of([[3, 0, 0]], [[9, 9, 9]], [True], ["a"])))
    scene.highlight("ann", "a")
    scene.show(shown(None, picks=Picks.of([[3, 0, 0], [3, 1, 0]], [[9, 9, 9]] * 2, [True, True], ["b", "a"])))
    marked: Any = drawn(scene, server)["/highlight/point"]
    np.testing.assert_allclose(marked.points, [[3, 1, 0]], atol=0.12)


def test_the_view_begins_along_the_scan_and_follows_the_pose(server: viser.ViserServer, scene: Scene3D) -> None:
    viewer = Viewer(server)
    scene.remove_view(1)
    scene.add_view(2, viewer, "ann")
    photos = shown(None)
    scene.show(photos)
    assert scene.settle()
    assert viewer.faces(AXIS) > 0.9
    result = pose()
    photos = {**photos, "p1": Shown(Subject(photos[None].subject.shown, PHOTO, result, "photo"))}
    scene.show(photos)
    assert scene.settle()
    forward = result.camera_from_scanner.rotation[2]
    assert viewer.faces(forward) > 0.95, "along the camera, a little from the side"
    scene.look("ann", "camera")
    assert scene.settle()
    np.testing.assert_allclose(viewer.camera.position, result.camera_from_scanner.centre)
    better = dataclasses.replace(result, camera_from_scanner=ThesisParameters(0.4, 0, 0, 0.05, 0, 0).pose)
    photos = {**photos, "p1": Shown(Subject(photos[None].subject.shown, PHOTO, better, "photo"))}
    scene.show(photos)
    assert scene.settle()
    np.testing.assert_allclose(viewer.camera.position, better.camera_from_scanner.centre)
    viewer.camera.position = np.array([-5.0, 1, 2])
    scene.show({**photos, "p1": Shown(Subject(photos[None].subject.shown, PHOTO, result, "photo"))})
    assert scene.settle()
    np.testing.assert_array_equal(viewer.camera.position, [-5.0, 1, 2], "nobody is moved who has moved by himself")


@pytest.mark.parametrize("connected", [False, True])
def test_a_viewpoint_chosen_before_anything_is_drawn_is_not_lost(
    server: viser.ViserServer, scene: Scene3D, connected: bool
) -> None:
    viewer, result = Viewer(server), pose()
    scene.remove_view(1)
    if connected:
        scene.add_view(2, viewer, "ann")
        assert scene.settle()
    scene.look("ann", "camera")
    assert scene.settle()
    scene.show(shown(result))
    if not connected:
        scene.add_view(2, viewer, "ann")
    assert scene.settle()
    np.testing.assert_allclose(viewer.camera.position, result.camera_from_scanner.centre)


def test_a_scan_all_around_is_seen_from_inside_along_its_first_view(server: viser.ViserServer, scene: Scene3D) -> None:
    geometry = SphericalGrid(20, 180, 2 * np.pi / 180, 0.05, 0.0, 0.5)
    scan = Scan(geometry, np.full((20, 180), 4.0), np.ones((20, 180)))
    axis = np.array([-1.0, 0, 0])
    viewer = Viewer(server)
    scene.add_view(2, viewer, "ann")
    of_scan = ScanShown(scan, axis)
    scene.show({None: Shown(Subject(of_scan)), "p1": Shown(Subject(of_scan, PHOTO, None, ""))})
    assert scene.settle()
    assert viewer.faces(axis) > 0.999
    assert np.linalg.norm(viewer.camera.position) < 0.1
    scene.look("ann", "scanner")
    assert isinstance(drawn(scene, server)["/scanner"], viser.PointCloudHandle), "a frustum would show one direction"
    assert viewer.faces(axis) > 0.999


def frames(count: int) -> list[SimplexFrame]:
    there = [ThesisParameters(0.3 + 0.5 * 0.97**k, 0.1, 0.1, 0.1 * 0.95**k, 0, 0).pose for k in range(count)]
    return [SimplexFrame(k + 1, p, (p,) * 6, 10.0 * 0.9**k, "4 of 4 inliers") for k, p in enumerate(there)]


def simplex_nodes(scene: Scene3D, server: viser.ViserServer) -> set[str]:
    return {name for name in drawn(scene, server) if name.startswith("/simplex/")}


def test_the_last_frame_of_a_simplex_is_drawn_and_stays_until_there_is_a_pose(
    server: viser.ViserServer, scene: Scene3D
) -> None:
    scene.show(shown(None))
    scene.simplex_started("p1")
    walk = frames(200)
    for frame in walk:
        scene.simplex_step("p1", frame)
    nodes: Any = drawn(scene, server)
    np.testing.assert_allclose(nodes["/simplex/best"].position, walk[-1].best.centre, atol=1e-5)
    assert nodes["/simplex/vertices"].points.shape == (48, 2, 3)
    assert "/simplex/start" in nodes
    scene.simplex_ended("p1", walk[-1])
    assert simplex_nodes(scene, server) == {"/simplex/best"}
    scene.show(shown(pose()))
    assert not simplex_nodes(scene, server), "the pose that is shown replaces it"


def test_a_simplex_of_another_photograph_or_without_result_leaves_nothing(
    server: viser.ViserServer, scene: Scene3D
) -> None:
    scene.show(shown(None))
    scene.simplex_started("p2")
    scene.simplex_step("p2", frames(1)[0])
    assert not simplex_nodes(scene, server)
    scene.simplex_started("p1")
    scene.simplex_step("p1", frames(1)[0])
    assert simplex_nodes(scene, server)
    scene.simplex_ended("p1", None)
    assert not simplex_nodes(scene, server)


def test_frames_agree_with_the_descent() -> None:
    from ladarreg_core.thesis.estimators.stereo_simplex import SimplexOptions, descend

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
    other = Scene3D(server, lambda person, pick: None)
    other.show(shown(pose()))
    mine = [thread for thread in threading.enumerate() if thread.name == "scene" and thread not in before]
    assert len(mine) == 1
    other.close()
    assert not mine[0].is_alive()
    other.show({})
    other.close()


def test_one_failed_drawing_does_not_end_the_thread(caplog: pytest.LogCaptureFixture) -> None:
    queue, done = DrawQueue("test"), threading.Event()

    def fail() -> None:
        raise ValueError("no luck")

    queue.request("a", fail)
    queue.request("b", done.set)
    assert queue.settle(60)
    queue.close()
    assert done.is_set()
    assert "no luck" in caplog.text


def test_requests_wait_for_their_time_and_the_latest_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("ladarreg.scene.draw_queue.time", SimpleNamespace(monotonic=lambda: now))
    queue, drawn = DrawQueue("test"), list[int]()
    for k in range(50):
        queue.request("late", partial(drawn.append, k), after_s=0.15)
    queue.request("never", partial(drawn.append, -1), after_s=0.05)
    queue.cancel("never")
    for passed in range(2):
        now = 100.0 + 0.14 * passed
        at_once = threading.Event()
        queue.request("at once", at_once.set)
        assert at_once.wait(60)
        assert not drawn
    now = 100.15
    assert queue.settle(60)
    queue.close()
    assert drawn == [49]


def test_picks_of_a_line_share_their_id() -> None:
    picks = Picks.of([[1, 0, 0], [2, 0, 0], [np.nan] * 3], [[1, 1, 1]] * 3, [True] * 3, ["l", "l", "m"])
    assert picks.ids == ("l", "l")


def test_the_colors_are_the_style_tokens() -> None:
    tokens = static_text("tokens.css")
    for k, color in enumerate(MATCHES, start=1):
        assert f"--lr-match-{k}: {as_css(color)};" in tokens
    assert f"--lr-accent: {as_css(ACCENT)};" in tokens
    assert f"--lr-background: {as_css(BACKGROUND)};" in tokens


def test_a_distant_pose_is_drawn(server: viser.ViserServer, scene: Scene3D) -> None:
    far = dataclasses.replace(pose(), camera_from_scanner=Rigid(np.eye(3), [0.0, 0.0, 1e6]))
    scene.show(shown(far))
    assert "/camera" in drawn(scene, server)


@pytest.mark.slow
def test_points_of_a_run_are_drawn_in_place_of_the_model_and_seen_from_outside(
    server: viser.ViserServer, scene: Scene3D
) -> None:
    scene.remove_view(1)
    viewer = Viewer(server)
    scene.add_view(2, viewer, "ann")  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    sent = [rng.uniform(-3, 3, (6000, 3)).astype(np.float32) for _ in range(3)]
    for points in sent:
        scene.show_run(points, np.full(len(points), 200, np.uint8))
        assert scene.settle()
    nodes = drawn(scene, server)
    clouds = [node for name, node in nodes.items() if name.startswith("/run/")]
    assert len(clouds) == 2  # one is full, the other is being filled
    shown_points = np.concatenate([cloud.points for cloud in clouds])
    np.testing.assert_allclose(shown_points, np.concatenate(sent), atol=0.01)
    assert not nodes["/model"].visible
    assert np.linalg.norm(viewer.camera.position) > 3
    moved = viewer.camera.position = np.array([9.0, 9, 9])
    scene.show_run(sent[0], np.full(6000, 200, np.uint8))
    assert scene.settle()
    np.testing.assert_array_equal(viewer.camera.position, moved, "a view is moved once")
    scene.forget_run()
    nodes = drawn(scene, server)
    assert not any(name.startswith("/run/") for name in nodes)
    assert nodes["/model"].visible


def test_a_preview_of_smoothed_ranges_is_drawn_until_it_ends(server: viser.ViserServer, scene: Scene3D) -> None:
    before = np.array([[3.0, 0, 0], [4.0, 1, 0]])
    after = before * np.array([[1.5], [0.5]])
    edges = np.array([False, True])
    shown_ranges = {show: SmoothingShown(before, after, edges, show) for show in ("before", "after", "difference")}
    for show, points in (("before", before), ("after", after)):
        lines, colors = shown_ranges[show].lines()
        assert lines.reshape(2, 3, 2, 3).mean(axis=(1, 2)) == pytest.approx(points)
        assert colors.reshape(2, 3, 3).std(axis=1).max() == 0
        assert (colors[0] != colors[3]).any()
    lines, colors = shown_ranges["difference"].lines()
    assert lines[:2, 0] == pytest.approx(before, abs=1e-6)
    assert lines[:2, 1] == pytest.approx(after, abs=1e-6)
    assert (colors[:2] == np.array([BAD, WARN])).all()

    scene.set_people({"ann": Person("p1", smoothing=shown_ranges["difference"])})
    scene.show(shown(None))
    assert {"/smoothing/lines", "/smoothing/halo"} <= drawn(scene, server).keys()
    scene.set_people({"ann": Person("p1")})
    assert not [name for name in drawn(scene, server) if name.startswith("/smoothing/")]
