"""The viewer's server and panel, without a browser."""

from __future__ import annotations

import html.parser
import socket

import numpy as np
import pytest

from app.panel import panel_html
from app.scene import MATCH_COLORS, ModelLayer, Stage
from app.static_files import static_folder, static_text
from app.viser_server import HOST, address, close_server, open_server
from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import ThesisParameters
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.results import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.scanner import AzimuthElevation


def registration(*, accepted: bool, reasons: tuple[str, ...] = ()) -> Registration:
    return Registration(
        camera_from_scanner=ThesisParameters(0.612, -0.05, 0.12, 0.1, -0.02, 0.01).pose,
        camera=Camera.from_focal(60, 40, 70),
        matches=Matches(np.eye(3), np.full(3, 3.0), np.ones((3, 2))),
        inliers=np.array([True, True, False]),
        residuals_px=np.full((3, 2), 0.3),
        residuals_m=np.zeros(3),
        stereo_depth_error_m=np.zeros(3),
        covariance=np.diag([1e-8] * 3 + [1e-6] * 3),
        chi2_per_dof=1.0,
        sigma_px=0.5,
        sigma_range_m=0.01,
        accepted=accepted,
        evidence="image" if accepted else "none",
        reasons=reasons,
        method="auto",
    )


def stage(*, accepted: bool) -> Stage:
    geometry = AzimuthElevation(40, 60, 0.01, 0.01)
    wall = Scan(geometry, 3 / geometry.rays[..., 0], np.random.default_rng(0).random((40, 60)))
    photo = Photo(np.full((40, 60, 3), (200, 30, 30), np.uint8), Camera.from_focal(60, 40, 70))
    return Stage(wall, photo, registration(accepted=accepted))


def test_it_listens_on_loopback_only() -> None:
    server = open_server(port=8311, label="test")
    try:
        assert address(server) == f"http://127.0.0.1:{server.get_port()}"
        assert server.get_host() == HOST
        with socket.create_connection((HOST, server.get_port()), timeout=5):
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as other:
            other.bind(("127.0.0.2", server.get_port()))  # free: the server did not take every address
    finally:
        close_server(server)


def test_nobody_can_ask_for_a_public_address() -> None:
    server = open_server(port=8312, label="test")
    try:
        assert server.request_share_url() is None
        assert server._share_tunnel is None
    finally:
        close_server(server)


def test_a_busy_port_is_said_and_the_next_taken(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = open_server(port=port, label="test")
        try:
            assert server.get_port() != port
        finally:
            close_server(server)
    captured = capfd.readouterr()
    assert f"port {port} is busy" in captured.err
    assert captured.out == ""


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_an_impossible_port_is_refused(port: int) -> None:
    with pytest.raises(OptionError, match="port"):
        open_server(port=port, label="test")


class Tags(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.seen.append(tag)


def test_names_and_reasons_cannot_inject_html() -> None:
    attack = "<img src=x onerror=alert(1)>\"'&.npz"
    plain, hostile = Tags(), Tags()
    plain.feed(panel_html(registration(accepted=True, reasons=("fine",)), "scan", "photo"))
    text = panel_html(registration(accepted=True, reasons=(attack,)), attack, attack)
    hostile.feed(text)
    assert hostile.seen == plain.seen
    assert "img" not in hostile.seen
    assert text.count("&lt;img") == 3


def test_the_panel_tells_the_pose_only_where_it_is_accepted() -> None:
    accepted = panel_html(registration(accepted=True), "scan", "photo")
    rejected = panel_html(registration(accepted=False, reasons=("Too little.",)), "scan", "photo")
    assert "0.612" in accepted
    assert "0.61 m left, 0.05 m down, 0.12 m forward" in accepted
    assert "2 of 3 hold" in accepted
    assert "Not accepted" in rejected
    assert "Too little." in rejected
    assert "0.61" not in rejected


def test_nothing_is_coloured_before_it_is_accepted() -> None:
    assert stage(accepted=False).texture is None
    assert stage(accepted=False).glb(1.0) == stage(accepted=False).glb(0.0)
    assert stage(accepted=True).glb(1.0) != stage(accepted=True).glb(0.0)


def test_standpoints_look_at_the_scene() -> None:
    here = stage(accepted=True)
    for standpoint in (here.overview(), here.from_scanner(), here.from_camera()):
        forward = standpoint.look_at - standpoint.position
        assert forward[0] > 0
        assert abs(float(forward @ standpoint.up)) < np.linalg.norm(forward)
        assert 0.1 < standpoint.fov_rad < 2
    np.testing.assert_allclose(here.from_camera().position, [0.12, 0.612, -0.05], atol=1e-12)
    assert here.overview().position[0] < 0


class FakeServer:
    """Counts the models in the scene."""

    def __init__(self) -> None:
        self.models: list[str] = []
        self.scene = self

    def add_glb(self, name: str, data: bytes, **options: object) -> FakeHandle:
        self.models.append(name)
        return FakeHandle(self, name)


class FakeHandle:
    def __init__(self, server: FakeServer, name: str) -> None:
        self._server, self._name = server, name

    def remove(self) -> None:
        self._server.models.remove(self._name)


def test_only_the_newest_wish_is_drawn_and_the_old_model_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.scene._REPLACED_AFTER_S", 0.1)
    monkeypatch.setattr("app.scene._LEAST_INTERVAL_S", 0.01)
    server, drawn = FakeServer(), []

    class Watched(Stage):
        def glb(self, share: float) -> bytes:
            drawn.append(share)
            return b""

    layer = ModelLayer(server, Watched(*(getattr(stage(accepted=True), n) for n in ("scan", "photo", "registration"))))  # type: ignore[arg-type]
    layer.show(1.0)
    for share in np.linspace(0, 1, 200):
        layer.wish(float(share))
    layer.wish(0.5)
    for _ in range(100):
        if drawn[-1] == 0.5 and len(server.models) == 1:
            break
        layer._worker.join(timeout=0.05)
    layer.close()
    assert drawn[-1] == 0.5
    assert len(drawn) < 100
    assert len(server.models) == 1


def test_tokens_hold_the_colours_that_the_scene_uses() -> None:
    tokens = static_text("tokens.css")
    for k, color in enumerate(MATCH_COLORS, start=1):
        assert f"--lr-match-{k}: #{bytes(color).hex()};" in tokens
    assert "--lr-accent: #5cc8ff;" in tokens
    for name in ("tokens.css", "panel.css", "logo.svg"):
        assert (static_folder() / name).is_file()
