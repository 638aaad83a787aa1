"""The way in: the token becomes a cookie, and leaves the address bar."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import html
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from .attempts import Attempts
from .forwarded import Asked
from .login import Door

_LONGEST_FORM = 4096
_WRONG_DELAY_S = 0.3
_LATER_S = 30
_KINDS = {"none": "typed", "same-origin": "typed", "same-site": "linked", "cross-site": "linked"}
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
# An address that holds a token, even a wrong one, does not stay where the browser's Back button leads.
_GO_ON = 'location.replace("./")'
_FORGET = 'history.replaceState(null, "", "./")'


def _headers(script: str, *, referrer: str) -> dict[str, str]:
    return {
        "content-security-policy": f"default-src 'none'; style-src '{_digest(_STYLE)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
        "referrer-policy": referrer,
        "x-frame-options": "DENY",
    }


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


_GO_ON_HEADERS = _headers(_GO_ON, referrer="no-referrer")
# With `no-referrer` the form's own Origin would be `null`.
_FORM_HEADERS = _headers(_FORGET, referrer="strict-origin")


class Entrance:
    """Answers those who show a token, and those who show nothing.

    Args:
        door: knows the token.
    """

    def __init__(self, door: Door) -> None:
        self._door, self._attempts = door, Attempts()

    async def show(self, asked: Asked, token: str, *, by_form: bool = False) -> Response:
        """Answer somebody who shows a token.

        A page of another site can have a browser show wrong ones. It must not shut out those who use that browser, or
        its address: what such a page causes is counted apart from what a person types, the form (which no other site
        can send, its Origin being checked) apart from both, and a token that cannot be guessed opens whatever else was
        tried.
        """
        if asked.shown_as not in ("", "document"):
            return PlainTextResponse("A token is shown by opening a page with it.\n", status_code=403)
        right, kind = self._door.knows(token), "form" if by_form else _KINDS.get(asked.from_site, "unsaid")
        if not (right and self._door.unguessable):
            turn_s = self._attempts.turn_s(asked.address, kind)
            if turn_s is None:
                text = "Too many wrong tokens came from this address. Enter the right one here, or try again later."
                return _form(text, status=429, headers={"retry-after": str(_LATER_S)})
            if turn_s > 0:
                await asyncio.sleep(turn_s)
        if right:
            return self._welcome(asked)
        self._attempts.wrong(asked.address, kind)
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
        return await self.show(asked, words.get("token", [""])[-1].strip(), by_form=True)

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
    head = f'<script>{_GO_ON}</script><noscript><meta http-equiv="refresh" content="0; url=./"></noscript>'
    return HTMLResponse(_page(body, head=head), headers=_GO_ON_HEADERS)


def _form(said: str, *, status: int, headers: dict[str, str] | None = None) -> Response:
    bad = f'<p class="bad" role="alert">{html.escape(said)}</p>' if said else ""
    page = _page(
        f"<h1>ladarreg</h1>{bad}"
        "<p>The workbench is open to those who have its token. It is in the address that was printed where it was"
        " started.</p>"
        '<form method="post" action="./enter"><label for="token">Token</label>'
        '<input id="token" name="token" type="password" autocomplete="current-password" required autofocus>'
        "<button>Enter</button></form>",
        head=f"<script>{_FORGET}</script>",
    )
    return HTMLResponse(page, status_code=status, headers=_FORM_HEADERS | (headers or {}))


def _page(body: str, *, head: str = "") -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{head}<title>ladarreg</title><style>{_STYLE}</style></head><body><main>{body}</main></body></html>"
    )
