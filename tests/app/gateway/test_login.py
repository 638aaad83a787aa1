"""Login and security checks: token, cookie, host name and origin."""

from __future__ import annotations

import re
import socket
import string
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlencode, urljoin

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.gateway.login import Credentials, checked_token, new_token
from ladarreg.gateway.options import GatewayOptions
from ladarreg.gateway.request_source import is_loopback, request_source
from ladarreg.gateway.security import PAGE_POLICY, VISER_POLICY
from websockets.exceptions import InvalidStatus

from ladarreg_core.errors import OptionError
from testing.workbench.access import Access
from testing.workbench.gateway_driver import TOKEN, Running, running

PATHS = (
    "/", "/index.html", "/tokens.css", "/static/tokens.css", "/picture/scan?rev=1", "/picture/photo/p1",
    "/export/p1.zip", "/viser", "/viser/", "/viser/index.html", "/enter", "/no/such/thing",
)  # fmt: skip
SOCKETS = ("/document", "/viser", "/viser/", "/else")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("room")) as found:
        yield found


def refused(run: Running, path: str, **headers: str) -> int:
    """Return the status that a websocket is refused with."""
    with pytest.raises(InvalidStatus) as caught, run.socket(path, headers):
        pass
    return caught.value.response.status_code


# --- the token -------------------------------------------------------------------------------------------------------


def test_the_token_is_replaced_by_a_cookie(run: Running) -> None:
    status, headers, body = run.ask("GET", f"/?token={TOKEN}", known=False)
    assert status == 200  # no redirect: browsers drop a strict cookie there after a foreign link
    cookie, *flags = headers["set-cookie"].split("; ")
    access = Access.granted(headers)
    assert re.fullmatch("/s/[0-9a-f]{32}/", access.path)
    assert f'http-equiv="refresh" content="0; url=.{access.path}"'.encode() in body
    assert {flag.lower() for flag in flags} == {"httponly", "samesite=strict", f"path={access.path}"}
    assert TOKEN not in str(headers) + body.decode()
    assert headers["cache-control"] == "no-store"
    assert run.ask("GET", access.path, {"Cookie": cookie}, known=False)[0] == 200


def test_the_path_and_the_cookie_of_a_session_are_both_required(run: Running) -> None:
    first = run.access
    run.enter()
    second = run.access
    assert first.path != second.path
    for path in ("", "picture/scan", "js/main.js", "viser/", "no/such/thing"):
        mine = {"Cookie": first.cookie}
        assert run.ask("GET", first.path + path, mine, known=False)[0] != 401
        for stranger in (second.path, "/", f"/s/{'0' * 32}/", first.path.upper(), f"/{first.path}"):
            status, headers, _ = run.ask("GET", stranger + path, mine, known=False)
            assert (status, "set-cookie" in headers) == (401, False)
        assert run.ask("GET", first.path + path, {"Cookie": second.cookie}, known=False)[0] == 401
        both = f"{second.cookie}; {first.cookie}"
        assert run.ask("GET", first.path + path, {"Cookie": both}, known=False)[0] != 401


@pytest.mark.parametrize("site", ["same-site", "cross-site"])
def test_in_a_session_only_its_own_page_is_answered(run: Running, site: str) -> None:
    """Browsers send the cookies to another port of the host, and say `same-site` of what its pages request."""
    asked = {"Sec-Fetch-Site": site}
    for dest in ("empty", "image", "script", "iframe", ""):
        for path in ("/", "/picture/scan", "/access", "/export/p1.zip"):
            assert run.ask("GET", path, {**asked, "Sec-Fetch-Dest": dest})[0] == 403
    status, _, body = run.ask("GET", "/", {**asked, "Sec-Fetch-Dest": "document"})
    assert (status, b"<form" in body, b"scan-pane" in body) == (401, True, False), "a link leads to the login"
    assert run.ask("POST", "/upload?what=scan", {**asked, "X-File-Name": "a.e57"}, b"data")[0] == 403
    for path in ("/document", "/viser"):
        assert refused(run, path, **asked) == 403
    for site_ in ("same-origin", "none"):
        assert run.ask("GET", "/", {"Sec-Fetch-Site": site_, "Sec-Fetch-Dest": "document"})[0] == 200


