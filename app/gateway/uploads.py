"""Uploads: streamed to disk, checked against the limits as they arrive, and removed if they are not completed."""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import secrets
import shutil
import time
import unicodedata
from collections import Counter
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from urllib.parse import unquote

from anyio import CapacityLimiter, to_thread
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.types import Receive, Scope, Send

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.storage.atomic_write import move_file

from ..argument_names import as_fields
from .document_socket import ClientRegistry
from .protocol import Workbench

log = logging.getLogger(__name__)
T = TypeVar("T")
KINDS = ("scan", "photo", "camera", "matches")
"""Types of file that can be uploaded."""
STATION = "station"
"""In place of `scan`: the scan of a further station."""
_ANY = "any"
"""In place of a type: the content decides, when the batch is complete."""
_MAX_PER_BROWSER = 2
_MAX_CONCURRENT, _SLOT_TIMEOUT_S = 8, 30.0
"""Uploads under way, of all browsers, and how long a further one waits for one of them to end."""
_WRITING_THREADS, _OPENING_THREADS = 4, 2
"""Threads of their own: commands find theirs, however many files are written and opened."""
_BLOCK_BYTES = 1 << 20
_RESERVED_BYTES = 1 << 28
"""Free disk space that uploads must leave."""
_DRAIN_S = 5.0
_IDLE_TIMEOUT_S = 60.0
"""A browser that sends nothing for this long is considered disconnected."""
_BUSY = f"{_MAX_CONCURRENT} files are being uploaded already, the most at a time; upload the file again in a moment"
_PART = re.compile(r"[0-9a-f]{32}\.part")
_FOLDER_MISSING = (
    "the folder of the project is missing: it was moved, renamed or deleted, or its disk was removed; the work is still"
    " in memory: restore the folder, then upload the file again"
)


class UploadError(LadarregError):
    """A refused file, with its HTTP status."""

    def __init__(self, text: str, *, status: int) -> None:
        super().__init__(text)
        self.status = status


class Uploads:
    """Serves `POST /upload`.

    Args:
        workbench: opens the files.
        clients: registry of the open pages.
    """

    def __init__(self, workbench: Workbench, clients: ClientRegistry) -> None:
        self._workbench, self._clients = workbench, clients
        self._under_way: Counter[str] = Counter()
        self._slots = asyncio.Semaphore(_MAX_CONCURRENT)
        self._writing, self._opening = CapacityLimiter(_WRITING_THREADS), CapacityLimiter(_OPENING_THREADS)
        remove_partial_uploads(workbench.upload_folder())

    async def serve(self, request: Request) -> Response:
        """Receive a file."""
        browser = request.state.browser
        try:
            async with self._slot(browser):
                return await self._receive(request, browser)
        except ClientDisconnect:
            log.debug("an upload was abandoned")
            return Response(status_code=400)
        except UploadError as error:
            return _Refusal({"ok": False, "error": str(error)}, status_code=error.status)
        except LadarregError as error:
            return _Refusal({"ok": False, "error": str(error)}, status_code=400)
        except OSError as error:
            log.warning("an upload failed: %s", error)
            refusal = await self._in_thread(_disk_error, error, self._workbench.upload_folder())
            return _Refusal({"ok": False, "error": str(refusal)}, status_code=refusal.status)

    async def _receive(self, request: Request, browser: str) -> Response:
        what, photo = request.query_params.get("what", ""), request.query_params.get("photo") or None
        known = (*KINDS, STATION, _ANY)
        if what not in known:
            raise OptionError(f"unknown type of file; give one of {', '.join(known)} as ?what=")
        name = upload_name(request.headers.get("x-file-name"))
        folder, most = self._workbench.upload_folder(), self._workbench.limits.upload_bytes
        await self._in_thread(partial(folder.mkdir, exist_ok=True))  # its parent, the project's folder, must exist
        _check_size(_declared_size(request), most, folder)
        part = folder / f"{secrets.token_hex(16)}.part"
        path = part.with_suffix(safe_suffix(name))
        try:
            await self._stream(request, part, most)
            await self._in_thread(move_file, part, path)  # on disk before it is confirmed
        except BaseException:
            _remove(part, path)
            raise
        try:
            client = self._clients.find(browser, request.query_params.get("client", ""))
            take = partial(self._workbench.take_upload, path, name, what, photo, client)
            opened = await to_thread.run_sync(take, limiter=self._opening)
        except Exception as error:  # the workbench has removed the file, unless it is in the project
            if not isinstance(error, LadarregError):
                raise
            # Readers name a file by its path, which must not be disclosed.
            raise UploadError(
                as_fields(str(error)).replace(str(path), name).replace(path.name, name), status=400
            ) from None
        return JSONResponse({"ok": True, "id": opened})

    @asynccontextmanager
    async def _slot(self, browser: str) -> AsyncGenerator[None]:
        if self._under_way[browser] >= _MAX_PER_BROWSER:
            text = f"this browser is already uploading {_MAX_PER_BROWSER} files; wait until one has finished"
            raise UploadError(text, status=429)
        self._under_way[browser] += 1
        try:
            async with _before(_SLOT_TIMEOUT_S, _BUSY, 429):
                await self._slots.acquire()
            try:
                yield
            finally:
                self._slots.release()
        finally:
            self._under_way[browser] -= 1
            self._under_way += Counter()  # removes entries at zero

    async def _stream(self, request: Request, part: Path, most: int) -> None:
        """Write the body of a request to a file."""
        file = await self._in_thread(lambda: part.open("xb"))
        try:
            await self._copy(request, file, part.parent, most)
        finally:
            file.close()  # before its removal, which some systems refuse while it is open

    async def _copy(self, request: Request, file: BinaryIO, folder: Path, most: int) -> None:
        received, block = 0, bytearray()
        chunks = request.stream()
        while (chunk := await _next(chunks)) is not None:
            received += len(chunk)
            block += chunk
            _check_size(received, most, None)
            if len(block) >= _BLOCK_BYTES:
                await self._in_thread(file.write, bytes(block))
                _check_size(0, most, folder)
                block.clear()
        await self._in_thread(file.write, bytes(block))
        if not received:
            raise OptionError("the file is empty; choose another")

    async def _in_thread(self, do: Callable[..., T], *arguments: Any) -> T:
        return await to_thread.run_sync(do, *arguments, limiter=self._writing)


