"""The slow link of the benchmark delivers everything unchanged, and counts it by request."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from benchmarks.page.throttling_proxy import ThrottlingProxy

BODIES = {"/small": b"small", "/large": bytes(range(256)) * 4000}


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(BODIES[self.path])))
        self.end_headers()
        self.wfile.write(BODIES[self.path])

    def log_message(self, *_: object) -> None:
        return


@pytest.fixture
def link() -> Iterator[ThrottlingProxy]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with ThrottlingProxy(server.server_address[1], bytes_per_s=20e6, one_way_s=0.001) as proxy:
        yield proxy
    server.shutdown()
    server.server_close()


def test_answers_arrive_unchanged_and_are_counted_by_request(link: ThrottlingProxy) -> None:
    connections = {path: http.client.HTTPConnection("127.0.0.1", link.port, timeout=20) for path in BODIES}
    for path, connection in connections.items():
        connection.request("GET", path)
    for path, connection in connections.items():
        assert connection.getresponse().read() == BODIES[path]
    connections["/small"].request("GET", "/small")  # on the same connection
    assert connections["/small"].getresponse().read() == BODIES["/small"]
    for connection in connections.values():
        connection.close()
    assert link.requests == 3
    assert set(link.downloaded) == set(BODIES)
    assert link.downloaded["/large"] > len(BODIES["/large"])
    assert link.uploaded > 0