@pytest.mark.parametrize("path", ["/s/{}/", "/s/{}/export/p1.html", "/picture/scan", "/s/{}"])
def test_an_address_without_a_session_leads_to_the_form(run: Running, path: str) -> None:
    status, _, body = run.ask("GET", path.format("0" * 32), {"Sec-Fetch-Dest": "document"}, known=False)
    assert status == 401
    found = re.search(rb'action="([./]+)enter"', body)
    assert found is not None
    assert urljoin(f"http://h{path.format('0')}", found[1].decode()) == "http://h/"
    assert (b"has expired" in body) == path.startswith("/s/{}/")


@pytest.mark.slow
def test_a_wrong_token_gets_the_form(tmp_path: Path) -> None:
    with running(tmp_path) as run:
        for token in ("", f"{TOKEN}x", TOKEN[:-1], "%00"):
            status, headers, body = run.ask("GET", f"/?token={token}", known=False)
            assert status == 401
            assert "set-cookie" not in headers
            assert b"<form" in body


def test_the_form_accepts_the_token(run: Running) -> None:
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    status, headers, _ = run.ask("POST", "/enter", form, urlencode({"token": f" {TOKEN} "}), known=False)
    assert status == 200
    access = Access.granted(headers)
    assert run.ask("GET", access.path, {"Cookie": access.cookie}, known=False)[0] == 200
    assert run.ask("POST", "/enter", form, urlencode({"token": "no"}), known=False)[0] == 401
    assert run.ask("POST", "/enter", form, b"token=" + b"a" * 5000, known=False)[0] == 413
    assert run.ask("POST", "/enter", form, b"\xff\xfe&&&&===%%%", known=False)[0] == 401


def test_wrong_tokens_lock_nobody_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.gateway.login._WRONG_DELAY_S", 0)
    with running(tmp_path) as run:
        for site in ("none", "cross-site", "same-site", ""):
            headers = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "document"}
            assert {run.ask("GET", f"/?token={n}", headers, known=False)[0] for n in range(40)} == {401}
            assert run.ask("GET", f"/?token={TOKEN}", headers, known=False)[0] == 200
        assert run.ask("POST", "/enter", {}, urlencode({"token": TOKEN}), known=False)[0] == 200
        assert run.ask("GET", "/")[0] == 200, "a valid cookie stays valid"


@pytest.mark.parametrize("shown_as", ["image", "script", "iframe", "empty"])
def test_embedded_requests_do_not_log_in(run: Running, shown_as: str) -> None:
    from_elsewhere = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": shown_as, "Origin": ""}
    for token in [*map(str, range(12)), TOKEN]:
        status, headers, _ = run.ask("GET", f"/?token={token}", from_elsewhere, known=False)
        assert status == 403
        assert "set-cookie" not in headers


@given(st.text(st.characters(exclude_characters=";"), max_size=80))
def test_only_our_own_sessions_are_valid(value: str) -> None:
    credentials = Credentials(TOKEN)
    good = credentials.new_session(TOKEN)
    cookie, name = f"ladarreg={good.cookie}", good.name
    assert credentials.session_of(f"a=b; {cookie}", name) == good
    assert Credentials(TOKEN).session_of(cookie, name) == good, "known after a new start"
    assert Credentials(new_token()).session_of(cookie, name) is None
    assert credentials.session_of(cookie, credentials.new_session(TOKEN).name) is None
    for wrong in ("", value, f"{name}0", name[:-1]):
        assert credentials.session_of(cookie, wrong) is None
    for cookies in (value, f"ladarreg={value}", f"{cookie}{value}0", f"x{cookie}"):
        assert credentials.session_of(cookies, name) is None
    assert name not in good.cookie, "who sees the cookie does not know the path"
    assert TOKEN not in good.cookie


@pytest.mark.slow
@given(st.text(string.ascii_letters + string.digits + "-_.~", min_size=22, max_size=60), st.text(max_size=80))
def test_only_the_token_itself_is_accepted(token: str, word: str) -> None:
    assert checked_token(token) == token
    assert Credentials(token).is_token(token)
    assert Credentials(token).is_token(word) == (word == token)


