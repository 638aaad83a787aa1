"""The guard: a process that holds the ports, and stops the devices when the program that drives them is gone.

`python -m ladarreg_core.acquisition.guard` reads frames on its standard input and writes frames on its standard output:
a byte for the channel, four bytes for the length, big-endian, and the content. Channel 0 carries JSON: from the
program `{"open": channel, "address", "baud", "stop"}`, `{"close": channel}` and `{"beat": n}`; from the guard
`{"opened": channel}`, `{"refused": channel, "text"}` and `{"lost": channel, "text"}`. The other channels carry the
bytes of the ports.

When its input ends, or no beat has come for a while, the guard sends each port its stop bytes, closes it, and ends.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import threading
import time
from typing import Any, BinaryIO

from ladarreg_core.acquisition.serial_port import PortLostError, SerialPort
from ladarreg_core.errors import DeviceError

CONTROL = 0
"""Channel of the messages."""
LONGEST_SILENCE_S = 0.7
"""Without a beat for so long the program is taken for dead."""
_HEADER = struct.Struct(">BI")
_LONGEST_FRAME = 1 << 20
_WATCH_S = 0.05
_READ_S = 0.05
_DRAIN_S = 0.05


def write_frame(stream: BinaryIO, channel: int, content: bytes) -> None:
    """Write a frame."""
    stream.write(_HEADER.pack(channel, len(content)) + content)
    stream.flush()


def read_frame(stream: BinaryIO) -> tuple[int, bytes] | None:
    """Return channel and content of the next frame; None at the end of the stream."""
    head = stream.read(_HEADER.size)
    if len(head) < _HEADER.size:
        return None
    channel, length = _HEADER.unpack(head)
    if length > _LONGEST_FRAME:
        return None
    content = stream.read(length)
    return (channel, content) if len(content) == length else None


class Guard:
    """Holds ports for a program.

    Args:
        requests: frames from the program.
        replies: frames to it.
    """

    def __init__(self, requests: BinaryIO, replies: BinaryIO) -> None:
        self._requests, self._replies = requests, replies
        self._replying = threading.Lock()
        self._ports: dict[int, tuple[SerialPort, bytes]] = {}
        self._beaten = time.monotonic()
        self._ending = threading.Lock()

    def run(self) -> None:
        """Serve until the program is gone; then stop the devices."""
        threading.Thread(target=self._watch, daemon=True).start()
        try:
            while frame := read_frame(self._requests):
                self._beaten = time.monotonic()
                channel, content = frame
                if channel == CONTROL:
                    self._obey(json.loads(content))
                elif channel in self._ports:
                    self._send(channel, content)
        finally:
            self.stop()

    def stop(self) -> None:
        """Send every port its stop bytes and close it."""
        with self._ending:
            ports, self._ports = list(self._ports.values()), {}
            for port, stop in ports:
                try:
                    port.write(stop)
                except DeviceError:
                    continue
            if ports:
                time.sleep(_DRAIN_S)
            for port, _ in ports:
                port.close()

    def _watch(self) -> None:
        while time.monotonic() - self._beaten < LONGEST_SILENCE_S:
            time.sleep(_WATCH_S)
        self.stop()
        os._exit(1)  # the main thread may hang in a read or a write

    def _obey(self, message: dict[str, Any]) -> None:
        if "open" in message:
            self._open(int(message["open"]), message)
        elif "close" in message:
            port, stop = self._ports.pop(int(message["close"]), (None, b""))
            if port is not None:
                _stop_and_close(port, stop)

    def _open(self, channel: int, message: dict[str, Any]) -> None:
        try:
            port = SerialPort(str(message["address"]), int(message["baud"]))
        except DeviceError as error:
            self._tell({"refused": channel, "text": str(error)})
            return
        self._ports[channel] = port, bytes.fromhex(message["stop"])
        self._tell({"opened": channel})
        threading.Thread(target=self._listen, args=(channel, port), daemon=True).start()

    def _listen(self, channel: int, port: SerialPort) -> None:
        while self._ports.get(channel, (None,))[0] is port:
            try:
                data = port.read(_READ_S)
            except PortLostError as error:
                self._lose(channel, port, error)
                return
            if data:
                self._reply(channel, data)

    def _send(self, channel: int, data: bytes) -> None:
        port, _ = self._ports[channel]
        try:
            port.write(data)
        except PortLostError as error:
            self._lose(channel, port, error)

    def _lose(self, channel: int, port: SerialPort, error: DeviceError) -> None:
        if self._ports.get(channel, (None,))[0] is port:
            del self._ports[channel]
            port.close()
            self._tell({"lost": channel, "text": str(error)})

    def _tell(self, message: dict[str, Any]) -> None:
        self._reply(CONTROL, json.dumps(message).encode())

    def _reply(self, channel: int, content: bytes) -> None:
        try:
            with self._replying:
                write_frame(self._replies, channel, content)
        except (OSError, ValueError):  # the program is gone, which the end of its input tells
            pass


def _stop_and_close(port: SerialPort, stop: bytes) -> None:
    try:
        port.write(stop)
        time.sleep(_DRAIN_S)
    except DeviceError:
        pass
    port.close()


def main() -> None:
    """Guard the ports of the program at the other end of the standard streams."""
    guard = Guard(sys.stdin.buffer, sys.stdout.buffer)

    def end(number: int, frame: object) -> None:
        guard.stop()
        os._exit(0)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches the program, which stops the devices
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), end)
    guard.run()
    os._exit(0)


if __name__ == "__main__":
    main()
