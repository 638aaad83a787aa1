"""The way in: the token becomes a cookie, and leaves the address bar."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import html
import math
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from app.gateway.attempts import Attempts
from app.gateway.door import Door
from app.gateway.forwarded import Asked

_LONGEST_FORM = 4096
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
_STYLE_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
# With `no-referrer` the form's own Origin would be `null`.
_HEADERS = {
    "content-security-policy": f"default-src 'none'; style-src 'sha256-{_STYLE_HASH}'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'",
    "referrer-policy": "same-origin",
    "x-frame-options": "DENY",
}


class Entrance:
    """Answers those who show a token, and those who show nothing.

    Args:
        door: knows the token.
    """

    def __init__(self, door: Door) -> None:
        self._door, self._attempts = door, Attempts()

    async def show(self, asked: Asked, token: str) -> Response:
        """Answer somebody who shows a token."""
        wait_s = self._attempts.wait_s(asked.address)
        if wait_s > 0:
            seconds = max(1, math.ceil(wait_s))
            text = f"Too many wrong tokens came from this address. Try again in {seconds} s."
            return _form(text, status=429, headers={"retry-after": str(seconds)})
        if self._door.knows(token):
            return self._welcome(asked)
        self._attempts.wrong(asked.address)
        await asyncio.sleep(_WRONG_DELAY_S)
        return _form("This is not the token of the running workbench.", status=401)

    async def take_form(self, request: Request, asked: Asked) -> Response:
        """Answer the form."""
        body = bytearray()
        try:
            async for chunk in request.stream():
                body += chunk
                if len(body) > _LONGEST_FORM:
                    return PlainTextResponse("This is longer than any token.\n", status_code=413)
        except ClientDisconnect:
            return Response(status_code=400)
        words = parse_qs(body.decode(errors="replace"))
        return await self.show(asked, words.get("token", [""])[-1].strip())

    def ask(self) -> Response:
        """Answer somebody who shows nothing."""
        return _form("", status=401)

    def _welcome(self, asked: Asked) -> Response:
        response = go_on()
        response.set_cookie(
            self._door.cookie_name,
            self._door.new_cookie(),
            path=asked.prefix,
            secure=asked.secure,
            httponly=True,
            samesite="strict",
        )
        return response


def go_on() -> Response:
    """Return a page that moves on to the workbench: a strict cookie set by a redirect is lost after a foreign link."""
    body = '<h1>ladarreg</h1><p>Opening. <a href="./">Continue</a></p>'
    return HTMLResponse(_page(body, head='<meta http-equiv="refresh" content="0; url=./">'), headers=_HEADERS)


def _form(said: str, *, status: int, headers: dict[str, str] | None = None) -> Response:
    bad = f'<p class="bad" role="alert">{html.escape(said)}</p>' if said else ""
    page = _page(
        f"<h1>ladarreg</h1>{bad}"
        "<p>The workbench is open to those who have its token. It is in the address that was printed where it was"
        " started.</p>"
        '<form method="post" action="./enter"><label for="token">Token</label>'
        '<input id="token" name="token" type="password" autocomplete="current-password" required autofocus>'
        "<button>Enter</button></form>"
    )
    return HTMLResponse(page, status_code=status, headers=_HEADERS | (headers or {}))


def _page(body: str, *, head: str = "") -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{head}<title>ladarreg</title><style>{_STYLE}</style></head><body><main>{body}</main></body></html>"
    )
