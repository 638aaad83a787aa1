"""Login and security checks: token, cookie, host name and origin."""

from __future__ import annotations

import socket
import string
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlencode

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.gateway.login import _PACE_S, AttemptLimiter, Browser, Credentials, checked_token, new_token
from ladarreg.gateway.options import GatewayOptions
from ladarreg.gateway.request_source import is_loopback, request_source
from ladarreg.gateway.security import PAGE_POLICY, VISER_POLICY
from websockets.exceptions import InvalidStatus

from ladarreg_core.errors import OptionError
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
    assert b'http-equiv="refresh" content="0; url=./"' in body
    cookie, *flags = headers["set-cookie"].split("; ")
    assert cookie.startswith(f"ladarreg-{run.port}=")
    assert {flag.lower() for flag in flags} == {"httponly", "samesite=strict", "path=/"}
    assert TOKEN not in str(headers) + body.decode()
    assert headers["cache-control"] == "no-store"
    assert run.ask("GET", "/", {"Cookie": cookie})[0] == 200


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
    assert run.ask("GET", "/", {"Cookie": headers["set-cookie"].partition(";")[0]})[0] == 200
    assert run.ask("POST", "/enter", form, urlencode({"token": "no"}), known=False)[0] == 401
    assert run.ask("POST", "/enter", form, b"token=" + b"a" * 5000, known=False)[0] == 413
    assert run.ask("POST", "/enter", form, b"\xff\xfe&&&&===%%%", known=False)[0] == 401


def test_many_wrong_tokens_delay_an_address_but_lock_nobody_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []

    async def wait(seconds: float) -> None:
        waits.append(seconds)

    monkeypatch.setattr("ladarreg.gateway.login.asyncio", SimpleNamespace(sleep=wait))
    monkeypatch.setattr("ladarreg.gateway.login.AttemptLimiter", partial(AttemptLimiter, clock=lambda: 1000.0))
    monkeypatch.setattr("ladarreg.gateway.login._WRONG_DELAY_S", 0)
    monkeypatch.setattr("ladarreg.gateway.login._PACE_S", 0.4)
    with running(tmp_path) as run:
        assert [run.ask("GET", f"/?token={n}", known=False)[0] for n in range(11)] == [401] * 11
        assert not any(waits)
        assert run.ask("GET", f"/?token={TOKEN}", known=False)[0] == 200, "the correct one is still accepted"
        assert waits.pop() == pytest.approx(0.4)
        monkeypatch.setattr("ladarreg.gateway.login._PACE_S", 100.0)
        run.ask("GET", "/?token=wrong", known=False)
        status, headers, body = run.ask("GET", "/?token=wrong", known=False)
        assert (status, headers["retry-after"]) == (429, "30")
        assert b"<form" in body
        assert run.ask("POST", "/enter", {}, urlencode({"token": TOKEN}), known=False)[0] == 200, (
            "the form is counted separately"
        )
        assert run.ask("GET", "/")[0] == 200, "a valid cookie stays valid"


def test_an_unguessable_token_is_accepted_whatever_was_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.gateway.login._WRONG_DELAY_S", 0)
    monkeypatch.setattr("ladarreg.gateway.login._PACE_S", 100.0)
    monkeypatch.setattr("testing.workbench.gateway_driver.TOKEN", token := new_token())
    with running(tmp_path) as run:
        seen = [run.ask("GET", f"/?token={n}", known=False)[0] for n in range(13)]
        assert seen == [401] * 11 + [429] * 2
        assert run.ask("GET", f"/?token={token}", known=False)[0] == 200


@pytest.mark.parametrize("shown_as", ["image", "script", "iframe", "empty"])
def test_embedded_requests_neither_log_in_nor_count_as_attempts(run: Running, shown_as: str) -> None:
    from_elsewhere = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": shown_as, "Origin": ""}
    for token in [*map(str, range(12)), TOKEN]:
        status, headers, _ = run.ask("GET", f"/?token={token}", from_elsewhere, known=False)
        assert status == 403
        assert "set-cookie" not in headers


def test_links_of_other_sites_are_counted_separately(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.gateway.login._WRONG_DELAY_S", 0)
    monkeypatch.setattr("ladarreg.gateway.login._PACE_S", 100.0)
    with running(tmp_path) as run:
        for site in ("cross-site", "same-site"):
            for n in range(12):
                run.ask("GET", f"/?token={n}", {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "document"}, known=False)
        for site in ("none", "same-origin", ""):
            headers = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "document"}
            assert run.ask("GET", f"/?token={TOKEN}", headers, known=False)[0] == 200
        linked = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
        assert run.ask("GET", f"/?token={TOKEN}", linked, known=False)[0] == 429


