"""A TCP proxy that behaves like a slow link: bandwidth and latency in both directions, shared by all connections.

All connections share one bottleneck each way, packet by packet in turn, as a router with fair queueing does. A new
connection costs a round trip before its first byte. Slow start and loss of packets are not modelled.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

_PACKET = 1448
_QUEUE_BYTES = 48_000
"""What one connection may have waiting at the bottleneck; about twice what fits into the link."""
_SAMPLES_S = 0.1
_METHODS = (b"GET ", b"HEAD ", b"POST ")


@dataclass
class _Stream:
    """One direction of a connection, waiting at its bottleneck."""

    writer: asyncio.StreamWriter
    packets: deque[tuple[bytes, float, str]] = field(default_factory=deque)
    waiting: int = 0
    room: asyncio.Event = field(default_factory=asyncio.Event)


class _Bottleneck:
    """One direction of the link; `delivered` is told of each packet that arrives: its size and its request."""

    def __init__(self, bytes_per_s: float, delay_s: float, delivered: Callable[[int, str], None]) -> None:
        self._bytes_per_s, self._delay_s, self._delivered = bytes_per_s, delay_s, delivered
        self._queue: deque[_Stream] = deque()
        self._some = asyncio.Event()

    async def put(self, stream: _Stream, data: bytes, *, request: str, not_before: float) -> None:
        """Queue data, or the end of the stream if there is none; returns when the connection may send more.

        Args:
            stream: the direction of the connection.
            data: what to send.
            request: that the data belong to.
            not_before: when the connection is established, in the loop's time.
        """
        for start in range(0, max(len(data), 1), _PACKET):
            stream.packets.append((data[start : start + _PACKET], not_before, request))
        stream.waiting += len(data)
        if stream not in self._queue:
            self._queue.append(stream)
        self._some.set()
        while stream.waiting > _QUEUE_BYTES:
            stream.room.clear()
            await stream.room.wait()

    async def run(self) -> None:
        """Pass on one packet of each connection in turn, for ever."""
        loop = asyncio.get_running_loop()
        free_at = loop.time()
        while True:
            while not self._queue:
                self._some.clear()
                await self._some.wait()
            stream = self._queue.popleft()
            packet, not_before, request = stream.packets[0]
            now = loop.time()
            if now < not_before:
                self._queue.append(stream)
                await asyncio.sleep(0.002)
                continue
            stream.packets.popleft()
            if stream.packets:
                self._queue.append(stream)
            free_at = max(free_at, now - 0.01) + max(len(packet), 1) / self._bytes_per_s
            if free_at > now + 0.002:
                await asyncio.sleep(free_at - now)
            stream.waiting -= len(packet)
            stream.room.set()
            loop.call_at(free_at + self._delay_s, self._deliver, stream.writer, packet, request)

    def _deliver(self, writer: asyncio.StreamWriter, packet: bytes, request: str) -> None:
        if writer.is_closing():
            return
        if packet:
            writer.write(packet)
            self._delivered(len(packet), request)
        else:
            with suppress(OSError):  # the other side is gone already
                writer.write_eof()


class ThrottlingProxy:
    """Forwards a port of this machine over a slow link, and counts what each request downloads.

    Args:
        port: of the server behind it.
        bytes_per_s: bandwidth each way.
        one_way_s: latency each way.
    """

    def __init__(self, port: int, *, bytes_per_s: float, one_way_s: float) -> None:
        self._target, self._bytes_per_s, self._one_way_s = port, bytes_per_s, one_way_s
        self.port = 0
        self.downloaded: dict[str, int] = {}
        """Bytes by request, headers included: `/path?query`, or `websocket /path`."""
        self.arrived: dict[str, tuple[float, float]] = {}
        """When the first and the last byte of each request arrived, as `time.time()`."""
        self.requests = 0
        self.uploaded = 0
        self._busy: deque[tuple[float, int]] = deque()
        self._ready = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()

    def __enter__(self) -> ThrottlingProxy:
        threading.Thread(target=self._run, daemon=True).start()
        self._ready.wait(10)
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._stop(), self._loop).result(10)
        self._loop.call_soon_threadsafe(self._loop.stop)

    def quiet(self, seconds: float, most_bytes: int) -> bool:
        """Return whether no more than some bytes were downloaded within the last seconds."""
        since = time.time() - seconds
        return sum(count for when, count in list(self._busy) if when > since) <= most_bytes

    def last_busy(self, most_bytes: int) -> float:
        """Return when the last bytes were downloaded but for a few, as `time.time()`."""
        rest = 0
        for when, count in reversed(list(self._busy)):
            rest += count
            if rest > most_bytes:
                return when
        return time.time()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._start())
        self._ready.set()
        self._loop.run_forever()

    async def _start(self) -> None:
        self._up = _Bottleneck(self._bytes_per_s, self._one_way_s, self._note_upload)
        self._down = _Bottleneck(self._bytes_per_s, self._one_way_s, self._note_download)
        for link in (self._up, self._down):
            self._tasks.add(self._loop.create_task(link.run()))
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0, limit=_QUEUE_BYTES)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _stop(self) -> None:
        self._server.close()
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        for task in rest:
            task.cancel()
        await asyncio.gather(*rest, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        established = self._loop.time() + 2 * self._one_way_s
        to_server, to_browser = await asyncio.open_connection("127.0.0.1", self._target, limit=_QUEUE_BYTES)
        current = ["nothing"]
        up, down = _Stream(to_browser), _Stream(writer)
        with suppress(asyncio.CancelledError):  # at the end of the proxy
            await asyncio.gather(
                self._pump(reader, up, self._up, current, established),
                self._pump(to_server, down, self._down, current, 0),
            )

    async def _pump(
        self, reader: asyncio.StreamReader, stream: _Stream, link: _Bottleneck, current: list[str], not_before: float
    ) -> None:
        try:
            while data := await reader.read(16_384):
                if link is self._up:
                    self._note_request(data, current)
                await link.put(stream, data, request=current[0], not_before=not_before)
        except OSError:
            pass  # closed abruptly; the other side is told that it ends
        await link.put(stream, b"", request=current[0], not_before=not_before)

    def _note_request(self, data: bytes, current: list[str]) -> None:
        if current[0].startswith("websocket") or not data.startswith(_METHODS):
            return
        head = data.partition(b"\r\n\r\n")[0].decode("latin-1")
        path = head.split(" ", 2)[1]
        self.requests += 1
        current[0] = f"websocket {path}" if "\r\nupgrade: websocket" in head.lower() else path

    def _note_upload(self, count: int, request: str) -> None:
        self.uploaded += count

    def _note_download(self, count: int, request: str) -> None:
        self.downloaded[request] = self.downloaded.get(request, 0) + count
        now = time.time()
        self.arrived[request] = self.arrived.get(request, (now, now))[0], now
        if self._busy and now - self._busy[-1][0] < _SAMPLES_S:
            self._busy[-1] = (self._busy[-1][0], self._busy[-1][1] + count)
        else:
            self._busy.append((now, count))
