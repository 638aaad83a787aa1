"""The page's own files."""

from __future__ import annotations

import mimetypes
import os
from functools import cache
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

# What the system says of these is what its last installer thought, and with `nosniff` a wrong word stops the page.
for _suffix, _kind in ((".js", "text/javascript"), (".css", "text/css"), (".svg", "image/svg+xml")):
    mimetypes.add_type(_kind, _suffix)
_REVALIDATE = {"cache-control": "no-cache"}


class Pages(StaticFiles):
    """The files of a folder, asked for anew each time so that a newer program brings its newer page.

    Args:
        folder: what is served of it are the files that do not begin with a dot.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).send_denial_response(Response(status_code=404))
            return
        await super().__call__(scope, receive, send)

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, or say that there is none."""
        if any(part.startswith(".") for part in Path(path).parts) or set(scope["path"]) & {"\\", "\0"}:
            raise HTTPException(404)
        return await super().get_response(path, scope)

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """Return a file's content, or that it has not changed."""
        response = super().file_response(full_path, stat_result, scope, status_code)
        response.headers.update(_REVALIDATE)
        return response


def front_page(folder: Path, request: Request) -> Response:
    """Return the page itself."""
    path = folder / "index.html"
    if not path.is_file():
        raise HTTPException(404)
    response = Pages(folder).file_response(path, path.stat(), request.scope)
    response.headers["content-type"] = "text/html; charset=utf-8"
    return response


_ANCHOR = "tokens.css"


@cache
def static_folder() -> Path:
    """Return the folder of the page's files.

    Raises:
        FileNotFoundError: if the installation is broken.
    """
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "static", here.parent / "static"):
        if (folder / _ANCHOR).is_file():
            return folder
    raise FileNotFoundError(f"the page's files are missing beside {here}; install ladarreg again")


def static_text(name: str) -> str:
    """Return the text of one of the page's files."""
    return (static_folder() / name).read_text(encoding="utf-8")
