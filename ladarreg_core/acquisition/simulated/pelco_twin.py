"""The simulated head that speaks Pelco-D: another controller on the axes of the simulated pan/tilt unit.

Written from the protocol's manual alone, without the driver's parser, so that an error is not made twice.
"""

from __future__ import annotations

import math

from ladarreg_core.acquisition.simulated.flir_twin import FlirTwin
from ladarreg_core.acquisition.simulated.twin import Outbox

_THINKS_S = 0.01
_FULL_TURN = 36_000  # positions; hundredths of a degree


class PelcoTwin:
    """The simulated head.

    Failures on request: `silent` answers nothing, `rubbish` garbles what it answers; axes that get stuck or slip are
    those of the unit.

    Args:
        unit: whose axes it drives.
        address: that it listens to.
        baud: bits a second of its port.
        responds: whether it answers commands by its alarms, as some models do.
    """

    name = "pelco-d"

    def __init__(self, unit: FlirTwin, *, address: int = 1, baud: int = 9600, responds: bool = True) -> None:
        self.baud, self.address, self.responds = baud, address, responds
        self.silent = self.rubbish = False
        self._unit = unit
        self._outbox = Outbox(baud)
        self._received = bytearray()

    def feed(self, data: bytes, now_s: float) -> None:
        """Receive bytes from the host."""
        self._received += data
        while len(self._received) >= 7:
            message = bytes(self._received[:7])
            if message[0] != 0xFF or (sum(message[1:6]) - message[6]) % 256:
                del self._received[0]
                continue
            del self._received[:7]
            if message[1] == self.address:
                self._obey(message, now_s)

    def due(self, now_s: float) -> bytes:
        """Return the bytes that it has sent by now."""
        return self._outbox.due(now_s)

    def _obey(self, message: bytes, now_s: float) -> None:
        _, address, first, second, high, low, check = message
        position = 256 * high + low
        if second in (0x51, 0x53):
            angle = math.degrees(self._unit.angles_at([now_s])[0][0 if second == 0x51 else 1])
            value = round(-100 * angle) % _FULL_TURN  # it counts to the right and downward
            answer = [address, 0, second + 8, value >> 8, value & 0xFF]
            self._send([0xFF, *answer, sum(answer) % 256], now_s)
            return
        if second == 0x4B and position < _FULL_TURN:
            self._unit.go_to("P", math.radians(_above_or_left(position)), now_s)
        elif second == 0x4D and position < _FULL_TURN:
            self._unit.go_to("T", math.radians(_above_or_left(position)), now_s)
        elif not (first | second):
            self._unit.stop(now_s)
        if self.responds:
            self._send([0xFF, address, 0, check], now_s)

    def _send(self, message: list[int], now_s: float) -> None:
        if self.silent:
            return
        if self.rubbish:
            message = [byte ^ 0x55 for byte in message]
        self._outbox.send(bytes(message), now_s + _THINKS_S)


def _above_or_left(position: int) -> float:
    degrees = position / 100
    return 360 - degrees if degrees > 180 else -degrees
