"""Attacks on a server, in a process of their own.

`python -m benchmarks.abuse.attacks PORT COOKIE PATH SECONDS NAME [ARGUMENTS]` prints one JSON object at the end: the
attempts, and the reactions of the server.
"""

from __future__ import annotations

import asyncio
import http.client
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path
from typing import Any
from urllib.parse import quote

from testing.attacks.held_connections import HeldConnections
from testing.attacks.server_process import TOKEN
from testing.workbench.access import Access

HOST = "127.0.0.1"


async def hold(port: int, access: Access, seconds: float, kind: str, count: str) -> dict[str, Any]:
    """Hold connections of a kind of `HeldConnections`, and reopen what the server closes."""
    held = HeldConnections(kind, int(count), HOST, port, access)
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        held.fill()
        held.pass_time(min(1.0, max(0.0, until - time.monotonic())))
    return {"held": len(held.open), "opened": held.opened, "closed": held.closed, "failed": held.failed}


async def tokens(port: int, access: Access, seconds: float, count: str) -> dict[str, Any]:
    """Send wrong tokens, as an image on a foreign web page could."""
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


async def upload(port: int, access: Access, seconds: float, what: str, photo: str, *files: str) -> dict[str, Any]:
    """Upload files one after another."""
    answers = []
    for file in files:
        began = time.monotonic()
        answer = await asyncio.to_thread(_upload, port, access, what, photo, Path(file))
        answers.append(f"{Path(file).name}: {answer} ({time.monotonic() - began:.1f} s)")
    return {"answers": answers}


async def uploads(
    port: int, access: Access, seconds: float, count: str, what: str, photo: str, *files: str
) -> dict[str, Any]:
    """Upload files in turn, so many at once, each from a browser of its own, which has a limit of its own."""
    browsers = [_logged_in(port) for _ in range(int(count))]
    jobs = zip(browsers, cycle(files))
    with ThreadPoolExecutor(len(browsers)) as threads:
        answers = list(threads.map(lambda job: _upload(port, job[0], what, photo, Path(job[1])), jobs))
    return dict(Counter(answer.partition(" (")[0] for answer in answers))


def _logged_in(port: int) -> Access:
    connection = http.client.HTTPConnection(HOST, port, timeout=60)
    connection.request("GET", f"/?token={TOKEN}")
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return Access.granted({name.lower(): value for name, value in answer.getheaders()})


def _upload(port: int, access: Access, what: str, photo: str, file: Path) -> str:
    connection = http.client.HTTPConnection(HOST, port, timeout=150)
    headers = {"Cookie": access.cookie, "Origin": f"http://{HOST}:{port}", "X-File-Name": quote(file.name)}
    try:
        connection.request("POST", access.within(f"/upload?what={what}&photo={photo}"), file.read_bytes(), headers)
        answer = connection.getresponse()
        reply = json.loads(answer.read())
        if answer.status == 429:
            return "busy (429)"
        return "taken" if reply.get("ok") else f"refused ({reply.get('error')})"
    except (OSError, http.client.HTTPException, ValueError) as error:
        return f"no answer ({type(error).__name__})"
    finally:
        connection.close()


ATTACKS: dict[str, Callable[..., Coroutine[Any, Any, dict[str, Any]]]] = {
    attack.__name__: attack for attack in (hold, tokens, upload, uploads)
}


def main(port: str, cookie: str, path: str, seconds: str, name: str, *arguments: str) -> None:
    if sys.platform != "win32":
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 8192) if most > 0 else 8192, most))
    print(json.dumps(asyncio.run(ATTACKS[name](int(port), Access(cookie, path), float(seconds), *arguments))))


if __name__ == "__main__":
    main(*sys.argv[1:])
