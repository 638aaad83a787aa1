"""Attacks on a server, in a process of their own.

`python -m benchmarks.abuse.attacks PORT COOKIE SECONDS NAME [WORDS]` prints one JSON object at the end:
what was tried, and what the server did about it.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any
from urllib.parse import quote

from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

HOST = "127.0.0.1"
_AT_ONCE = 50
_VISER = Subprotocol("viser-v1.1.1")


async def idle(port: int, cookie: str, seconds: float, count: str) -> dict[str, Any]:
    """Open connections and say nothing."""
    return await _held(port, seconds, int(count), b"", b"")


async def slow(port: int, cookie: str, seconds: float, count: str) -> dict[str, Any]:
    """Open connections and send a header that never ends, a byte each half second."""
    return await _held(port, seconds, int(count), f"GET / HTTP/1.1\r\nHost: {HOST}:{port}\r\nX-Slow: ".encode(), b"a")


async def viser(port: int, cookie: str, seconds: float, count: str) -> dict[str, Any]:
    """Open viser's websocket, with the cookie, again and again, and take in slowly what it sends."""
    until = time.monotonic() + seconds
    found: Counter[str] = Counter()
    at_once = asyncio.Semaphore(_AT_ONCE)

    async def one() -> None:
        headers = {"Cookie": cookie, "Origin": f"http://{HOST}:{port}"}
        try:
            async with at_once:
                socket = await connect(
                    f"ws://{HOST}:{port}/viser", additional_headers=headers, subprotocols=[_VISER], max_size=None,
                    compression=None, proxy=None, open_timeout=max(1.0, until - time.monotonic()),
                )  # fmt: skip
        except (OSError, TimeoutError, WebSocketException):
            found["refused"] += 1
            return
        found["opened"] += 1
        try:
            while time.monotonic() < until:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(socket.recv(), 1.0)
                await asyncio.sleep(0.2)
        except WebSocketException:
            found["closed"] += 1
        finally:
            await socket.close()

    await asyncio.gather(*(one() for _ in range(int(count))))
    return dict(found)


async def tokens(port: int, cookie: str, seconds: float, count: str) -> dict[str, Any]:
    """Show wrong tokens, as a picture on any web page does."""
    found: Counter[str] = Counter()

    def one() -> None:
        connection = http.client.HTTPConnection(HOST, port, timeout=10)
        try:
            connection.request(
                "GET", "/?token=wrong", headers={"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}
            )
            found[str(connection.getresponse().status)] += 1
        except OSError:
            found["failed"] += 1
        finally:
            connection.close()

    until = time.monotonic() + seconds
    for _ in range(int(count)):
        if time.monotonic() < until:
            await asyncio.to_thread(one)
    await asyncio.sleep(max(0.0, until - time.monotonic()))
    return dict(found)


async def upload(port: int, cookie: str, seconds: float, what: str, photo: str, *files: str) -> dict[str, Any]:
    """Upload files one after the other."""
    answers = []
    for file in files:
        began = time.monotonic()
        answer = await asyncio.to_thread(_uploaded, port, cookie, what, photo, Path(file))
        answers.append(f"{Path(file).name}: {answer} ({time.monotonic() - began:.1f} s)")
    return {"answers": answers}


def _uploaded(port: int, cookie: str, what: str, photo: str, file: Path) -> str:
    connection = http.client.HTTPConnection(HOST, port, timeout=150)
    headers = {"Cookie": cookie, "Origin": f"http://{HOST}:{port}", "X-File-Name": quote(file.name)}
    try:
        connection.request("POST", f"/upload?what={what}&photo={photo}", file.read_bytes(), headers)
        answer = connection.getresponse()
        said = json.loads(answer.read())
        return "taken" if said.get("ok") else f"refused ({said.get('error')})"
    except (OSError, http.client.HTTPException, ValueError) as error:
        return f"no answer ({type(error).__name__})"
    finally:
        connection.close()


async def _held(port: int, seconds: float, count: int, begin: bytes, go_on: bytes) -> dict[str, Any]:
    """Hold connections until the server closes them, or the time is over."""
    until = time.monotonic() + seconds
    found: Counter[str] = Counter()
    at_once = asyncio.Semaphore(_AT_ONCE)

    async def one() -> None:
        try:
            async with at_once:
                reader, writer = await asyncio.wait_for(asyncio.open_connection(HOST, port), max(1.0, seconds))
        except (OSError, TimeoutError):
            found["refused"] += 1
            return
        found["opened"] += 1
        try:
            writer.write(begin)
            while (left := until - time.monotonic()) > 0:
                try:
                    if not await asyncio.wait_for(reader.read(1000), min(0.5, left)):
                        raise ConnectionResetError
                except TimeoutError:
                    writer.write(go_on)
        except OSError:
            found["closed"] += 1
        finally:
            writer.close()

    await asyncio.gather(*(one() for _ in range(count)))
    return dict(found)


ATTACKS: dict[str, Callable[..., Coroutine[Any, Any, dict[str, Any]]]] = {
    attack.__name__: attack for attack in (idle, slow, viser, tokens, upload)
}


def main(port: str, cookie: str, seconds: str, name: str, *words: str) -> None:
    if sys.platform != "win32":
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 8192) if most > 0 else 8192, most))
    print(json.dumps(asyncio.run(ATTACKS[name](int(port), cookie, float(seconds), *words))))


if __name__ == "__main__":
    main(*sys.argv[1:])
