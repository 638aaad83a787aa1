"""Uploads, pictures, exports and the page's own files."""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
from collections import namedtuple
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.gateway.uploads import safe_suffix, upload_name

from ladarreg_core.errors import OptionError
from testing.workbench.access import Access
from testing.workbench.gateway_driver import PNG, Running, hear, running, soon

LIMIT = 300_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("room")) as found:
        yield found


def send(
    run: Running, data: bytes, name: str = "scan.e57", query: str = "what=scan", **headers: str
) -> tuple[int, bytes]:
    status, told, body = run.ask("POST", f"/upload?{query}", {"X-File-Name": quote(name)} | headers, data)
    assert told["content-type"] == "application/json"
    return status, body


def begin(run: Running, head: bytes) -> socket.socket:
    """Start an upload on a raw socket."""
    line = socket.create_connection(("127.0.0.1", run.port), timeout=60)
    line.sendall(
        b"POST %s HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nOrigin: %s\r\nCookie: %s\r\nX-File-Name: a.e57\r\n%s"
        % (
            run.access.within("/upload?what=scan").encode(),
            run.port,
            run.origin.encode(),
            run.access.cookie.encode(),
            head,
        )
    )
    return line


def left(run: Running) -> list[Path]:
    return [path for path in run.bench.room.iterdir() if path.suffix != ".zip"]


