"""Files that pages send: streamed to disk, counted as they come, nothing left of what was not finished."""

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
from collections.abc import AsyncGenerator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote

from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.types import Receive, Scope, Send

from ladarreg_core.errors import LadarregError, OptionError

from .document_socket import Visitors
from .protocol import Workbench

log = logging.getLogger(__name__)
KINDS = ("scan", "photo", "camera", "matches")
"""What a file can be sent as."""
_AT_A_TIME = 2
_BLOCK = 1 << 20
_LEFT_FREE = 1 << 28
"""Bytes of the disk that uploads leave to others."""
_HEARD_OUT_S = 5.0
_SILENT_S = 60.0
"""A browser that sends nothing for so long is taken for gone."""
_PART = re.compile(r"[0-9a-f]{32}\.part")
_MOVED = (
    "the folder of the project is not where it was: it was moved, renamed or deleted, or its disk is gone; the work is"
    " still in memory: put the folder back, then send the file again"
)


class UploadError(LadarregError):
    """A file that is not taken, with the HTTP status that says so."""

    def __init__(self, text: str, *, status: int) -> None:
        super().__init__(text)
        self.status = status


class Uploads:
    """Serves `POST /upload`.

    Args:
        workbench: takes the files.
        visitors: know which page a browser has open.
    """

    def __init__(self, workbench: Workbench, visitors: Visitors) -> None:
        self._workbench, self._visitors = workbench, visitors
        self._under_way: Counter[str] = Counter()
        # Of a program that was killed: the project is open in this one alone, and this one has taken nothing yet.
        for part in workbench.upload_room().glob("*.part"):
            if _PART.fullmatch(part.name):
                part.unlink(missing_ok=True)

    async def serve(self, request: Request) -> Response:
        """Take a file."""
        browser = request.state.browser
        try:
            with self._place(browser):
                return await self._take(request, browser)
        except ClientDisconnect:
            log.debug("an upload was abandoned")
            return Response(status_code=400)
        except UploadError as error:
            return _Refusal({"ok": False, "error": str(error)}, status_code=error.status)
        except LadarregError as error:
            return _Refusal({"ok": False, "error": str(error)}, status_code=400)
        except OSError as error:
            log.warning("an upload failed: %s", error)
            refusal = await run_in_threadpool(_refusal, error, self._workbench.upload_room())
            return _Refusal({"ok": False, "error": str(refusal)}, status_code=refusal.status)

    async def _take(self, request: Request, browser: str) -> Response:
        what, photo = request.query_params.get("what", ""), request.query_params.get("photo") or None
        if what not in KINDS:
            raise OptionError(f"a file can be sent as {', '.join(KINDS)}; say which by ?what=")
        name = upload_name(request.headers.get("x-file-name"))
        room, most = self._workbench.upload_room(), self._workbench.limits.upload_bytes
        await run_in_threadpool(room.mkdir, exist_ok=True)  # its parent is the project's folder, which must be there
        _check_size(_declared_size(request), most, room)
        part = room / f"{secrets.token_hex(16)}.part"
        path = part.with_suffix(safe_suffix(name))
        try:
            await _stream(request, part, most)
            await run_in_threadpool(part.replace, path)
        except BaseException:
            _remove(part, path)
            raise
        try:
            page = self._visitors.newest(browser)
            taken = await run_in_threadpool(self._workbench.take_upload, path, name, what, photo, page)
        except Exception as error:  # the workbench has removed the file, unless it is in the project
            if not isinstance(error, LadarregError):
                raise
            # Readers name a file by where it lies, which is nobody's business.
            raise UploadError(str(error).replace(str(path), name).replace(path.name, name), status=400) from None
        return JSONResponse({"ok": True, "id": taken})

    @contextmanager
    def _place(self, browser: str) -> Iterator[None]:
        if self._under_way[browser] >= _AT_A_TIME:
            text = f"{_AT_A_TIME} files of this browser are on their way; send the next one when one has arrived"
            raise UploadError(text, status=429)
        self._under_way[browser] += 1
        try:
            yield
        finally:
            self._under_way[browser] -= 1
            self._under_way += Counter()  # forgets those at zero


