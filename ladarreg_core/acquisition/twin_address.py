"""Addresses of simulated devices: `twin:NAME?seed=N&scene=...&base=...`.

A process of its own (`python -m ladarreg_core.acquisition.simulated`) simulates all devices of equal arguments in one
room. It prints a JSON object that maps their names to addresses, and ends when its standard input does: with this
program.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import IO
from urllib.parse import parse_qsl

from ladarreg_core.acquisition.mount_fields import base_of_text
from ladarreg_core.errors import DeviceError, OptionError

PREFIX = "twin:"
_ARGUMENTS = {
    "seed": "a whole number",
    "scene": "the name of a scene",
    "base": "how the unit stands: upright, hanging, or roll,pitch,yaw in degrees",
}

_START_S = 60.0
"""Longest start of a simulation; on a machine that is busy a few seconds."""
_KEPT_LINES = 20
_LOOK_S = 0.5

_running: dict[tuple[tuple[str, str], ...], tuple[subprocess.Popen[str], dict[str, str]]] = {}
_starting = threading.Lock()


def is_twin(address: str) -> bool:
    """Return whether an address is that of a simulated device."""
    return address.startswith(PREFIX)


def check_twin(address: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return name and sorted arguments of the address of a simulated device.

    Raises:
        DeviceError: if it has no name, or an unknown argument.
    """
    name, _, query = address.removeprefix(PREFIX).partition("?")
    arguments = dict(parse_qsl(query, keep_blank_values=True))
    for key, value in arguments.items():
        if key not in _ARGUMENTS:
            raise DeviceError(f"the address {address!r} has an argument {key!r}; use {' or '.join(_ARGUMENTS)}")
        if key == "seed" and not value.isdigit():
            raise DeviceError(f"the address {address!r} has the seed {value!r}; it must be {_ARGUMENTS[key]}")
        if key == "base":
            try:
                base_of_text(value)
            except OptionError:
                raise DeviceError(
                    f"the address {address!r} has the base {value!r}; it says {_ARGUMENTS[key]}"
                ) from None
    if not name:
        raise DeviceError(f"the address {address!r} names no device; write for example {PREFIX}flir-ptu?seed=1")
    return name, tuple(sorted(arguments.items()))


def resolved_twin(address: str) -> str:
    """Return the address at which a simulated device is served, starting its process if it is not running.

    Raises:
        DeviceError: if there is no such device, or the simulation does not start.
    """
    name, arguments = check_twin(address)
    with _starting:
        process, served = _running.get(arguments, (None, {}))
        if process is None or process.poll() is not None:
            process, served = _running[arguments] = _started(arguments)
    if name not in served:
        raise DeviceError(f"there is no simulated device {name!r}; use one of {', '.join(sorted(served))}")
    return served[name]


def _started(arguments: tuple[tuple[str, str], ...]) -> tuple[subprocess.Popen[str], dict[str, str]]:
    # Like a real device it does not hear the signals that a terminal sends to all processes of this program.
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "ladarreg_core.acquisition.simulated", json.dumps(dict(arguments))],
        start_new_session=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=_environment(),
    )  # fmt: skip
    said: deque[str] = deque(maxlen=_KEPT_LINES)
    complaining = _read_aside(process.stderr, said.append)
    first: list[str] = []
    starting = _read_aside(process.stdout, first.append)
    until = time.monotonic() + _START_S
    while not first and starting.is_alive() and time.monotonic() < until:
        starting.join(_LOOK_S)
    try:
        return process, {str(name): str(where) for name, where in json.loads("".join(first[:1]))["devices"].items()}
    except (ValueError, KeyError, TypeError):
        late = starting.is_alive() and not first
        process.kill()
        complaining.join(_LOOK_S)
        why = " ".join("".join(said).split())[-200:] or "no reason was given"
        if late:
            why = f"they did not answer within {_START_S:.0f} s; try again when the machine is less busy"
        raise DeviceError(f"the simulated devices could not be started ({why})") from None


def _read_aside(stream: IO[str] | None, use: Callable[[str], None]) -> threading.Thread:
    """Read the lines of a stream on a thread until it ends, so that its other end never waits."""

    def read() -> None:
        assert stream is not None
        with contextlib.suppress(OSError, ValueError):
            for line in stream:
                use(line)

    thread = threading.Thread(target=read, daemon=True, name="simulated devices")
    thread.start()
    return thread


def _environment() -> dict[str, str]:
    """Return the environment of a process that imports the package from where this one does."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}


def watched_folder(folder: str) -> str:
    """Return the folder to be watched: as given, or that of a simulated device, which is switched on then.

    Raises:
        DeviceError: if there is no such device, or the simulation does not start.
    """
    if not is_twin(folder):
        return folder
    found = resolved_twin(folder)
    if not os.path.isdir(found):
        name, _ = check_twin(folder)
        raise DeviceError(f"the simulated device {name!r} has a port and writes no files; use scanner or camera")
    _switch_on(folder)
    return found


def packet_source(host: str, port: int) -> tuple[str, int]:
    """Return whose packets are to be listened for, and on which UDP port: as given, or those of a simulated device,
    which is switched on then.

    Raises:
        DeviceError: if there is no such device, or the simulation does not start.
    """
    if not is_twin(host):
        return host, port
    found, _, its_port = resolved_twin(host).rpartition(":")
    if not its_port.isdigit():
        name, _ = check_twin(host)
        raise DeviceError(f"the simulated device {name!r} sends no packets; use velodyne")
    _switch_on(host)
    return found, int(its_port)


def _switch_on(address: str) -> None:
    name, arguments = check_twin(address)
    process, _ = _running[arguments]
    assert process.stdin is not None
    process.stdin.write(json.dumps({"switch_on": name}) + "\n")
    process.stdin.flush()
