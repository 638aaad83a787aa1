"""How a shot of a scanner or camera with software of its own is triggered, once the unit has come to rest."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from ladarreg_core.acquisition.clock import Clock
from ladarreg_core.acquisition.interfaces import Arrival, Check
from ladarreg_core.acquisition.run_records import in_degrees
from ladarreg_core.acquisition.serial_port import ControlLine
from ladarreg_core.errors import DeviceError, OptionError
from ladarreg_core.foundations.validation import is_number
from ladarreg_core.storage.atomic_write import replaced_file, write_bytes

LineName = Literal["rts", "dtr"]
_NAP_S = 0.05
_USUAL_PULSE_S = 0.1
_SHOWN = 200
KEYS = ("command", "file", "port", "line", "pulse_s")


@dataclass(frozen=True, slots=True)
class TriggerPlan:
    """What a plan says of a trigger: one of a command, a file and a line of a serial port."""

    command: tuple[str, ...] = ()
    """Program and arguments, run without a shell; `{stop}`, `{pan_deg}` and `{tilt_deg}` stand for the stop's."""
    file: str = ""
    """Name of a file that is written into the watched folder when the unit has arrived, and removed after the shot."""
    port: str = ""
    """Serial port, one of whose control lines is pulsed."""
    line: LineName = "rts"
    pulse_s: float = _USUAL_PULSE_S

    @staticmethod
    def from_fields(fields: object) -> TriggerPlan:
        """Return the trigger that a plan states.

        Raises:
            OptionError: if it states none.
        """
        if not isinstance(fields, Mapping):
            raise OptionError("it must be an object with 'command', 'file' or 'port'")
        unknown = [str(key) for key in fields if key not in KEYS]
        if unknown:
            raise OptionError(f"it has an unknown key {unknown[0][:40]!r}; use {', '.join(KEYS)}")
        if sum(key in fields for key in ("command", "file", "port")) != 1:
            raise OptionError("it needs one of 'command', 'file' and 'port'")
        command, name, port = fields.get("command"), fields.get("file"), fields.get("port")
        if command is not None and not (isinstance(command, list) and command and all(map(_is_text, command))):
            raise OptionError("'command' must be a list of texts: the program and its arguments")
        if name is not None and not (_is_text(name) and Path(name).name == name and not set(name) & set('/\\:*?"<>|')):
            raise OptionError("'file' must be the name of a file in the watched folder, without a folder")
        if port is not None and not _is_text(port):
            raise OptionError("'port' must be a serial port such as /dev/ttyUSB1 or COM5")
        line, pulse = fields.get("line", "rts"), fields.get("pulse_s", _USUAL_PULSE_S)
        if line not in ("rts", "dtr"):
            raise OptionError("'line' must be 'rts' or 'dtr'")
        if not is_number(pulse) or not 1e-4 <= pulse <= 10:
            raise OptionError("'pulse_s' must be a number from 0.0001 to 10")
        return TriggerPlan(tuple(command or ()), name or "", port or "", line, float(pulse))

    def as_fields(self) -> dict[str, Any]:
        """Return the trigger as a plan states it."""
        if self.command:
            return {"command": list(self.command)}
        return {"file": self.file} if self.file else {"port": self.port, "line": self.line, "pulse_s": self.pulse_s}

    def __str__(self) -> str:
        """Return it in words, for a plan's description."""
        if self.command:
            return f"the command {' '.join(self.command)}"
        return f"the file {self.file}" if self.file else f"the line {self.line.upper()} of {self.port}"


class Trigger(Protocol):
    """Starts a shot."""

    def fire(self, stop: Arrival, *, check: Check) -> None:
        """Start the shot of a stop.

        Raises:
            DeviceError: if that fails.
            Cancelled: if `check` raises it.
        """

    def taken(self) -> None:
        """The shot has been taken."""

    def close(self) -> None:
        """Release its resources."""


