"""The gateway's routes (docs/workbench.md)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.types import ASGIApp

from ..process_resources import raise_descriptor_limit
from .document_socket import ClientRegistry, DocumentSocket
from .downloads import Exports, Pictures
from .login import Credentials
from .options import GatewayOptions
from .page.files import PageFiles
from .page.folder import Pages, static_folder
from .protocol import Workbench
from .security import Guard
from .uploads import Uploads
from .viser_backend import ViserAddress
from .viser_proxy import ViserProxy


def build_site(
    workbench: Workbench,
    *,
    token: str,
    read_only_token: str = "",
    viser: Callable[[], ViserAddress],
    options: GatewayOptions,
    folder: Path | None = None,
) -> ASGIApp:
    """Return the application with all routes, behind its security layer.

    Args:
        workbench: the application's state.
        token: the token that grants access.
        read_only_token: the token that grants looking only; empty: there is none.
        viser: returns the address of the locked viser server; may block until it is open.
        options: how the gateway is reached.
        folder: of the page's files; None: those of the installation.
    """
    limits = options.limits.within(raise_descriptor_limit())
    clients = ClientRegistry()
    proxy = ViserProxy(viser, clients, most=limits.views)
    proxy.prepare()
    folder = folder or static_folder()
    pages, files = Pages(folder), PageFiles(folder)

    async def page(request: Request) -> Response:
        return await run_in_threadpool(
            lambda: files.front_page(workbench.first_pictures(), request.headers, viewer=proxy.known_address)
        )

    async def versioned(request: Request) -> Response:
        return await run_in_threadpool(files.versioned, request)

    async def unversioned(request: Request) -> Response:
        return await run_in_threadpool(files.unversioned, request)

    async def to_viser(request: Request) -> Response:
        return RedirectResponse("viser/", status_code=307)  # relative: a proxy in front may add a prefix

    inner = Starlette(
        routes=[
            Route("/", page),
            Route("/v/{version}/{path:path}", versioned),
            Route("/js/{path:path}", unversioned),
            WebSocketRoute("/document", DocumentSocket(workbench, clients).serve),
            Route("/picture/{path:path}", Pictures(workbench).serve),
            Route("/upload", Uploads(workbench, clients).serve, methods=["POST"]),
            Route("/export/{name}.zip", Exports(workbench).serve),
            Route("/export/{name}.html", Exports(workbench).serve_report),
            Route("/viser", to_viser),
            Route("/viser/{path:path}", proxy.page),
            WebSocketRoute("/viser", proxy.websocket),
            WebSocketRoute("/viser/{client:path}", proxy.websocket),
            Mount("/static", pages),
            Mount("/", pages),
        ]
    )
    inner.router.redirect_slashes = False
    return Guard(inner, Credentials(token, read_only_token=read_only_token), options)
