"""Login: the token, the session that replaces it, and the form.

A session is a cookie and a path: browsers send the cookies of a host to all of its ports, so the cookie is limited to a
path that no other server knows, `/s/<128 bits>/`, and only both together are valid. Both follow from the browser's
random id and the token, so that a session outlives a restart. static/login.js remembers the path in the browser.

Tokens are too long to be found by trying, so that attempts need no limit: one could lock people out.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import html
import re
import secrets
from dataclasses import dataclass, field
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from ladarreg_core.errors import OptionError

from .page.folder import static_text
from .request_source import RequestSource

MIN_TOKEN_LENGTH = 22
"""Characters that a token must have at least: those of base64 that hold 128 random bits."""
_MAKE_TOKEN = 'python3 -c "import secrets; print(secrets.token_urlsafe())"'
_ID_BYTES = 16
_MAX_FORM_BYTES = 4096
_WRONG_DELAY_S = 0.3
_STYLE = (
    ":root{color-scheme:dark light;--back:#0f1115;--panel:#161a21;--line:#2a313d;--ink:#e8ecf2;--dim:#8f9bad;"
    "--accent:#5cc8ff;--bad:#f2726f}"
    "@media(prefers-color-scheme:light){:root{--back:#f5f6f8;--panel:#fff;--line:#c9d0da;--ink:#12161c;--dim:#566173;"
    "--accent:#00618f;--bad:#b3261e}}"
    "body{margin:0;min-height:100vh;display:grid;place-items:center;background:var(--back);color:var(--ink);"
    "font:15px/1.5 system-ui,sans-serif}"
    "main{box-sizing:border-box;width:min(420px,92vw);padding:28px;background:var(--panel);"
    "border:1px solid var(--line);border-radius:8px}"
    "h1{margin:0 0 4px;font-size:20px}p{margin:0 0 18px;color:var(--dim)}p.bad{color:var(--bad)}"
    ".checking main{visibility:hidden}"
    "label{display:block;margin-bottom:6px}"
    "input,button{box-sizing:border-box;width:100%;padding:9px 11px;border-radius:6px;font:inherit;color:inherit}"
    "input{background:var(--back);border:1px solid var(--dim);margin-bottom:14px}"
    "button{background:transparent;border:1px solid var(--accent);color:var(--accent);cursor:pointer}"
    "input:focus-visible,button:focus-visible{outline:2px solid var(--accent);outline-offset:2px}"
)
_SCRIPT_FILE = "login.js"
_COOKIE = "ladarreg"
_SESSION = re.compile(r"/s/([0-9a-f]{32})(/.*)", re.DOTALL)
_EXPIRED = (
    "This address has expired, or belongs to another browser: it opens the workbench only where the token was shown,"
    " until that browser is closed or the token replaced."
)


def new_token() -> str:
    """Return a random token."""
    return secrets.token_urlsafe(24)


def checked_token(token: str) -> str:
    """Return a token chosen by the operator, if it is acceptable.

    Raises:
        OptionError: if it is too short, or cannot be part of a URL.
    """
    if len(token) < MIN_TOKEN_LENGTH:
        raise OptionError(
            f"the token has {len(token)} characters; it needs at least {MIN_TOKEN_LENGTH}, so that nobody finds it by "
            f"trying: make one by {_MAKE_TOKEN}, or omit it for a random one"
        )
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise OptionError(
            "the token contains a space or a character that is not printable ASCII; use letters, digits and - . _ ~"
        )
    return token


@dataclass(frozen=True, slots=True)
class LoginSession:
    """What a browser gets that has shown a token: everything is served to it below a path of its own."""

    browser: str
    """Random id of the browser."""
    read_only: bool
    """True if that token only grants looking."""
    name: str = field(repr=False)
    """128 bits that only this browser knows, in hexadecimal: the last part of its path."""
    cookie: str = field(repr=False)
    """Value of its cookie."""

    @property
    def path(self) -> str:
        """Its path, relative to the site's."""
        return f"s/{self.name}/"

    @property
    def access(self) -> str:
        """What it permits: `edit` or `look`."""
        return "look" if self.read_only else "edit"


def session_name_and_path(path: str) -> tuple[str, str]:
    """Return the name of the session that a path is below, empty if it is below none, and the path within it."""
    found = _SESSION.fullmatch(path)
    return (found[1], found[2]) if found else ("", path)


