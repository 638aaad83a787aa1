"""The token, and the cookie that stands for it."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import html
import ipaddress
import secrets
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from urllib.parse import parse_qs

from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from ladarreg_core.errors import OptionError

from .request_source import Asked

SHORTEST = 12
"""Characters that a token needs at least."""
_UNGUESSABLE = 22
"""Characters of base64 that hold 128 random bits."""
_ID_BYTES = 16


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(24)


def checked_token(token: str) -> str:
    """Return a token that somebody chose.

    Raises:
        OptionError: if it is short, or cannot stand in an address.
    """
    if len(token) < SHORTEST:
        raise OptionError(
            f"the token has {len(token)} characters; it needs {SHORTEST} at least, or leave it out for a random one"
        )
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise OptionError("the token holds a space or a letter that is not ASCII; use letters, digits and - . _ ~")
    return token


class Door:
    """Who is let in: whoever shows the token, and the browsers that have shown it.

    A cookie is a browser's random number and a code of it that only the token makes: no cookie gives the token away,
    browsers can be told apart, and with a token of one's own a browser stays known when the program starts anew.

    Args:
        token: what opens the door.
        port: where the gateway listens: browsers share cookies between the ports of a host.
    """

    def __init__(self, token: str, *, port: int) -> None:
        self.cookie_name = f"ladarreg-{port}"
        self.unguessable = len(token) >= _UNGUESSABLE
        """Whether the token is so long that trying does not help."""
        self._token = hashlib.sha256(token.encode()).digest()
        self._key = hmac.digest(token.encode(), b"ladarreg cookie", "sha256")

    def knows(self, token: str) -> bool:
        """Tell whether this is the token, in the same time for every wrong one."""
        return hmac.compare_digest(hashlib.sha256(token.encode(errors="replace")).digest(), self._token)

    def new_cookie(self) -> str:
        """Return the cookie of a browser that has shown the token."""
        browser = secrets.token_hex(_ID_BYTES)
        return f"{browser}.{self._code(browser)}"

    def browser(self, cookies: str) -> str | None:
        """Return whose cookie is among these, None if there is none that we made.

        Args:
            cookies: the header Cookie.
        """
        for part in cookies.split(";"):
            name, _, value = part.strip().partition("=")
            browser, _, code = value.strip().strip('"').partition(".")
            if name == self.cookie_name and hmac.compare_digest(
                code.encode(errors="replace"), self._code(browser).encode()
            ):
                return browser
        return None

    def _code(self, browser: str) -> str:
        return hmac.new(self._key, browser.encode(errors="replace"), "sha256").hexdigest()


_MOST_ADDRESSES = 4096
_PACE_S = 3.0
_LONGEST_WAIT_S = 30.0


class Attempts:
    """Counts wrong tokens by address, forgets them after a while, and spaces further tries of an address out.

    Args:
        most: wrong tokens that an address may show within `window_s` before it has to wait.
        window_s: how long a wrong token counts, s.
        clock: monotonic time, s.
    """

    def __init__(self, *, most: int = 10, window_s: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._window_s, self._clock = most, window_s, clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()
        self._next: dict[str, float] = {}

    def turn_s(self, address: str, kind: str = "") -> float | None:
        """Give an address its turn to have a token compared.

        Args:
            address: of the browser.
            kind: of the way the token came by; each is counted by itself.

        Returns:
            How long to wait before, s: 0 while few were wrong; None where so many wait that this one is turned away.
        """
        household = _household(address, kind)
        now = self._clock()
        if len(self._recent(household)) < self._most:
            return 0.0
        turn = max(now, self._next.get(household, now))
        if turn - now > _LONGEST_WAIT_S:
            return None
        self._next[household] = turn + _PACE_S
        return turn - now

    def wrong(self, address: str, kind: str = "") -> None:
        """Note that an address showed a wrong token."""
        household = _household(address, kind)
        times = self._recent(household)
        times.append(self._clock())
        self._wrong[household] = times
        self._wrong.move_to_end(household)
        while len(self._wrong) > _MOST_ADDRESSES:
            self._next.pop(self._wrong.popitem(last=False)[0], None)

    def _recent(self, household: str) -> deque[float]:
        times = self._wrong.get(household, deque(maxlen=self._most))
        while times and times[0] <= self._clock() - self._window_s:
            times.popleft()
        return times


def _household(address: str, kind: str) -> str:
    """Return what one person may have many of, the network of an IPv6 address, with the kind of try."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return f"{kind} {address}"
    if parsed.version == 6:
        mapped = parsed.ipv4_mapped
        return f"{kind} {mapped or ipaddress.ip_network((parsed, 64), strict=False)}"
    return f"{kind} {address}"


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
