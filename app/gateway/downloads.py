"""Results to take home."""

from __future__ import annotations

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from .protocol import Workbench


class Exports:
    """Serves `/export/PHOTO.zip`.

    Args:
        workbench: knows the last export of each photograph.
    """

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench

    async def serve(self, request: Request) -> Response:
        """Return the last export."""
        found = await run_in_threadpool(self._workbench.export_file, request.path_params["photo"])
        if found is None or not found[0].is_file():
            return PlainTextResponse("Nothing was exported of this photograph yet; export it first.\n", status_code=404)
        path, name = found
        return FileResponse(
            path, filename=name, media_type="application/zip", headers={"cache-control": "private, no-cache"}
        )
