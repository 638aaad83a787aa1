"""Folders published by a web server that answers requests for parts of a file, as Potree and others need."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path


@contextlib.contextmanager
def published(folders: Mapping[str, Path]) -> Iterator[str]:
    """Serve folders on a free loopback port, each below its path, while the block runs; gives the address."""
    import uvicorn
    from starlette.applications import Starlette
    from starlette.routing import Mount
    from starlette.staticfiles import StaticFiles

    routes = [Mount(path, StaticFiles(directory=folder, html=True)) for path, folder in folders.items()]
    server = uvicorn.Server(uvicorn.Config(Starlette(routes=routes), log_level="error", lifespan="off"))
    with socket.create_server(("127.0.0.1", 0)) as bound:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{bound.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()
