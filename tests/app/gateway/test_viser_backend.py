"""The locked viser server."""

from __future__ import annotations

import socket

from ladarreg.gateway.page.folder import static_folder, static_text
from ladarreg.gateway.viser_backend import HOST, close_server, open_locked_server

from ladarreg_core.foundations.palette import MATCHES


def test_it_listens_on_loopback_only() -> None:
    server, address = open_locked_server(label="test")
    try:
        assert (address.host, address.port) == (HOST, server.get_port())
        assert server.get_host() == HOST == "127.0.0.1"
        with socket.create_connection((HOST, server.get_port()), timeout=60):
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as other:
            other.bind(("127.0.0.2", server.get_port()))  # free: the server did not take every address
    finally:
        close_server(server)


def test_a_public_address_is_refused() -> None:
    server, _ = open_locked_server(label="test")
    try:
        assert server.request_share_url() is None
        assert server._share_tunnel is None
    finally:
        close_server(server)


def test_the_style_tokens_contain_the_scenes_colors() -> None:
    tokens = static_text("tokens.css")
    for k, color in enumerate(MATCHES, start=1):
        assert f"--lr-match-{k}: #{bytes(color).hex()};" in tokens
    assert "--lr-accent: #5cc8ff;" in tokens
    for name in ("tokens.css", "viser.css", "logo.svg", "index.html", "js/main.js", "css/base.css"):
        assert (static_folder() / name).is_file()