# --- uploads ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 65536, LIMIT])
def test_a_file_arrives_unchanged(run: Running, size: int) -> None:
    data = bytes(range(256)) * (size // 256) + b"x" * (size % 256)
    with run.socket() as page:
        hear(page)
        status, body = send(run, data, "Büro 7/Flügel".replace("/", "-") + ".E57", "what=photo&photo=p1")
        assert (status, body) == (200, b'{"ok":true,"id":"u%d"}' % len(run.bench.taken))
        name, what, photo, taken, client = run.bench.taken[-1]
        assert (name, what, photo, taken) == ("Büro 7-Flügel.E57", "photo", "p1", data)
        assert client is run.bench.pages[-1], "the page of the same browser"
    assert not left(run)


def test_on_disk_a_file_has_a_random_name(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def look(path: Path, *_: object) -> str:
        seen.append(path)
        path.unlink()
        return "u"

    monkeypatch.setattr(run.bench, "take_upload", look)
    send(run, b"data", "con.E57")
    send(run, b"data", "x.p/h p".replace("/", ""))
    assert [path.parent for path in seen] == [run.bench.room] * 2
    assert [path.suffix for path in seen] == [".e57", ""]
    assert all(len(path.stem) == 32 and set(path.stem) <= set("0123456789abcdef") for path in seen)


@pytest.mark.parametrize("declared", [True, False])
def test_a_file_that_is_too_large_is_refused_early(run: Running, declared: bool) -> None:
    chunks = [b"x" * 65536] * 100
    before = len(run.bench.taken)
    head = {"Content-Length": str(65536 * 100)} if declared else {}
    status, _, body = run.ask("POST", "/upload?what=scan", {"X-File-Name": "a.e57"} | head, iter(chunks))
    assert status == 413
    assert b'"ok":false' in body
    assert b"MB" in body
    assert len(run.bench.taken) == before
    assert not left(run)


def test_a_declared_size_is_refused_before_the_body(run: Running) -> None:
    with begin(run, b"Content-Length: 999999999\r\nExpect: 100-continue\r\n\r\n") as line:
        assert b" 413 " in line.recv(100)
    assert not left(run)


@pytest.mark.parametrize("chunked", [True, False])
def test_an_interrupted_upload_leaves_nothing(run: Running, chunked: bool) -> None:
    before = len(run.bench.taken)
    body = b"10000\r\n" + b"x" * 65536 + b"\r\n" if chunked else b"x" * 65536
    head = b"Transfer-Encoding: chunked\r\n\r\n" if chunked else b"Content-Length: 200000\r\n\r\n"
    with begin(run, head + body):
        assert soon(lambda: len(left(run)) == 1)
        assert left(run)[0].suffix == ".part"
    assert soon(lambda: not left(run))
    assert len(run.bench.taken) == before
    assert send(run, b"data")[0] == 200, "its slot is free again"


def from_many_browsers(run: Running, count: int) -> list[Access]:
    """Log in as so many browsers."""
    own, found = run.access, []
    for _ in range(count):
        run.enter()
        found.append(run.access)
    run.access = own
    return found


def upload_of(run: Running, access: Access) -> tuple[int, bytes]:
    headers = {"Cookie": access.cookie, "X-File-Name": "scan.e57"}
    status, _, body = run.ask("POST", access.within("/upload?what=scan"), headers, b"data", known=False)
    return status, body


def test_an_edit_waits_for_no_upload(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other requests share a number of threads, which as many files that are being opened would take."""
    held, take = threading.Event(), run.bench.take_upload
    opening: list[Path] = []

    def slow(path: Path, *others: Any) -> str:
        opening.append(path)
        assert held.wait(60)
        return take(path, *others)

    monkeypatch.setattr(run.bench, "take_upload", slow)
    with ThreadPoolExecutor(50) as others, run.socket() as page:
        hear(page)
        try:
            uploads = [others.submit(upload_of, run, access) for access in from_many_browsers(run, 50)]
            assert soon(lambda: len(left(run)) == 8), "the limit"
            assert soon(lambda: len(opening) == 2), "the threads"
            page.send('{"id": 1, "do": "set", "number": 5}')
            assert hear(page)["slices"] == {"number": 5}
            assert run.ask("GET", "/picture/scan?rev=1")[0] == 200
            assert not any(upload.done() for upload in uploads)
        finally:
            held.set()
        assert {upload.result()[0] for upload in uploads} == {200}, "those that waited for their turn too"


def test_an_upload_beyond_the_limit_waits_a_while_and_is_refused(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.gateway.uploads._SLOT_TIMEOUT_S", 0.1)
    own, browsers = run.access, from_many_browsers(run, 9)
    with contextlib.ExitStack() as lines:
        for access in browsers[:8]:
            run.access = access
            lines.enter_context(begin(run, b"Content-Length: 10\r\n\r\nabc"))
        run.access = own
        assert soon(lambda: len(left(run)) == 8)
        status, body = upload_of(run, browsers[8])
        assert (status, b"8 files are being uploaded already" in body) == (429, True)
    assert soon(lambda: not left(run))
    assert upload_of(run, browsers[8])[0] == 200


def test_a_browser_uploads_at_most_two_files_at_a_time(run: Running) -> None:
    head = b"Content-Length: 10\r\n\r\nabc"
    with begin(run, head) as first, begin(run, head):
        assert soon(lambda: len(left(run)) == 2)
        assert send(run, b"data")[0] == 429
        first.sendall(b"defghij")
        assert b" 200 " in first.recv(100)
        assert send(run, b"data")[0] == 200
    assert soon(lambda: not left(run))


def test_a_file_that_is_not_a_scan_is_refused_and_removed(run: Running) -> None:
    said = "7.e57: this is no scan; choose another than 7.e57"
    assert send(run, b"bad data", "7.e57") == (400, b'{"ok":false,"error":"%s"}' % said.encode())
    assert send(run, b"")[0] == 400
    assert not left(run)


def test_partial_files_of_a_killed_program_are_removed(tmp_path: Path) -> None:
    (tmp_path / f"{'0a' * 16}.part").write_bytes(b"half")
    (tmp_path / "kept.e57").write_bytes(b"whole")
    (tmp_path / "mine.part").write_bytes(b"somebody else's")
    with running(tmp_path):
        assert sorted(path.name for path in tmp_path.iterdir()) == ["kept.e57", "mine.part"]


def test_an_upload_without_progress_times_out(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.gateway.uploads._IDLE_TIMEOUT_S", 0.3)
    with begin(run, b"Content-Length: 200000\r\n\r\nabc") as line:
        assert b" 408 " in line.recv(100)
        assert not left(run)
    assert send(run, b"data")[0] == 200


def test_a_disk_error_is_reported_as_such(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object) -> str:
        path.unlink()  # a workbench removes what it does not take
        raise OSError(5, "Input/output error", str(path))

    monkeypatch.setattr(run.bench, "take_upload", refuse)
    status, body = send(run, b"data")
    assert status == 507
    assert b"input/output error" in body
    assert not left(run)


def test_a_full_disk_is_reported_before_writing(run: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("ladarreg.gateway.uploads.shutil.disk_usage", lambda _: usage(10**12, 10**12, 1000))
    status, body = send(run, b"data")
    assert status == 507
    assert b"disk" in body
    assert not left(run)


@pytest.mark.parametrize(
    ("query", "name"),
    [
        ("", "a.e57"), ("what=program", "a.e57"),
        ("what=scan", ""), ("what=scan", "%2e%2e%2fa"), ("what=scan", "a%00b"),
        ("what=scan", "a%5cb"), ("what=scan", ".."), ("what=scan", "a%0d%0aX: y"), ("what=scan", "a" * 256),
    ],
)  # fmt: skip
def test_an_upload_of_unknown_type_or_name_is_refused(run: Running, query: str, name: str) -> None:
    before = len(run.bench.taken)
    status, _, body = run.ask("POST", f"/upload?{query}", {"X-File-Name": name}, b"data")
    assert status == 400
    assert b'"ok":false' in body
    assert len(run.bench.taken) == before


def test_only_post_uploads(run: Running) -> None:
    for method in ("GET", "HEAD", "PUT", "PATCH", "DELETE"):
        assert run.ask(method, "/upload?what=scan", {"X-File-Name": "a.e57"}, b"data")[0] in (404, 405)
    assert not left(run)


@given(st.text(max_size=300))
def test_an_accepted_name_is_one_visible_line(name: str) -> None:
    try:
        taken = upload_name(quote(name, safe="", errors="surrogatepass"))
    except OptionError:
        return
    assert 0 < len(taken) <= 255
    assert not set(taken) & set("/\\\0\r\n\t\u202e")
    assert taken.strip(". ")
    assert safe_suffix(taken) == "" or safe_suffix(taken)[1:].isalnum()


@given(st.text(st.characters(categories=("L", "N", "P"), exclude_characters="/\\"), min_size=1, max_size=200))
def test_an_ordinary_name_is_kept(name: str) -> None:
    assert upload_name(quote(f"{name}.e57")).endswith(".e57")
    assert safe_suffix(f"{name}.E57") == ".e57"


# --- pictures, exports, the page -------------------------------------------------------------------------------------


def test_a_picture_is_cached_while_its_revision_is_current(run: Running) -> None:
    status, headers, body = run.ask("GET", "/picture/scan?rev=s1")
    assert (status, headers["content-type"], body) == (200, "image/png", PNG)
    assert headers["cache-control"].startswith("private, max-age=")
    assert headers["etag"] == '"s1"', "no line break gets into a header"
    again = run.ask("GET", "/picture/scan?rev=s1", {"If-None-Match": f'"x", W/{headers["etag"]}'})
    assert (again[0], again[2]) == (304, b"")
    assert run.ask("GET", "/picture/scan")[1]["cache-control"] == "private, no-cache"
    assert run.ask("HEAD", "/picture/scan?rev=s1")[2] == b""


def test_a_missing_picture_is_explained(run: Running) -> None:
    assert run.ask("GET", "/picture/none")[0::2] == (404, b"there is no picture 'none'; ask for another\n")
    assert run.ask("GET", "/picture/scan?show=nonsense")[0::2] == (400, b"it can show intensity; choose that\n")


def test_an_export_is_downloaded_under_its_name(run: Running) -> None:
    assert run.ask("GET", "/export/p1.zip")[0] == 404
    (run.bench.room / "p1.zip").write_bytes(b"PK data")
    status, headers, body = run.ask("GET", "/export/p1.zip")
    assert (status, headers["content-type"], body) == (200, "application/zip", b"PK data")
    assert headers["content-disposition"] == "attachment; filename*=utf-8''w%C3%A4nde.zip"
    assert run.ask("GET", "/export/p2.zip")[0] == 404


def test_a_report_is_shown_and_can_load_and_run_nothing(run: Running) -> None:
    assert run.ask("GET", "/export/p1.html")[0] == 404
    (run.bench.room / "p1.html").write_bytes(b"<!DOCTYPE html>")
    status, headers, body = run.ask("GET", "/export/p1.html")
    assert (status, headers["content-type"], body) == (200, "text/html; charset=utf-8", b"<!DOCTYPE html>")
    assert headers["content-disposition"] == "inline; filename*=utf-8''w%C3%A4nde.html"
    assert headers["content-security-policy"].startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'")
    assert "script" not in headers["content-security-policy"]
    assert run.ask("GET", "/export/p2.html")[0] == 404


@pytest.mark.parametrize("path", ["/", "/tokens.css", "/static/tokens.css"])
def test_the_pages_files_are_revalidated(run: Running, path: str) -> None:
    status, headers, body = run.ask("GET", path)
    assert status == 200
    assert body
    assert headers["cache-control"] == "no-cache"
    assert run.ask("GET", path, {"If-None-Match": headers["etag"]})[0] == 304


def test_modules_are_served_as_javascript(run: Running, checkout: Path) -> None:
    scripts = sorted((checkout / "static").rglob("*.js"))
    assert scripts
    for path in scripts[:3]:
        _, headers, _ = run.ask("GET", "/" + path.relative_to(checkout / "static").as_posix())
        assert headers["content-type"].startswith("text/javascript")


def test_many_pictures_at_once_are_all_drawn(run: Running) -> None:
    lines = [http.client.HTTPConnection("127.0.0.1", run.port, timeout=60) for _ in range(20)]
    for line in lines:
        line.request("GET", run.access.within("/picture/scan?rev=2"), headers={"Cookie": run.access.cookie})
    assert [line.getresponse().status for line in lines] == [200] * 20
    for line in lines:
        line.close()