class _Refusal(JSONResponse):
    """An answer to somebody who is still sending: heard out for a while, or the answer would be lost with the rest."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        await send({"type": "http.response.body", "body": self.body, "more_body": True})
        until = time.monotonic() + _HEARD_OUT_S
        more = True
        while more and (left := until - time.monotonic()) > 0:
            try:
                message = await asyncio.wait_for(receive(), left)
            except TimeoutError:
                break
            more = message["type"] == "http.request" and message.get("more_body", False)
        await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _stream(request: Request, part: Path, most: int) -> None:
    """Write a request's body to a file."""
    file = await run_in_threadpool(part.open, "xb")
    try:
        await _copy(request, file, part.parent, most)
    finally:
        file.close()  # at once: this may be the end of everything, and an open file cannot be removed everywhere


async def _copy(request: Request, file: BinaryIO, room: Path, most: int) -> None:
    received, block = 0, bytearray()
    chunks = request.stream()
    while (chunk := await _next(chunks)) is not None:
        received += len(chunk)
        block += chunk
        _check_size(received, most, None)
        if len(block) >= _BLOCK:
            await run_in_threadpool(file.write, bytes(block))
            _check_size(0, most, room)
            block.clear()
    await run_in_threadpool(file.write, bytes(block))
    if not received:
        raise OptionError("the file is empty; choose another")


async def _next(chunks: AsyncGenerator[bytes, None]) -> bytes | None:
    """Return the next piece of a body, None at its end."""
    try:
        async with asyncio.timeout(_SILENT_S):
            return await anext(chunks, None)
    except TimeoutError:
        raise UploadError(f"nothing came for {_SILENT_S:g} s; send the file again", status=408) from None


def _remove(*paths: Path) -> None:
    for path in paths:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _refusal(error: OSError, room: Path) -> UploadError:
    """Return what to say where the disk refused a file."""
    if not room.is_dir():
        return UploadError(_MOVED, status=409)
    if error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None)):
        return UploadError("the disk of the workbench is full; make room there", status=507)
    reason = (error.strerror or type(error).__name__).lower()
    return UploadError(
        f"the file cannot be kept: {reason}; see to the project's folder, then send it again", status=507
    )


def _declared_size(request: Request) -> int:
    text = request.headers.get("content-length", "")
    return int(text) if text.isascii() and text.isdigit() else 0


def _check_size(size: int, most: int, room: Path | None) -> None:
    if size > most:
        raise UploadError(f"the file is larger than {most / 2**20:.3g} MB, the most that is taken here", status=413)
    if room is not None and shutil.disk_usage(room).free < size + _LEFT_FREE:
        raise UploadError("the disk of the workbench is nearly full; make room there", status=507)


_LONGEST = 255
_SUFFIX = re.compile(r"\.[a-z0-9]{1,8}")


def upload_name(header: str | None) -> str:
    """Return the name that a file is shown by.

    Args:
        header: X-File-Name, percent-encoded UTF-8.

    Raises:
        OptionError: if it is missing, too long, or no name of a file.
    """
    name = unicodedata.normalize("NFC", unquote(header or "", errors="replace"))
    # Invisible signs that join or turn letters: some scripts' names need them, on a page they only mislead.
    name = "".join(letter for letter in name if unicodedata.category(letter) != "Cf").strip()
    if not name:
        raise OptionError("the file has no name; the header X-File-Name is needed")
    if len(name) > _LONGEST:
        raise OptionError(f"the file's name has {len(name)} characters; shorten it to {_LONGEST}")
    if set(name) & set("/\\") or name.strip(".") == "":
        raise OptionError("the file's name is a path; send the name alone")
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
        raise OptionError("the file's name holds control characters; rename it")
    return name


def safe_suffix(name: str) -> str:
    """Return a name's suffix, lower case, or nothing if it is no ordinary one."""
    suffix = "." + name.rpartition(".")[2].lower() if "." in name else ""
    return suffix if _SUFFIX.fullmatch(suffix) else ""
