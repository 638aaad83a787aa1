"""In front of everything: asked under a name of ours, by a page of ours, by a browser that has shown the token."""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from .connections import KEY, Connection
from .login import Door, Entrance, go_on
from .options import GatewayOptions, is_loopback
from .request_source import Asked, asked_of

_READING = ("GET", "HEAD")


class Guard:
    """Lets requests pass to the site, or answers them itself.

    Args:
        inner: the site; `scope["state"]["browser"]` tells it who asks.
        door: knows the token and the cookies.
        options: under which names the gateway is reached.
    """

    def __init__(self, inner: ASGIApp, door: Door, options: GatewayOptions) -> None:
        self._inner, self._door, self._options = inner, door, options
        self._entrance = Entrance(door)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or a websocket, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            return
        asked = asked_of(scope, behind_proxy=self._options.behind_proxy)
        scope.setdefault("state", {})["address"] = asked.address
        refusal = self._refusal(scope, asked)
        if scope["type"] == "websocket":
            if refusal is None and not self._know(scope):
                refusal = _plain(401, "Open the workbench's page with its token first.")
            refusal = refusal or _no_room(scope)
            if refusal is None:
                await self._inner(scope, receive, send)
            else:
                await WebSocket(scope, receive, send).send_denial_response(refusal)
            return
        send = self._with_headers(scope, asked, send)
        answer = refusal or await self._at_the_door(Request(scope, receive), asked)
        await (answer or self._inner)(scope, receive, send)

    def _refusal(self, scope: Scope, asked: Asked) -> Response | None:
        if not asked.host:
            return _plain(400, "The header Host is missing or cannot be read.")
        if not self._is_ours(asked):
            return _plain(403, "This name is not one of the workbench's; start it with --allow-host to add it.")
        reading = scope["type"] == "http" and scope["method"] in _READING
        if not reading and not asked.same:
            return _plain(403, "This was asked by a page that is not the workbench's.")
        return None

    def _is_ours(self, asked: Asked) -> bool:
        options = self._options
        allowed = {name.lower() for name in options.allowed_hosts}
        if not allowed and (options.behind_proxy or not options.on_loopback):
            return True
        return is_loopback(asked.name) or asked.name.strip("[]") in allowed | {options.host.lower()}

    async def _at_the_door(self, request: Request, asked: Asked) -> Response | None:
        """Return the answer to somebody who is not in yet, None to somebody who is."""
        known = self._know(request.scope)
        path, token = request.scope["path"], request.query_params.get("token")
        if path == "/" and token is not None and request.method in _READING:
            return go_on() if known else await self._entrance.show(asked, token)
        if path == "/enter" and request.method == "POST":
            return await self._entrance.take_form(request, asked)
        if known:
            return _no_room(request.scope)
        if path in ("/", "/enter") and request.method in _READING:
            return self._entrance.ask()
        return _plain(401, "Open the workbench's page with its token first.")

    def _know(self, scope: Scope) -> bool:
        cookies = ";".join(Headers(scope=scope).getlist("cookie"))
        browser = self._door.browser(cookies)
        scope["state"]["browser"] = browser
        return browser is not None

    def _with_headers(self, scope: Scope, asked: Asked, send: Send) -> Send:
        secure = security_headers(scope["path"], asked, tls=self._options.tls)

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in secure.items():
                    headers.setdefault(name, value)
            await send(message)

        return with_headers


def _no_room(scope: Scope) -> Response | None:
    """Count the connection of somebody who is in; return the answer where there are too many."""
    connection: Connection | None = scope["state"].get(KEY)
    if connection is None or connection.identify():
        return None
    return _plain(503, "More connections are open than the workbench serves; close pages of it that nobody needs.")


def _plain(status: int, text: str) -> Response:
    return PlainTextResponse(text + "\n", status_code=status)


PAGE_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self'; script-src 'self'; connect-src 'self'; "
    "frame-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
"""Of everything but viser."""
# viser's page is one inline script that unpacks, by WebAssembly, the script and the style that it adds to itself:
# neither a hash nor a nonce can name them. Its decoders and textures are fetched from blobs and data. Without
# 'unsafe-eval' its console shows one EvalError, of the sorter of Gaussian splats; splats and Plotly do not work, and no
# message can bring a script.
VISER_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src blob: data:; connect-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Of viser's page."""
_DAY_S = 86_400


def is_visers(path: str) -> bool:
    """Tell whether a path leads to viser."""
    return path == "/viser" or path.startswith("/viser/")


def security_headers(path: str, asked: Asked, *, tls: bool) -> dict[str, str]:
    """Return the headers that an answer gets where it does not set them itself.

    Args:
        path: what was asked for.
        asked: who asks.
        tls: whether the gateway speaks TLS itself.
    """
    headers = {
        "content-security-policy": VISER_POLICY if is_visers(path) else PAGE_POLICY,
        "x-content-type-options": "nosniff",
        "x-frame-options": "SAMEORIGIN",
        "referrer-policy": "no-referrer",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "permissions-policy": "camera=(), display-capture=(), geolocation=(), microphone=(), payment=(), usb=()",
        "cache-control": "no-store",
    }
    # It holds for all ports of a name: not for localhost, where others serve without TLS, and not for long.
    if tls and not is_loopback(asked.name):
        headers["strict-transport-security"] = f"max-age={_DAY_S}"
    return headers
