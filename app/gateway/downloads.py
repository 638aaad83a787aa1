"""Downloads: pictures of the scan, the photographs and their overlays, and zips of exported results."""

from __future__ import annotations

import asyncio

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from ladarreg_core.errors import LadarregError, OptionError

from .protocol import Workbench

_MAX_CONCURRENT = 2
_HOUR_S = 3600
_CLIENT_CLOSED_REQUEST = 499


class Pictures:
    """Serves `/picture/...`.

    Args:
        workbench: draws the pictures.
    """

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench
        self._slots = asyncio.Semaphore(_MAX_CONCURRENT)

    async def serve(self, request: Request) -> Response:
        """Return a picture."""
        query = dict(request.query_params)
        async with self._slots:
            if await request.is_disconnected():  # a slider that is being dragged has already requested the next one
                return Response(status_code=_CLIENT_CLOSED_REQUEST)
            try:
                picture = await run_in_threadpool(self._workbench.picture, request.path_params["path"], query)
            except OptionError as error:
                return PlainTextResponse(f"{error}\n", status_code=400)
            except LadarregError as error:
                return PlainTextResponse(f"{error}\n", status_code=404)
        etag = '"' + "".join(c for c in picture.etag if (c.isascii() and c.isalnum()) or c in "-_.") + '"'
        cache_control = f"private, max-age={_HOUR_S}" if query.get("rev") else "private, no-cache"
        headers = {"etag": etag, "cache-control": cache_control}
        if etag in (tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")):
            return Response(status_code=304, headers=headers)
        return Response(picture.data, media_type=picture.media_type, headers=headers)


class Exports:
    """Serves `/export/PHOTO.zip`.

    Args:
        workbench: has the latest export of each photograph.
    """

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench

    async def serve(self, request: Request) -> Response:
        """Return the latest export of a photograph."""
        found = await run_in_threadpool(self._workbench.export_file, request.path_params["photo"])
        if found is None or not found[0].is_file():
            return PlainTextResponse("This photograph has no export yet; run the export first.\n", status_code=404)
        path, name = found
        return FileResponse(
            path, filename=name, media_type="application/zip", headers={"cache-control": "private, no-cache"}
        )
