"""The page's own files: their folder, beside the source tree or inside an installed wheel, and how they are served."""

from __future__ import annotations

import mimetypes
import os
from functools import cache
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

# The system's own table may have been changed by any installer; with `nosniff` a wrong type breaks the page.
for _suffix, _media_type in (
    (".js", "text/javascript"),
    (".css", "text/css"),
    (".svg", "image/svg+xml"),
    (".map", "application/json"),
):
    mimetypes.add_type(_media_type, _suffix)
_REVALIDATE = {"cache-control": "no-cache"}
_MARKER_FILE = "tokens.css"


@cache
def static_folder() -> Path:
    """Return the folder of the page's files.

    Raises:
        FileNotFoundError: if the installation is incomplete.
    """
    package = Path(__file__).resolve().parents[2]
    for folder in (package / "static", package.parent / "static"):
        if (folder / _MARKER_FILE).is_file():
            return folder
    raise FileNotFoundError(f"the page's files are missing beside {package}; reinstall ladarreg")


def static_text(name: str) -> str:
    """Return the text of one of the page's files."""
    return (static_folder() / name).read_text(encoding="utf-8")


class Pages(StaticFiles):
    """The files of a folder, revalidated on every request so that a newer program delivers its newer page.

    Args:
        folder: its files are served, except those whose path contains a name that begins with a dot.
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
        """Return a file, or raise 404."""
        if any(part.startswith(".") for part in Path(path).parts) or set(scope["path"]) & {"\\", "\0"}:
            raise HTTPException(404)
        return await super().get_response(path, scope)

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """Return a file's content, or 304 if the browser's copy is current."""
        response = super().file_response(full_path, stat_result, scope, status_code)
        response.headers.update(_REVALIDATE)
        return response
