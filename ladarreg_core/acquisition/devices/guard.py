"""The guard: a process that holds the ports, and stops the devices when the program that drives them is gone.

`python -m ladarreg_core.acquisition.devices.guard` reads frames on its standard input and writes frames on its standard
output: four bytes for the channel, four for the length, big-endian, and the content. Channel 0 carries JSON: from the
program `{"open": channel, "address", "baud", "stop"}`, `{"close": channel}`, `{"beat": n}` and `{"end": true}`; from
the guard `{"opened": channel}`, `{"refused": channel, "text"}`, `{"lost": channel, "text"}` and `{"ended": text,
"hung": bool}`. The other channels carry the bytes of the ports.

When its input ends, or no frame has come for a while, the guard sends each port its stop bytes, closes it, and ends. A
port that hangs, while it is opened or written to, never holds up another one, nor the watch over the program.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, BinaryIO

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.serial_port import PortLostError, SerialPort
from ladarreg_core.errors import DeviceError

CONTROL = 0
"""Channel of the messages."""
LONGEST_SILENCE_S = 0.7
"""Without a frame for so long the program is taken for dead."""
_HEADER = struct.Struct(">II")
_LONGEST_FRAME = 1 << 20
_WATCH_S = 0.05
_LONGEST_TICK_S = 0.25  # what one tick of the watch counts at most: a pause of the whole machine is no silence
_READ_S = 0.05
_DRAIN_S = 0.05
_STOP_S = 1.0
_TELL_S = 0.1


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
        clock: what the program's silence is measured by.
    """

    def __init__(self, requests: BinaryIO, replies: BinaryIO, *, clock: Clock = REAL_CLOCK) -> None:
        self._requests, self._replies, self._clock = requests, replies, clock
        self._replying = threading.Lock()
        self._held: dict[int, _HeldPort] = {}
        self._waiting: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._ended = False
        self.frames = 0
        """Frames received so far: the program's signs of life."""
        self.told_to_end = False
        """Set by signals; the watch obeys it."""

    def run(self) -> None:
        """Serve until the program is gone; then stop the devices."""
        threading.Thread(target=self._watch, daemon=True).start()
        threading.Thread(target=self._obey, daemon=True).start()
        try:
            while frame := read_frame(self._requests):
                self.frames += 1
                channel, content = frame
                if channel == CONTROL:
                    message = json.loads(content)
                    if "end" in message:
                        break
                    if "beat" not in message:
                        self._waiting.put(message)
                elif held := self._held.get(channel):
                    held.send(content)
        finally:
            self.stop()

    def stop(self) -> None:
        """Send every port its stop bytes and close it."""
        self._ended = True
        stopping = [threading.Thread(target=held.stop, daemon=True) for held in list(self._held.values())]
        for thread in stopping:
            thread.start()
        until = time.monotonic() + _STOP_S
        for thread in stopping:
            thread.join(max(0.0, until - time.monotonic()))

    def await_silence(self) -> None:
        """Return when the program has sent no frame for a while, or a signal has told the guard to end."""
        silence, seen, last = 0.0, -1, self._clock.now()
        while silence < LONGEST_SILENCE_S and not self.told_to_end:
            self._clock.sleep(_WATCH_S)
            now, frames = self._clock.now(), self.frames
            silence = 0.0 if frames != seen else silence + min(now - last, _LONGEST_TICK_S)
            seen, last = frames, now

    def _watch(self) -> None:
        """End this process when the program falls silent, or a signal says so."""
        self.await_silence()
        self.stop()
        why = "it was told to end" if self.told_to_end else f"this program hung for more than {LONGEST_SILENCE_S:g} s"
        telling = threading.Thread(target=self._tell, args=({"ended": why, "hung": not self.told_to_end},), daemon=True)
        telling.start()
        telling.join(_TELL_S)  # the program may have stopped reading
        os._exit(1)  # the main thread waits for a frame

    def _obey(self) -> None:
        """Open and close ports, one after another, so that a port is free before it is opened again."""
        while True:
            message = self._waiting.get()
            if "open" in message:
                self._open(int(message["open"]), message)
            elif "close" in message and (held := self._held.get(int(message["close"]))):
                held.stop()
                del self._held[int(message["close"])]

    def _open(self, channel: int, message: dict[str, Any]) -> None:
        try:
            port = SerialPort(str(message["address"]), int(message["baud"]))
        except DeviceError as error:
            self._tell({"refused": channel, "text": str(error)})
            return
        held = self._held[channel] = _HeldPort(
            port,
            bytes.fromhex(message["stop"]),
            heard=lambda data: self._reply(channel, data),
            lost=lambda error: self._tell({"lost": channel, "text": str(error)}),
        )
        if self._ended:  # while it was opened; its device may be in the middle of something
            held.stop()
            return
        self._tell({"opened": channel})
        held.start()

    def _tell(self, message: dict[str, Any]) -> None:
        self._reply(CONTROL, json.dumps(message).encode())

    def _reply(self, channel: int, content: bytes) -> None:
        try:
            with self._replying:
                write_frame(self._replies, channel, content)
        except (OSError, ValueError):  # the program is gone, which the end of its input tells
            pass


class _HeldPort:
    """A port, with a thread that reads from it and one that writes to it."""

    def __init__(
        self, port: SerialPort, stop: bytes, *, heard: Callable[[bytes], None], lost: Callable[[DeviceError], None]
    ) -> None:
        self._port, self._stop, self._heard, self._lost = port, stop, heard, lost
        self._outgoing: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._stopping = threading.Lock()
        self._ended = False

    def start(self) -> None:
        """Begin to read and write."""
        for work in (self._read, self._write):
            threading.Thread(target=work, daemon=True).start()

    def send(self, data: bytes) -> None:
        """Send bytes after those of earlier calls."""
        self._outgoing.put(data)

    def stop(self) -> None:
        """Send the stop bytes, ahead of what still waits to be sent, and close the port; return when that is done."""
        with self._stopping:
            if self._ended:
                return
            self._ended = True
            try:
                self._port.write(self._stop)
                time.sleep(_DRAIN_S)
            except DeviceError:
                pass
            self._port.close()
            self._outgoing.put(b"")

    def _read(self) -> None:
        while not self._ended:
            try:
                data = self._port.read(_READ_S)
            except PortLostError as error:
                self._lose(error)
                return
            if data:
                self._heard(data)

    def _write(self) -> None:
        while not self._ended:
            data = self._outgoing.get()
            try:
                if data and not self._ended:
                    self._port.write(data)
            except PortLostError as error:
                self._lose(error)
                return

    def _lose(self, error: PortLostError) -> None:
        with self._stopping:
            if self._ended:
                return
            self._ended = True
            self._port.close()
            self._outgoing.put(b"")
        self._lost(error)


def main() -> None:
    """Guard the ports of the program at the other end of the standard streams."""
    guard = Guard(sys.stdin.buffer, sys.stdout.buffer)

    def end(number: int, frame: object) -> None:
        guard.told_to_end = True

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches the program, which stops the devices
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), end)
    guard.run()
    os._exit(0)


if __name__ == "__main__":
    main()