def opened_trigger(plan: TriggerPlan, folder: Path, *, timeout_s: float, device: str, clock: Clock) -> Trigger:
    """Return the trigger of a plan, ready.

    Args:
        plan: what the plan says.
        folder: the watched folder.
        timeout_s: longest time that a command may take.
        device: whose shots it starts, for messages.
        clock: what waiting is measured by.

    Raises:
        DeviceError: if its port cannot be opened.
    """
    if plan.command:
        return _CommandTrigger(plan.command, timeout_s=timeout_s, device=device, clock=clock)
    if plan.file:
        return _FileTrigger(folder / plan.file, device)
    return _LineTrigger(plan, clock)


class _CommandTrigger:
    def __init__(self, command: tuple[str, ...], *, timeout_s: float, device: str, clock: Clock) -> None:
        self._command, self._timeout_s, self._device, self._clock = command, timeout_s, device, clock

    def fire(self, stop: Arrival, *, check: Check) -> None:
        pan, tilt = in_degrees(stop.at)
        words = {"{stop}": str(stop.index), "{pan_deg}": f"{pan:.4f}", "{tilt_deg}": f"{tilt:.4f}"}
        arguments = list(self._command)
        for word, value in words.items():
            arguments = [argument.replace(word, value) for argument in arguments]
        with tempfile.TemporaryFile() as said:  # a pipe that nobody reads would hold the program up
            try:
                process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
            except (OSError, ValueError) as error:
                raise DeviceError(
                    f"the command {arguments[0][:80]!r} that triggers {self._device} cannot be started "
                    f"({getattr(error, 'strerror', None) or error}); correct it in the plan"
                ) from None
            until = self._clock.now() + self._timeout_s
            try:
                while process.poll() is None:
                    check()
                    if self._clock.now() > until:
                        raise DeviceError(
                            f"the command that triggers {self._device} has not ended within {self._timeout_s:.0f} s; "
                            "check why, and resume"
                        )
                    self._clock.sleep(_NAP_S)
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()
            if process.returncode:
                said.seek(0)
                last = " ".join(said.read().decode(errors="replace").split())[-_SHOWN:]
                raise DeviceError(
                    f"the command that triggers {self._device} ended with {process.returncode}"
                    f"{': ' + last if last else ''}; correct what it complains of, and resume"
                )

    def taken(self) -> None:
        pass

    def close(self) -> None:
        pass


class _FileTrigger:
    def __init__(self, path: Path, device: str) -> None:
        self._path = path
        if path.exists() and not _is_left_over(path):
            raise DeviceError(
                f"the file {path.name} that is to trigger {device} is there already, and was not written by a run; "
                "give another name in the plan"
            )

    def fire(self, stop: Arrival, *, check: Check) -> None:
        pan, tilt = in_degrees(stop.at)
        with replaced_file(self._path) as new:
            write_bytes(new, json.dumps({"stop": stop.index, "pan_deg": pan, "tilt_deg": tilt}).encode() + b"\n")

    def taken(self) -> None:
        with suppress(OSError):  # whoever waits for it may remove it, too
            self._path.unlink()

    def close(self) -> None:
        self.taken()


class _LineTrigger:
    def __init__(self, plan: TriggerPlan, clock: Clock) -> None:
        self._line, self._pulse_s = ControlLine(plan.port, plan.line, clock=clock), plan.pulse_s

    def fire(self, stop: Arrival, *, check: Check) -> None:
        self._line.pulse(self._pulse_s)

    def taken(self) -> None:
        pass

    def close(self) -> None:
        self._line.close()


def _is_left_over(path: Path) -> bool:
    """Return whether a file is the trigger of a run that was killed."""
    try:
        return path.read_bytes()[:8] == b'{"stop":'
    except OSError:
        return False


def _is_text(value: object) -> bool:
    return isinstance(value, str) and bool(value) and "\0" not in value