@pytest.mark.parametrize(
    "token",
    ["", "twenty-one-characters", "twenty two characters!", "zweiundzwanzig-zeichen-ü", "twenty-two\ncharacters"],
)
def test_a_weak_or_unencodable_token_is_refused(token: str) -> None:
    with pytest.raises(OptionError, match="token"):
        checked_token(token)


# --- everything behind it --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cookie", ["", "ladarreg=", "ladarreg=a.b", "ladarreg-1={good}"])
@pytest.mark.parametrize("path", PATHS)
def test_without_a_cookie_nothing_is_served(run: Running, path: str, cookie: str) -> None:
    sent = {"Cookie": cookie.format(good=run.access.cookie.partition("=")[2])}
    for known in (True, False):
        for method in ("GET", "HEAD"):
            status, headers, body = run.ask(method, path, sent, known=known)
            assert status == 401
            assert "set-cookie" not in headers
        assert b"<form" not in body


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "PROPFIND"])
@pytest.mark.parametrize("path", ["/upload?what=scan", "/", "/document", "/viser/"])
def test_without_a_cookie_nothing_is_done(run: Running, path: str, method: str) -> None:
    before = len(run.bench.taken)
    assert run.ask(method, path, {"X-File-Name": "a.e57"}, b"data", known=False)[0] == 401
    assert len(run.bench.taken) == before


@pytest.mark.parametrize("path", SOCKETS)
def test_without_a_cookie_no_websocket_opens(run: Running, path: str) -> None:
    joined = run.bench.joined
    assert refused(run, path, Cookie="") == 401
    assert run.bench.joined == joined


FOREIGN = (
    "https://elsewhere.example", "http://127.0.0.1", "http://127.0.0.1:1", "http://127.0.0.1:{port}.elsewhere.example",
    "https://127.0.0.1:{port}", "null", "http://elsewhere.example#127.0.0.1:{port}", "http://me@127.0.0.1:{port}",
    "file://", "http://[", "",
)  # fmt: skip


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_page_of_another_site_can_neither_send_nor_listen(run: Running, origin: str) -> None:
    origin = origin.format(port=run.port)
    assert refused(run, "/document", Origin=origin) == 403
    assert refused(run, "/viser", Origin=origin) == 403
    status, _, _ = run.ask("POST", "/upload?what=scan", {"Origin": origin, "X-File-Name": "a.e57"}, b"data")
    assert status == 403
    assert run.ask("POST", "/enter", {"Origin": origin}, f"token={TOKEN}")[0] == 403


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:{port}", 200), ("localhost:9999", 200), ("LocalHost", 200), ("[::1]:{port}", 200),
        ("elsewhere.example", 403), ("elsewhere.example:{port}", 403), ("127.0.0.1.elsewhere.example", 403),
        ("a b", 400), ("a,b", 400), ("[::1", 400),
    ],
)  # fmt: skip
def test_on_loopback_only_our_own_host_names_are_answered(run: Running, host: str, status: int) -> None:
    assert run.ask("GET", "/", {"Host": host.format(port=run.port)})[0] == status


def test_other_host_names_can_be_allowed(tmp_path: Path) -> None:
    with running(tmp_path, allowed_hosts=("Scans.example",)) as run:
        assert run.ask("GET", "/", {"Host": "scans.EXAMPLE:1"})[0] == 200
        assert run.ask("GET", "/", {"Host": "other.example"})[0] == 403
        assert run.ask("GET", "/", {"Host": "localhost"})[0] == 200