def remove_partial_uploads(folder: Path) -> None:
    """Remove what a killed program left: only this one has the project open, and it has accepted no upload yet."""
    for part in folder.glob("*.part"):
        if _PART.fullmatch(part.name):
            part.unlink(missing_ok=True)


class _Refusal(JSONResponse):
    """A refusal sent while the body still arrives: reads on for a while, or the connection would close without it."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        await send({"type": "http.response.body", "body": self.body, "more_body": True})
        until = time.monotonic() + _DRAIN_S
        more = True
        while more and (left := until - time.monotonic()) > 0:
            try:
                message = await asyncio.wait_for(receive(), left)
            except TimeoutError:
                break
            more = message["type"] == "http.request" and message.get("more_body", False)
        await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _next(chunks: AsyncGenerator[bytes, None]) -> bytes | None:
    """Return the next chunk of a body; None at its end."""
    refusal = f"nothing was received for {_IDLE_TIMEOUT_S:g} s; upload the file again"
    async with _before(_IDLE_TIMEOUT_S, refusal, 408):
        return await anext(chunks, None)


@asynccontextmanager
async def _before(seconds: float, refusal: str, status: int) -> AsyncGenerator[None]:
    """Refuse an upload if something takes too long."""
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError:
        raise UploadError(refusal, status=status) from None


def _remove(*paths: Path) -> None:
    for path in paths:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _disk_error(error: OSError, folder: Path) -> UploadError:
    """Return the error to report when the disk refused a file."""
    if not folder.is_dir():
        return UploadError(_FOLDER_MISSING, status=409)
    if error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None)):
        return UploadError("the disk of the workbench is full; free some space there", status=507)
    reason = (error.strerror or type(error).__name__).lower()
    return UploadError(
        f"the file cannot be saved: {reason}; check the project's folder, then upload it again", status=507
    )


def _declared_size(request: Request) -> int:
    text = request.headers.get("content-length", "")
    return int(text) if text.isascii() and text.isdigit() else 0


def _check_size(size: int, most: int, folder: Path | None) -> None:
    if size > most:
        raise UploadError(f"the file is larger than the limit of {most / 2**20:.3g} MB", status=413)
    if folder is not None and shutil.disk_usage(folder).free < size + _RESERVED_BYTES:
        raise UploadError("the disk of the workbench is nearly full; free some space there", status=507)


_MAX_NAME_LENGTH = 255
_SUFFIX = re.compile(r"\.[a-z0-9]{1,8}")


def upload_name(header: str | None) -> str:
    """Return the name of an uploaded file for display; it is never used as a path.

    Args:
        header: X-File-Name, percent-encoded UTF-8.

    Raises:
        OptionError: if it is missing, too long, or not a file name.
    """
    name = unicodedata.normalize("NFC", unquote(header or "", errors="replace"))
    # Invisible characters that join letters or change their direction: in a displayed name they only mislead.
    name = "".join(character for character in name if unicodedata.category(character) != "Cf").strip()
    if not name:
        raise OptionError("the file has no name; send it in the header X-File-Name")
    if len(name) > _MAX_NAME_LENGTH:
        raise OptionError(f"the file's name has {len(name)} characters; shorten it to {_MAX_NAME_LENGTH}")
    if set(name) & set("/\\") or name.strip(".") == "":
        raise OptionError("the file's name is a path; send only the name")
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
        raise OptionError("the file's name contains control characters; rename it")
    return name


def safe_suffix(name: str) -> str:
    """Return a name's suffix in lower case; empty unless it is short and alphanumeric."""
    suffix = "." + name.rpartition(".")[2].lower() if "." in name else ""
    return suffix if _SUFFIX.fullmatch(suffix) else ""
