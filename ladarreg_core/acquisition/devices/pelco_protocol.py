"""The Pelco-D protocol of pan/tilt heads: commands to bytes, bytes to positions; no I/O.

A message has seven bytes: 0xFF, the address, two commands, two of data, and the sum of the five before it modulo 256.
An absolute position is set by the opcodes 0x4B (pan) and 0x4D (tilt) and asked for by 0x51 and 0x53, which are answered
by 0x59 and 0x5B in the same form; positions are hundredths of a degree, 0 to 35999. A command that asks for nothing is
answered by four bytes with the alarms, or by nothing, and a movement says nothing when it ends. Without a direction bit
a standard command stops both axes.

A tilt of 0 is level, 90 deg straight down and 330 deg 30 above the horizon. Which way pan grows the document does not
say; here to the right, as azimuths do.

Source: Pelco D Protocol Manual, standard TF-0002, version 2 revision 1.
"""

from __future__ import annotations

from typing import Literal

from ladarreg_core.errors import DeviceGlitchError, OptionError

Axis = Literal["pan", "tilt"]
MAX_ADDRESS = 255
STEPS_PER_DEG = 100
_SYNC, _LENGTH = 0xFF, 7
_TURN = 360 * STEPS_PER_DEG
_SET = {"pan": 0x4B, "tilt": 0x4D}
_QUERY = {"pan": 0x51, "tilt": 0x53}
_RESPONSE = {"pan": 0x59, "tilt": 0x5B}
_UPSIDE_DOWN = range(_TURN // 4 + 1, 3 * _TURN // 4)


class PelcoError(DeviceGlitchError):
    """An answer that the protocol does not have."""


def stop(address: int) -> bytes:
    """Return the command that stops both axes.

    Raises:
        OptionError: if the address is none.
    """
    return _message(address, 0, 0)


def set_position(axis: Axis, address: int, steps: int) -> bytes:
    """Return the command that moves an axis.

    Args:
        axis: of the two.
        address: of the head.
        steps: hundredths of a degree, positive to the left or upward; any whole number of turns off.
    """
    return _message(address, _SET[axis], -steps % _TURN)


def query_position(axis: Axis, address: int) -> bytes:
    """Return the query for the position of an axis."""
    return _message(address, _QUERY[axis], 0)


def response_end(received: bytes, axis: Axis, address: int) -> int:
    """Return where the response to a query ends in the bytes received, 0 if it is not complete.

    What a late answer to an earlier command, or an adapter that repeats what it is sent, puts before it is passed over.
    """
    for start in range(len(received) - _LENGTH + 1):
        if _is_response(received[start : start + _LENGTH], axis, address):
            return start + _LENGTH
    return 0


def parse_position(received: bytes, axis: Axis, address: int) -> int:
    """Return the position in the response to a query.

    Args:
        received: bytes from the head, whatever they are.
        axis: that was asked for.
        address: of the head.

    Returns:
        Hundredths of a degree, -18000 to 17999, positive to the left or upward.

    Raises:
        PelcoError: if there is no response, or it states what no axis can be at.
    """
    end = response_end(received, axis, address)
    if not end:
        raise PelcoError(
            f"the pan/tilt unit sent {received[:24].hex(' ') or 'nothing'} in answer to the query for its {axis}; "
            "check the baud rate, its address and the cable"
        )
    steps = int.from_bytes(received[end - 3 : end - 1], "big")
    if steps >= _TURN or (axis == "tilt" and steps in _UPSIDE_DOWN):
        raise PelcoError(
            f"the pan/tilt unit states a {axis} of {steps / STEPS_PER_DEG:.2f} deg, which it cannot have; check that "
            "its positions are those of Pelco-D, and that it does not flip over"
        )
    return (-steps + _TURN // 2) % _TURN - _TURN // 2


def steps_apart(a: int, b: int) -> int:
    """Return the distance of two positions, the shorter way round."""
    return abs((a - b + _TURN // 2) % _TURN - _TURN // 2)


def _message(address: int, opcode: int, data: int) -> bytes:
    if not 0 <= address <= MAX_ADDRESS:
        raise OptionError(f"a head has an address from 0 to {MAX_ADDRESS}, and not {address}; correct it")
    payload = bytes((address, 0, opcode)) + data.to_bytes(2, "big")
    return bytes((_SYNC, *payload, sum(payload) & 0xFF))


def _is_response(data: bytes, axis: Axis, address: int) -> bool:
    return data[:4] == bytes((_SYNC, address, 0, _RESPONSE[axis])) and sum(data[1:-1]) & 0xFF == data[-1]