def test_forwarded_headers_are_trusted_only_behind_a_proxy(tmp_path: Path) -> None:
    said = {
        "X-Forwarded-Host": "evil.example, scans.example",
        "X-Forwarded-Proto": "https",
        "X-Forwarded-Prefix": "/ladar",
        "X-Forwarded-For": "1.2.3.4, 5.6.7.8",
        "Origin": "https://scans.example",
    }
    with running(tmp_path, behind_proxy=True) as run:
        status, headers, _ = run.ask("POST", "/enter", said, f"token={TOKEN}", known=False)
        assert status == 200
        assert "secure" in headers["set-cookie"].lower().split("; ")
        assert Access.granted(headers).path.startswith("/ladar/s/")
        plain = {**said, "Origin": "http://scans.example"}
        assert run.ask("POST", "/enter", plain, f"token={TOKEN}", known=False)[0] == 403, "another scheme"
        assert "strict-transport-security" not in headers, "that is the proxy's to say"
    with running(tmp_path) as run:
        assert run.ask("POST", "/enter", said, f"token={TOKEN}", known=False)[0] == 403
        status, headers, _ = run.ask("GET", f"/?token={TOKEN}", said, known=False)
        assert "secure" not in headers["set-cookie"].lower()
        assert "ladar/" not in headers["set-cookie"]


@given(st.dictionaries(st.sampled_from(["host", "origin", "x-forwarded-host", "x-forwarded-for", "x-forwarded-proto",
    "x-forwarded-prefix"]), st.binary(max_size=40)), st.booleans())  # fmt: skip
def test_malformed_headers_are_tolerated(headers: dict[str, bytes], behind_proxy: bool) -> None:
    scope = {"headers": [(k.encode(), v) for k, v in headers.items()], "scheme": "http", "client": None}
    asked = request_source(scope, behind_proxy=behind_proxy)
    assert asked.prefix.startswith("/")
    assert asked.prefix.endswith("/")
    assert not set(asked.prefix + asked.host) & set(";, \r\n")
    assert isinstance(asked.is_same_origin, bool)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "[::1]", "127.8.8.8"])
def test_loopback_is_recognised(host: str) -> None:
    assert is_loopback(host)
    assert GatewayOptions(host=host).on_loopback


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "scans.example", ""])
def test_everything_else_is_not_loopback(host: str) -> None:
    assert not is_loopback(host)


# --- what every answer says -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("known", [True, False])
def test_every_response_has_the_security_headers(run: Running, path: str, known: bool) -> None:
    _, headers, _ = run.ask("GET", path, known=known)
    policy = headers["content-security-policy"]
    if path.startswith("/viser"):
        assert policy == VISER_POLICY
    elif known and path != "/enter":
        assert policy == PAGE_POLICY
    assert "'unsafe-eval'" not in policy
    assert "frame-ancestors" in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] in ("no-referrer", "strict-origin")
    assert headers["cross-origin-opener-policy"] == "same-origin"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "server" not in headers
    assert "strict-transport-security" not in headers
    assert headers["cache-control"]


def test_the_page_allows_no_inline_code() -> None:
    assert "unsafe" not in PAGE_POLICY
    assert "default-src 'self'" in PAGE_POLICY


TRAVERSALS = (
    "/static/../../pyproject.toml", "/../pyproject.toml", "/%2e%2e/pyproject.toml",
    "/static/%2e%2e/%2e%2e/pyproject.toml",
    "/..%2fpyproject.toml",
    "/static/..%5c..%5cpyproject.toml", "/%00", "/static//etc/passwd", "//etc/passwd",
    "/%2fetc%2fpasswd", "/viser/../../pyproject.toml", "/viser/%2e%2e/%2e%2e/pyproject.toml", "/.git/config",
    "/static/.hidden", "/export/../pyproject.toml", "/export/%2e%2e%2fx.zip", "/picture/../../etc/passwd",
    "/" + "a" * 3000,
)  # fmt: skip


@pytest.mark.parametrize("path", TRAVERSALS)
def test_no_path_leads_out_of_the_folder(run: Running, path: str) -> None:
    status, _, body = run.ask("GET", path)
    assert status in (400, 404, 502)  # 502: viser is not there in these tests
    assert b"[project]" not in body
    assert b"root:" not in body
    assert b"Traceback" not in body
    assert len(body) < 200


def test_a_refusal_does_not_wait_for_the_body(run: Running) -> None:
    with socket.create_connection(("127.0.0.1", run.port), timeout=60) as half:
        half.sendall(b"POST /upload HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000\r\n\r\nabc")
        assert b" 403 " in half.makefile("rb").readline()
