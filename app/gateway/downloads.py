"""Downloads: pictures of the scan, the photographs and their overlays, zips of exported results, and reports."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from ladarreg_core.errors import LadarregError, OptionError

from .protocol import Workbench

_MAX_CONCURRENT = 2
"""Pictures that are drawn at a time, and parts of the model besides: those of a large survey take half a minute."""
_MODEL = "model/"
_HOUR_S = 3600
_CLIENT_CLOSED_REQUEST = 499
_REPORT_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Content security policy of a report, which needs nothing but its own styles and pictures."""


class Pictures:
    """Serves `/picture/...`.

    Args:
        workbench: draws the pictures.
    """

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench
        self._slots = [asyncio.Semaphore(_MAX_CONCURRENT) for _ in range(2)]
        self._readers_slots = [asyncio.Semaphore(1) for _ in range(2)]  # an editor waits for at most one of theirs

    async def serve(self, request: Request) -> Response:
        """Return a picture."""
        path, query = request.path_params["path"], dict(request.query_params)
        of_model = path.startswith(_MODEL)
        readers = self._readers_slots[of_model] if request.state.read_only else nullcontext()
        async with readers, self._slots[of_model]:
            if await request.is_disconnected():  # a slider that is being dragged has already requested the next one
                return Response(status_code=_CLIENT_CLOSED_REQUEST)
            try:
                picture = await run_in_threadpool(self._workbench.picture, path, query)
            except OptionError as error:
                return PlainTextResponse(f"{error}\n", status_code=400)
            except LadarregError as error:
                return PlainTextResponse(f"{error}\n", status_code=404)
        etag = '"' + "".join(c for c in picture.etag if (c.isascii() and c.isalnum()) or c in "-_.") + '"'
        cache_control = f"private, max-age={_HOUR_S}" if query.get("rev") else "private, no-cache"
        headers = {"etag": etag, "cache-control": cache_control, **picture.headers}
        if etag in (tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")):
            return Response(status_code=304, headers=headers)
        return Response(picture.data, media_type=picture.media_type, headers=headers)


class Exports:
    """Serves `/export/NAME.zip` and `/export/NAME.html`, where NAME is a photograph's id or `all`.

    Args:
        workbench: has the latest export and the latest report of each.
    """

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench

    async def serve(self, request: Request) -> Response:
        """Return the latest zip."""
        found = await run_in_threadpool(self._workbench.export_file, request.path_params["name"])
        if found is None or not found[0].is_file():
            return PlainTextResponse("There is no such export yet; run the export first.\n", status_code=404)
        path, name = found
        return FileResponse(
            path, filename=name, media_type="application/zip", headers={"cache-control": "private, no-cache"}
        )

    async def serve_report(self, request: Request) -> Response:
        """Return the latest report of a photograph, to be shown in a tab of its own."""
        found = await run_in_threadpool(self._workbench.export_file, request.path_params["name"], "html")
        if found is None or not found[0].is_file():
            return PlainTextResponse("This photograph has no report yet; write one first.\n", status_code=404)
        path, name = found
        headers = {"cache-control": "private, no-cache", "content-security-policy": _REPORT_POLICY}
        return FileResponse(
            path, filename=name, media_type="text/html", content_disposition_type="inline", headers=headers
        )