class Credentials:
    """The tokens, and the sessions of the browsers that have shown one.

    A session is a random browser id, with a path and a signature that are derived from it and the token. A cookie
    therefore does not reveal the token, browsers can be distinguished, and with a kept token they stay logged in across
    restarts.

    Args:
        token: the token that grants access.
        read_only_token: the token that grants looking only; empty: there is none.
    """

    def __init__(self, token: str, *, read_only_token: str = "") -> None:
        tokens = [token, read_only_token] if read_only_token else [token]
        self._tokens = [hashlib.sha256(each.encode()).digest() for each in tokens]
        self._keys = [hmac.digest(each.encode(), b"ladarreg session", "sha256") for each in tokens]

    def is_token(self, token: str) -> bool:
        """Return whether this is one of the tokens; takes the same time for every wrong one."""
        return self._index(token) is not None

    def new_session(self, token: str) -> LoginSession:
        """Return a session for a browser that has shown a token."""
        index = self._index(token)
        if index is None:
            raise ValueError("this is not a token")
        return self._session(secrets.token_hex(_ID_BYTES), index)

    def session_of(self, cookies: str, name: str) -> LoginSession | None:
        """Return the session of a cookie, if the cookie and the path belong together; None if they do not.

        Args:
            cookies: the header Cookie.
            name: of the session, from the path.
        """
        for part in cookies.split(";"):
            key, _, value = part.strip().partition("=")
            if key != _COOKIE:
                continue
            cookie = value.strip().strip('"')
            browser = cookie.partition(".")[0]
            for index in range(len(self._keys)):
                session = self._session(browser, index)
                if _same(cookie, session.cookie) and _same(name, session.name):
                    return session
        return None

    def _session(self, browser: str, index: int) -> LoginSession:
        name, signature = (
            hmac.new(self._keys[index], f"{what} {browser}".encode(errors="replace"), "sha256").hexdigest()
            for what in ("path", "cookie")
        )
        return LoginSession(browser, index > 0, name[: 2 * _ID_BYTES], f"{browser}.{signature}")

    def _index(self, token: str) -> int | None:
        digest = hashlib.sha256(token.encode(errors="replace")).digest()
        same = [hmac.compare_digest(digest, each) for each in self._tokens]
        return same.index(True) if True in same else None


def _same(text: str, other: str) -> bool:
    return hmac.compare_digest(text.encode(errors="replace"), other.encode(errors="replace"))


class LoginPages:
    """Responses to browsers without a session: the form, and the outcome of submitting a token.

    Args:
        credentials: the tokens and their sessions.
    """

    def __init__(self, credentials: Credentials) -> None:
        self._credentials = credentials

    async def submit_token(self, source: RequestSource, token: str) -> Response:
        """Return the response to a submitted token; that to a wrong one takes a moment.

        What a page of another site embeds is refused without comparing it.
        """
        if source.fetch_dest not in ("", "document"):
            return PlainTextResponse("Submit the token by opening a page with it.\n", status_code=403)
        if self._credentials.is_token(token):
            return _continue_page(source, self._credentials.new_session(token))
        await asyncio.sleep(_WRONG_DELAY_S)
        return _form("This is not the token of the running workbench.")

    async def submit_form(self, request: Request, source: RequestSource) -> Response:
        """Return the response to the submitted form."""
        body = bytearray()
        try:
            async for chunk in request.stream():
                body += chunk
                if len(body) > _MAX_FORM_BYTES:
                    return PlainTextResponse("The form is longer than any token.\n", status_code=413)
        except ClientDisconnect:
            return Response(status_code=400)
        fields = parse_qs(body.decode(errors="replace"))
        return await self.submit_token(source, fields.get("token", [""])[-1].strip())

    def form(self, path: str) -> Response:
        """Return the form for a request without a session.

        Args:
            path: that was requested; its slashes tell where the site begins, whatever a proxy in front has removed.
        """
        name, _ = session_name_and_path(path)
        return _form(_EXPIRED if name else "", home="../" * (path.count("/") - 1) or "./")


def _continue_page(source: RequestSource, session: LoginSession) -> Response:
    """Return a page that moves on to the workbench.

    It is not a redirect: after a link from another site, browsers drop a strict cookie that a redirect sets.
    """
    body = f'<h1>ladarreg</h1><p>Opening the workbench. <a href="./{session.path}">Continue</a></p>'
    reload = f'<noscript><meta http-equiv="refresh" content="0; url=./{session.path}"></noscript>'
    data = f'data-session="{session.path}" data-access="{session.access}"'
    response = _page(body, script_data=data, head=reload)
    response.set_cookie(
        _COOKIE,
        session.cookie,
        path=f"{source.prefix}{session.path}",
        secure=source.secure,
        httponly=True,
        samesite="strict",
    )
    return response


def _form(error: str, *, home: str = "./") -> Response:
    alert = f'<p class="bad" role="alert">{html.escape(error)}</p>' if error else ""
    body = (
        f"<h1>ladarreg</h1>{alert}"
        "<p>Open the address that the workbench printed when it was started, or enter the token from it.</p>"
        f'<form method="post" action="{home}enter"><label for="token">Token</label>'
        '<input id="token" name="token" type="password" autocomplete="current-password" required autofocus>'
        "<button>Enter</button></form>"
    )
    # With `no-referrer` the form's own Origin would be `null`.
    return _page(body, home=home, status=401, referrer="strict-origin")


def _page(
    body: str, *, home: str = "./", script_data: str = "", head: str = "", status: int = 200,
    referrer: str = "no-referrer",
) -> Response:  # fmt: skip
    script = static_text(_SCRIPT_FILE)
    text = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<script data-home="{home}" {script_data}>{script}</script>'
        f"{head}<title>ladarreg</title><style>{_STYLE}</style></head><body><main>{body}</main></body></html>"
    )
    headers = {
        "content-security-policy": f"default-src 'none'; style-src '{_digest(_STYLE)}'; "
        f"script-src '{_digest(script)}'; connect-src 'self'; base-uri 'none'; form-action 'self'; "
        "frame-ancestors 'none'",
        "referrer-policy": referrer,
        "x-frame-options": "DENY",
    }
    return HTMLResponse(text, status_code=status, headers=headers)


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
