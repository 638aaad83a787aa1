"""A head that speaks Pelco-D, and a reader of what it sends, written from the protocol's manual alone.

Nothing here is taken from `ladarreg_core`: what the driver, its twin and this module have in common is the document.

Source: Pelco, 'Pelco D Protocol Manual', standard TF-0002, version 2 revision 1 (15 August 2003): the message format,
the standard commands, opcodes 0x4B to 0x5B, the general and the extended response.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

TURN = 36_000
"""Hundredths of a degree in a turn; positions are 0 to 35999."""
ANSWERED_BY = {0x51: 0x59, 0x53: 0x5B}
"""The opcode of the response to a query, by that of the query."""


def message(address: int, first: int, second: int, word: int) -> bytes:
    """Return a message: the two commands and the data as one word, most significant byte first."""
    payload = struct.pack(">BBBH", address, first, second, word)
    return b"\xff" + payload + bytes([sum(payload) % 256])


@dataclass
class PeerHead:
    """The receiver of the manual: bytes in, bytes out. It is there at once; time is not part of the protocol."""

    address: int = 1
    pan: int = 0
    tilt: int = 0
    alarms: int = 0
    responds: bool = True
    """Whether it sends the general response, as a receiver with the advanced feature set does."""
    halts: int = 0
    _held: bytes = b""

    def answer(self, data: bytes) -> bytes:
        """Return the responses to all messages that are complete."""
        self._held += data
        out = b""
        while len(self._held) >= 7:
            if self._held[0] != 0xFF:
                self._held = self._held[1:]
                continue
            address, first, second, word, check = struct.unpack(">BBBHB", self._held[1:7])
            if sum(self._held[1:6]) % 256 != check:
                self._held = self._held[1:]
                continue
            self._held = self._held[7:]
            if address == self.address:
                out += self._execute(first, second, word, check)
        return out

    def _execute(self, first: int, second: int, word: int, check: int) -> bytes:
        if second in ANSWERED_BY:
            where = self.pan if second == 0x51 else self.tilt
            return message(self.address, 0, ANSWERED_BY[second], where)
        if second == 0x4B and word < TURN:
            self.pan = word
        elif second == 0x4D and word < TURN:
            self.tilt = word
        elif second % 2 == 0 and not first and not second & 0x1E:  # a standard command with no direction: both stop
            self.halts += 1
        if not self.responds:
            return b""
        return bytes([0xFF, self.address, self.alarms, (check + self.alarms) % 256])


def tilt_above_horizon(position: int) -> float:
    """Return degrees above the horizon: 0 is level, 90 degrees straight down, 330 degrees 30 above."""
    degrees = position / 100
    return -degrees if degrees <= 180 else 360 - degrees


def positions_in(received: bytes, address: int) -> list[tuple[int, int]]:
    """Return the opcode and the value of all extended responses of a head in a stream of bytes."""
    found = []
    at = 0
    while at + 7 <= len(received):
        sync, sender, unused, opcode, value, check = struct.unpack_from(">BBBBHB", received, at)
        good = (sync, sender, unused) == (0xFF, address, 0) and opcode in ANSWERED_BY.values()
        if good and (sender + opcode + value // 256 + value % 256) % 256 == check:
            found.append((opcode, value))
            at += 7
        else:
            at += 1
    return found
