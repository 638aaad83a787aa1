"""Login: the token, the cookie that replaces it, and the form.

Tokens are too long to be found by trying, so that attempts need no limit: one could lock people out.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import html
import secrets
from dataclasses import dataclass
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from ladarreg_core.errors import OptionError

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
    "label{display:block;margin-bottom:6px}"
    "input,button{box-sizing:border-box;width:100%;padding:9px 11px;border-radius:6px;font:inherit;color:inherit}"
    "input{background:var(--back);border:1px solid var(--dim);margin-bottom:14px}"
    "button{background:transparent;border:1px solid var(--accent);color:var(--accent);cursor:pointer}"
    "input:focus-visible,button:focus-visible{outline:2px solid var(--accent);outline-offset:2px}"
)
# A URL that contains a token, even a wrong one, must not remain in the history of the Back button.
_CONTINUE_SCRIPT = 'location.replace("./")'
_FORGET_SCRIPT = 'history.replaceState(null, "", "./")'


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
class Browser:
    """A browser that has shown a token."""

    id: str
    """Random, part of its cookie."""
    read_only: bool
    """True if that token only grants looking."""


class Credentials:
    """The tokens, and the cookies of the browsers that have shown one.

    A cookie is a random browser id signed with a key derived from the token. A cookie therefore does not reveal the
    token, browsers can be told apart, and with a token of the operator's own they stay logged in across restarts.

    Args:
        token: the token that grants access.
        read_only_token: the token that grants looking only; empty: there is none.
        port: of the gateway; part of the cookie's name, because browsers share cookies between the ports of a host.
    """

    def __init__(self, token: str, *, port: int, read_only_token: str = "") -> None:
        self.cookie_name = f"ladarreg-{port}"
        tokens = [token, read_only_token] if read_only_token else [token]
        self._tokens = [hashlib.sha256(each.encode()).digest() for each in tokens]
        self._keys = [hmac.digest(each.encode(), b"ladarreg cookie", "sha256") for each in tokens]

    def is_token(self, token: str) -> bool:
        """Return whether this is one of the tokens; takes the same time for every wrong one."""
        return self._index(token) is not None

    def new_cookie(self, token: str) -> str:
        """Return a cookie for a browser that has shown a token."""
        index = self._index(token)
        if index is None:
            raise ValueError("this is not a token")
        browser = secrets.token_hex(_ID_BYTES)
        return f"{browser}.{self._signature(browser, self._keys[index])}"

    def browser_of(self, cookies: str) -> Browser | None:
        """Return the browser of a valid cookie; None if there is none.

        Args:
            cookies: the header Cookie.
        """
        for part in cookies.split(";"):
            name, _, value = part.strip().partition("=")
            browser, _, signature = value.strip().strip('"').partition(".")
            if name != self.cookie_name:
                continue
            for index, key in enumerate(self._keys):
                if hmac.compare_digest(signature.encode(errors="replace"), self._signature(browser, key).encode()):
                    return Browser(browser, read_only=index > 0)
        return None

    def _index(self, token: str) -> int | None:
        digest = hashlib.sha256(token.encode(errors="replace")).digest()
        same = [hmac.compare_digest(digest, each) for each in self._tokens]
        return same.index(True) if True in same else None

    @staticmethod
    def _signature(browser: str, key: bytes) -> str:
        return hmac.new(key, browser.encode(errors="replace"), "sha256").hexdigest()


def _headers(script: str, *, referrer: str) -> dict[str, str]:
    return {
        "content-security-policy": f"default-src 'none'; style-src '{_digest(_STYLE)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
        "referrer-policy": referrer,
        "x-frame-options": "DENY",
    }


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


_CONTINUE_HEADERS = _headers(_CONTINUE_SCRIPT, referrer="no-referrer")
# With `no-referrer` the form's own Origin would be `null`.
_FORM_HEADERS = _headers(_FORGET_SCRIPT, referrer="strict-origin")


class LoginPages:
    """Responses to browsers without a valid cookie: the form, and the outcome of submitting a token.

    Args:
        credentials: the token and its cookies.
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
            return self._logged_in(source, token)
        await asyncio.sleep(_WRONG_DELAY_S)
        return _form("This is not the token of the running workbench.", status=401)

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

    def form(self) -> Response:
        """Return the empty form."""
        return _form("", status=401)

    def _logged_in(self, source: RequestSource, token: str) -> Response:
        response = continue_page()
        response.set_cookie(
            self._credentials.cookie_name,
            self._credentials.new_cookie(token),
            path=source.prefix,
            secure=source.secure,
            httponly=True,
            samesite="strict",
        )
        return response


def continue_page() -> Response:
    """Return a page that moves on to the workbench.

    It is not a redirect: after a link from another site, browsers drop a strict cookie that a redirect sets.
    """
    body = '<h1>ladarreg</h1><p>Opening the workbench. <a href="./">Continue</a></p>'
    head = f'<script>{_CONTINUE_SCRIPT}</script><noscript><meta http-equiv="refresh" content="0; url=./"></noscript>'
    return HTMLResponse(_page(body, head=head), headers=_CONTINUE_HEADERS)


def _form(error: str, *, status: int) -> Response:
    alert = f'<p class="bad" role="alert">{html.escape(error)}</p>' if error else ""
    page = _page(
        f"<h1>ladarreg</h1>{alert}"
        "<p>Enter the token of this workbench. It is part of the address that was printed when the workbench was"
        " started.</p>"
        '<form method="post" action="./enter"><label for="token">Token</label>'
        '<input id="token" name="token" type="password" autocomplete="current-password" required autofocus>'
        "<button>Enter</button></form>",
        head=f"<script>{_FORGET_SCRIPT}</script>",
    )
    return HTMLResponse(page, status_code=status, headers=_FORM_HEADERS)


def _page(body: str, *, head: str = "") -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{head}<title>ladarreg</title><style>{_STYLE}</style></head><body><main>{body}</main></body></html>"
    )
