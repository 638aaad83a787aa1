"""The security layer in front of every route: checks Host, Origin and session, and adds the security headers."""

from __future__ import annotations

from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from .connections import CONNECTION_KEY, Connection
from .login import Credentials, LoginPages, session_name_and_path
from .options import GatewayOptions
from .protocol import READ_ONLY
from .request_source import RequestSource, is_loopback, request_source

PAGE_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self'; script-src 'self'; connect-src 'self'; "
    "frame-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
"""Content security policy of everything but viser."""
# viser's page is one inline script that unpacks, by WebAssembly, the script and the style that it adds to itself:
# neither a hash nor a nonce can name them. Its decoders and textures are fetched from blobs and data. Without
# 'unsafe-eval' its console shows one EvalError, of the sorter of Gaussian splats; splats and Plotly do not work, and no
# message can bring a script.
VISER_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src blob: data:; connect-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Content security policy of viser's page."""
READERS_MESSAGE_BYTES = 1 << 16
"""Length of the longest message accepted from a page or a 3-D view that may only look."""
_DAY_S = 86_400
_READING = ("GET", "HEAD")
_NO_SESSION = "Open the workbench's page with its token first."


class Guard:
    """ASGI middleware that passes permitted requests to the application and answers all others itself.

    Only the login is at the root; everything else is below the path of a session, which the application does not see.

    Args:
        inner: the application; it finds the browser's id in `scope["state"]["browser"]`, and in
            `scope["state"]["read_only"]` whether the browser may only look.
        credentials: the tokens and their sessions.
        options: host names under which the gateway is reached.
    """

    def __init__(self, inner: ASGIApp, credentials: Credentials, options: GatewayOptions) -> None:
        self._inner, self._credentials, self._options = inner, credentials, options
        self._login = LoginPages(credentials)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or a websocket, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            return
        source = request_source(scope, behind_proxy=self._options.behind_proxy)
        name, path = session_name_and_path(scope["path"])
        scope.setdefault("state", {})["address"] = source.address
        refusal = self._refusal(scope, source)
        if scope["type"] == "websocket":
            if refusal is None and not self._has_session(scope, name):
                refusal = _plain(401, _NO_SESSION)
            refusal = refusal or _refusal_at_limit(scope)
            if refusal is None:
                if scope["state"]["read_only"] and CONNECTION_KEY in scope["state"]:
                    scope["state"][CONNECTION_KEY].limit_messages(READERS_MESSAGE_BYTES)
                await self._inner(_within_session(scope, path), receive, send)
            else:
                await WebSocket(scope, receive, send).send_denial_response(refusal)
            return
        send = self._with_headers(path, source, send)
        if refusal is None and not source.is_from_elsewhere and self._has_session(scope, name):
            answer = self._answer_in_session(scope, path) or self._inner
            await answer(_within_session(scope, path), receive, send)
        else:
            answer = refusal or await self._login_response(Request(scope, receive), source)
            await answer(scope, receive, send)

    def _refusal(self, scope: Scope, source: RequestSource) -> Response | None:
        if not source.host:
            return _plain(400, "The header Host is missing or malformed.")
        if not self._is_allowed_host(source):
            return _plain(403, "The workbench is not reached by this host name; add it with --allow-host at the start.")
        reading = scope["type"] == "http" and scope["method"] in _READING
        # Another page may link to the login, and nothing else: a link may stand in a mail.
        linked = reading and source.fetch_dest == "document"
        if (not reading and not source.is_same_origin) or (source.is_from_elsewhere and not linked):
            return _plain(403, "The request comes from a page that is not the workbench's.")
        return None

    def _is_allowed_host(self, source: RequestSource) -> bool:
        options = self._options
        allowed = {name.lower() for name in options.allowed_hosts}
        if not allowed and (options.behind_proxy or not options.on_loopback):
            return True
        return is_loopback(source.hostname) or source.hostname.strip("[]") in allowed | {options.host.lower()}

    async def _login_response(self, request: Request, source: RequestSource) -> Response:
        """Return the response to a request without a session."""
        path, token = request.scope["path"], request.query_params.get("token")
        reading = request.method in _READING
        if path == "/" and token is not None and reading:
            return await self._login.submit_token(source, token)
        if path == "/enter" and request.method == "POST":
            return await self._login.submit_form(request, source)
        is_page = session_name_and_path(path)[1] in ("/", "/enter") or source.fetch_dest == "document"
        if not (reading and is_page):
            return _plain(401, _NO_SESSION)
        return self._login.form(request.scope.get("raw_path", path.encode()).decode("latin-1"))

    def _answer_in_session(self, scope: Scope, path: str) -> Response | None:
        """Return the response to what a session may not do, or need not ask the application; None: it may pass."""
        read_only = scope["state"]["read_only"]
        if read_only and scope["method"] not in _READING:
            return JSONResponse({"ok": False, "error": READ_ONLY}, status_code=403)
        if path == "/access":
            return _plain(200, "look" if read_only else "edit")
        return _refusal_at_limit(scope)

    def _has_session(self, scope: Scope, name: str) -> bool:
        cookies = ";".join(Headers(scope=scope).getlist("cookie"))
        session = self._credentials.session_of(cookies, name)
        scope["state"]["browser"] = session.browser if session else None
        scope["state"]["read_only"] = session is not None and session.read_only
        return session is not None

    def _with_headers(self, path: str, source: RequestSource, send: Send) -> Send:
        defaults = security_headers(path, source, tls=self._options.tls)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in defaults.items():
                    headers.setdefault(name, value)
            await send(message)

        return send_with_headers


def security_headers(path: str, source: RequestSource, *, tls: bool) -> dict[str, str]:
    """Return the headers that a response gets unless it sets them itself.

    Args:
        path: of the request, within its session.
        source: of the request.
        tls: whether the gateway itself speaks TLS.
    """
    headers = {
        "content-security-policy": VISER_POLICY if _is_viser(path) else PAGE_POLICY,
        "x-content-type-options": "nosniff",
        "x-frame-options": "SAMEORIGIN",
        "referrer-policy": "no-referrer",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "permissions-policy": "camera=(), display-capture=(), geolocation=(), microphone=(), payment=(), usb=()",
        "cache-control": "no-store",
    }
    # It applies to all ports of a name: not for localhost, where other programs serve without TLS, and for a day only.
    if tls and not is_loopback(source.hostname):
        headers["strict-transport-security"] = f"max-age={_DAY_S}"
    return headers


def _is_viser(path: str) -> bool:
    return path == "/viser" or path.startswith("/viser/")


def _refusal_at_limit(scope: Scope) -> Response | None:
    """Mark the connection as authenticated; return the refusal if there are too many."""
    connection: Connection | None = scope["state"].get(CONNECTION_KEY)
    read_only = scope["state"]["read_only"]
    if connection is None or connection.authenticate(read_only=read_only):
        return None
    return _plain(503, "The workbench has reached its limit of open connections; close pages that are not needed.")


def _within_session(scope: Scope, path: str) -> Scope:
    """Return the scope that the application sees: paths relative to the session."""
    return {**scope, "path": path, "raw_path": quote(path).encode()}


def _plain(status: int, text: str) -> Response:
    return PlainTextResponse(text + "\n", status_code=status)