@given(times=st.lists(st.floats(0, 300), max_size=60), most=st.integers(1, 12))
def test_attempts_of_an_address_are_limited_per_minute(times: list[float], most: int) -> None:
    now = [0.0]
    attempts = AttemptLimiter(most=most, window_s=60, clock=lambda: now[0])
    tried: list[float] = []
    for moment in sorted(times):
        now[0] = moment
        assert attempts.delay_s("10.0.0.2") == 0
        turn_s = attempts.delay_s("10.0.0.1")
        assert turn_s is None or 0 <= turn_s <= 30
        if turn_s is not None:
            now[0] = moment + turn_s
            attempts.record_failure("10.0.0.1")
            now[0] = moment
            tried.append(moment + turn_s)
    for k, begun in enumerate(sorted(tried)):
        within = [at for at in sorted(tried)[k:] if at < begun + 60]
        assert len(within) <= most + 60 / _PACE_S + 1


def test_a_network_of_ipv6_addresses_is_one_peer_and_memory_is_bounded() -> None:
    attempts = AttemptLimiter(most=2)
    attempts.record_failure("2001:db8::1")
    attempts.record_failure("2001:db8::2%eth0")
    assert attempts.delay_s("2001:db8::fffe") == 0
    assert attempts.delay_s("2001:db8::ffff") == pytest.approx(_PACE_S, abs=0.5)
    assert attempts.delay_s("2001:db8::ffff", "form") == 0
    assert attempts.delay_s("2001:db8:0:1::1") == 0
    for n in range(5000):
        attempts.record_failure(f"10.{n >> 8}.{n & 255}.1")
        assert attempts.delay_s(f"net{n}") == 0
    assert len(attempts._failures) <= 4096


@given(st.text(st.characters(exclude_characters=";"), max_size=80), st.integers(1, 65535))
def test_only_our_own_cookies_are_valid(value: str, port: int) -> None:
    credentials = Credentials(TOKEN, port=port)
    good = credentials.new_cookie(TOKEN)
    assert credentials.browser_of(f"a=b; {credentials.cookie_name}={good}") == Browser(good.partition(".")[0], False)
    assert Credentials(TOKEN, port=port).browser_of(f"{credentials.cookie_name}={good}") is not None, (
        "known after a new start"
    )
    assert Credentials(new_token(), port=port).browser_of(f"{credentials.cookie_name}={good}") is None
    for cookies in (
        value,
        f"{credentials.cookie_name}={value}",
        f"{credentials.cookie_name}={good}{value}0",
        f"x{credentials.cookie_name}={good}",
    ):
        assert credentials.browser_of(cookies) is None
    assert TOKEN not in good


@given(st.text(string.ascii_letters + string.digits + "-_.~", min_size=12, max_size=60), st.text(max_size=80))
def test_only_the_token_itself_is_accepted(token: str, word: str) -> None:
    assert checked_token(token) == token
    assert Credentials(token, port=1).is_token(token)
    assert Credentials(token, port=1).is_token(word) == (word == token)


@pytest.mark.parametrize("token", ["", "elevenchars", "twelve chars", "zwölf-zeichen", "twelve\nchars"])
def test_a_weak_or_unencodable_token_is_refused(token: str) -> None:
    with pytest.raises(OptionError, match="token"):
        checked_token(token)


# --- everything behind it --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cookie", ["", "ladarreg-{port}=", "ladarreg-{port}=a.b", "ladarreg-1={good}"])
@pytest.mark.parametrize("path", PATHS)
def test_without_a_cookie_nothing_is_served(run: Running, path: str, cookie: str) -> None:
    sent = {"Cookie": cookie.format(port=run.port, good=run.cookie.partition("=")[2])}
    for method in ("GET", "HEAD"):
        status, headers, body = run.ask(method, path, sent)
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
    "null", "http://elsewhere.example#127.0.0.1:{port}", "http://me@127.0.0.1:{port}", "file://", "http://[", "",
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
        assert {"secure", "path=/ladar/"} <= {flag.lower() for flag in headers["set-cookie"].split("; ")}
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
