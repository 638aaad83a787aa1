"""The simulated line scanner: a Hokuyo scanner that speaks SCIP 2, with its real timing and failures.

Written from the specification alone, without the driver's parser, so that an error is not made twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.simulated.twin import Outbox

Measure = Callable[[NDArray[np.float64], NDArray[np.float64], int], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Given the angle (N,), rad, and the time (N,), s, of each ray, and the number of the line within its request: ranges
(N,), m, NaN without a return, and intensities (N,)."""
ScipFailure = Literal[
    "silent", "rubbish", "wrong checksum", "lost line", "truncated", "doubled line", "wrong echo", "endless",
    "wrong status", "stamp checksum", "wrong stamp", "checks itself", "interrupted", "parameters",
]  # fmt: skip
"""What the twin does wrong on request; once, but for `silent` and `rubbish`.

`wrong echo`: a line for other steps; `endless`: a request acknowledged as one without end; `wrong status`: a line with
a damaged status; `stamp checksum`: with a damaged time stamp; `wrong stamp`: one off by `stamp_off_ms` under a right
checksum; `checks itself`: `fails_after_lines` requests answered by 25, the last by 98; `interrupted`: a request ended
early by status 21; `parameters`: another DMAX in one answer.
"""
_THINKS_S = 0.001
_SPIN_UP_S = 0.02
_MAX_CODED = {b"S": (1 << 12) - 1, b"D": (1 << 18) - 1, b"E": (1 << 18) - 1}
_UNKNOWN = b"0E"
_ENDLESS = 1000  # lines, of a request without a number


@dataclass(frozen=True, slots=True)
class ScipModel:
    """What a model of the scanner states of itself."""

    product: str
    least_mm: int
    most_mm: int
    steps_a_turn: int
    first: int
    last: int
    front: int
    turns_a_minute: int
    has_intensity: bool
    tells_time: bool = True

    @property
    def period_s(self) -> float:
        """Time of a turn."""
        return 60.0 / self.turns_a_minute


UTM_30LX = ScipModel("UTM-30LX", 23, 60_000, 1440, 0, 1080, 540, 2400, True)
URG_04LX = ScipModel("URG-04LX", 20, 5600, 1024, 44, 725, 384, 600, False)


class ScipTwin:
    """The simulated scanner.

    Args:
        measure: measures a line.
        model: what it is.
        baud: bits a second of its port.
        seed: seeds its clock.
    """

    name = "scip2"

    def __init__(self, measure: Measure, *, model: ScipModel = UTM_30LX, baud: int = 4_000_000, seed: int = 0) -> None:
        self.baud, self.model = baud, model
        self.laser_on = False
        self.laser_off_at_s: float | None = None
        self.failure: ScipFailure | None = None
        self.fails_after_lines = 0
        self.stamp_off_ms = 300
        self.asked_without_end = False
        """Whether lines were ever requested without a number."""
        self.late_s = 0.0
        self._measure = measure
        self._outbox = Outbox(baud)
        self._received = self._requested = b""
        self._rng = np.random.default_rng(seed)
        self._clock_start_ms = float(self._rng.integers(0, 1 << 24))
        self._drift = 1 + float(self._rng.uniform(-50e-6, 50e-6))
        self._adjusting = False
        self._spun_up_s = 0.0
        self._jobs: list[tuple[float, Callable[[float], None]]] = []

    def clock_ms(self, now_s: float) -> int:
        """Return its clock at a time."""
        return int(self._clock_start_ms + now_s * 1000 * self._drift) % (1 << 24)

    def feed(self, data: bytes, now_s: float) -> None:
        """Receive bytes from the host."""
        for byte in data:
            if byte in (10, 13):
                if self._received:
                    self._obey(self._received, now_s)
                self._received = b""
            else:
                self._received = (self._received + bytes([byte]))[-64:]

    def due(self, now_s: float) -> bytes:
        """Return the bytes that it has sent by now."""
        while self._jobs and self._jobs[0][0] <= now_s:
            at_s, job = self._jobs.pop(0)
            job(at_s)
        return self._outbox.due(now_s)

    def _obey(self, command: bytes, now_s: float) -> None:
        name = command[:2]
        at_s = now_s + _THINKS_S
        if name in (b"QT", b"RS"):
            self._switch_off(now_s)
            if name == b"RS":
                self._clock_start_ms, self._adjusting = -now_s * 1000 * self._drift, False
            self._answer(command, b"00", [], at_s)
        elif name == b"BM":
            status = b"02" if self.laser_on else b"00"
            self._switch_on(now_s)
            self._answer(command, status, [], at_s)
        elif name in (b"VV", b"PP", b"II"):
            fields = dict(self._fields(name, now_s))
            if name == b"PP" and self._fails("parameters"):
                fields["DMAX"] = str(self.model.most_mm - 1000)
            self._answer(command, b"00", [self._field(*field) for field in fields.items()], at_s)
        elif name == b"TM" and self.model.tells_time and command[2:3] in (b"0", b"1", b"2"):
            self._clock_command(command, at_s)
        elif name[:1] in (b"G", b"M") and name[1:] in _MAX_CODED and (self.model.has_intensity or name[1:] != b"E"):
            self._lines_command(command, at_s)
        else:
            self._answer(command, _UNKNOWN, [], at_s)

    def _clock_command(self, command: bytes, at_s: float) -> None:
        wanted = command[2:3]
        if wanted == b"1" and not self._adjusting:
            self._answer(command, b"04", [], at_s)
            return
        if wanted == b"1":
            stamp = self._number(self.clock_ms(at_s), 4)
            self._answer(command, b"00", [stamp + self._sum(stamp)], at_s)
            return
        begins = wanted == b"0"
        status = b"00" if self._adjusting != begins else (b"02" if begins else b"03")
        self._adjusting = begins
        self._answer(command, status, [], at_s)

    def _lines_command(self, command: bytes, at_s: float) -> None:
        single = command[:1] == b"G"
        body = command[2:12] if single else command[2:15]
        if not body.isdigit() or len(command) < (12 if single else 15):
            self._answer(command, b"01", [], at_s)
            return
        first, last = int(body[0:4]), int(body[4:8])
        if last > self.model.last or first > last:
            self._answer(command, b"04" if last > self.model.last else b"05", [], at_s)
            return
        if self.failure == "checks itself":
            status = b"25" if self.fails_after_lines > 1 and not single else b"98"
            self.fails_after_lines -= 1
            if self.fails_after_lines <= 0:
                self.failure = None
            self._answer(command, status, [], at_s)
            return
        if single and not self.laser_on:
            self._answer(command, b"10", [], at_s)
            return
        if single:
            self._schedule(command, first, last, 0, self._next_turn(at_s))
            return
        count, skipped = int(body[11:13]), int(body[10:11])
        self.asked_without_end |= count == 0
        self._requested = command
        self._switch_on(at_s)
        self._answer(command[:13] + b"00" if self._fails("endless") else command, b"00", [], at_s)
        begun = self._next_turn(max(at_s, self._spun_up_s))
        for number in range(count or _ENDLESS):
            echo = command[:13] + f"{count - 1 - number:02d}".encode() + command[15:]
            self._schedule(echo, first, last, number, begun + number * (skipped + 1) * self.model.period_s)

    def _schedule(self, echo: bytes, first: int, last: int, number: int, turn_s: float) -> None:
        """Measure a line in the turn that begins at a time, and send it when it is complete."""
        model = self.model
        steps = np.arange(first, last + 1)
        angles = np.asarray((steps - model.front) * (2 * np.pi / model.steps_a_turn), np.float64)
        times = turn_s + steps / model.steps_a_turn * model.period_s

        def work(at_s: float) -> None:
            if not self.laser_on:
                return
            ranges, light = self._measure(angles, times, number)
            mm = np.rint(np.nan_to_num(ranges, nan=0.0) * 1000).astype(np.int64)
            mm = np.where((mm < model.least_mm) | (mm > model.most_mm), 1, mm)  # 1: no echo
            mm = np.minimum(mm, _MAX_CODED[echo[1:2]])
            values = [mm, np.clip(np.rint(light), 0, (1 << 18) - 1).astype(np.int64)] if echo[1:2] == b"E" else [mm]
            self._send_line(echo, np.stack(values, axis=-1).ravel(), turn_s, at_s)
            if echo[:1] == b"M" and echo[13:15] == b"00":
                self._switch_off(at_s)

        self._jobs.append((float(times[-1]), work))
        self._jobs.sort(key=lambda job: job[0])

    def _send_line(self, echo: bytes, values: NDArray[np.int64], begun_s: float, at_s: float) -> None:
        at_s += self.late_s
        if self._fails("lost line"):
            self.fails_after_lines -= 1
            return
        if self._fails("interrupted"):
            self._jobs.clear()
            self._answer(echo[:13] + self._requested[13:15], b"21", [], at_s)
            return
        shifts = np.array([6, 0] if echo[1:2] == b"S" else [12, 6, 0])
        coded = (((values[:, None] >> shifts) & 63) + 48).astype(np.uint8).tobytes()
        blocks = [coded[k : k + 64] for k in range(0, len(coded), 64)]
        off_ms = self.stamp_off_ms if self._fails("wrong stamp") else 0
        stamp = self._number((self.clock_ms(begun_s) + off_ms) % (1 << 24), 4)
        lines = [stamp + self._sum(stamp), *(block + self._sum(block) for block in blocks)]
        if self._fails("wrong checksum"):
            lines[len(lines) // 2] = self._spoilt(lines[len(lines) // 2])
        if self._fails("stamp checksum"):
            lines[0] = self._spoilt(lines[0])
        if self._fails("truncated"):
            lines = lines[: len(lines) // 2]
        if self._fails("wrong echo"):
            echo = echo[:5] + bytes([echo[5] ^ 1]) + echo[6:]
        status = b"00" if echo[:1] == b"G" else b"99"
        if self._fails("wrong status"):
            status = b"98"
        twice = self._fails("doubled line")
        self.fails_after_lines -= 1
        for _ in range(1 + twice):
            self._answer(echo, status, lines, at_s, sum_of=b"00" if status == b"98" else None)

    def _fails(self, failure: ScipFailure) -> bool:
        """Return whether this failure is due, which it then is no more."""
        due = self.failure == failure and self.fails_after_lines <= 0
        if due:
            self.failure = None
        return due

    @staticmethod
    def _spoilt(line: bytes) -> bytes:
        return line[:3] + bytes([line[3] ^ 1]) + line[4:]

    def _answer(
        self, echo: bytes, status: bytes, lines: list[bytes], at_s: float, *, sum_of: bytes | None = None
    ) -> None:
        if self.failure == "silent" and self.fails_after_lines <= 0:
            return
        data = b"".join(line + b"\n" for line in [echo, status + self._sum(sum_of or status), *lines]) + b"\n"
        if self.failure == "rubbish" and self.fails_after_lines <= 0:
            data = self._rng.integers(0, 256, len(data)).astype(np.uint8).tobytes()
        self._outbox.send(data, at_s)

    def _fields(self, name: bytes, now_s: float) -> list[tuple[str, str]]:
        m = self.model
        if name == b"VV":
            return [("VEND", "Hokuyo Automatic Co., Ltd."), ("PROD", f"SOKUIKI Sensor {m.product}"),
                    ("FIRM", "1.20.01(17/Nov./2015)"), ("PROT", "SCIP 2.0"), ("SERI", "H0000001")]  # fmt: skip
        if name == b"PP":
            return [("MODL", m.product), ("DMIN", str(m.least_mm)), ("DMAX", str(m.most_mm)),
                    ("ARES", str(m.steps_a_turn)), ("AMIN", str(m.first)), ("AMAX", str(m.last)),
                    ("AFRT", str(m.front)), ("SCAN", str(m.turns_a_minute))]  # fmt: skip
        laser, speed = ("ON" if self.laser_on else "OFF"), f"Initial({m.turns_a_minute}[rpm])"
        return [("MODL", m.product), ("LASR", laser), ("SCSP", speed), ("MESM", "IDLE"), ("SBPS", "USB only"),
                ("TIME", f"{self.clock_ms(now_s):06X}"), ("STAT", "Sensor works well.")]  # fmt: skip

    def _field(self, name: str, value: str) -> bytes:
        text = f"{name}:{value}".encode()
        return text + b";" + self._sum(text)

    def _next_turn(self, now_s: float) -> float:
        """Return when the next turn of the mirror begins."""
        return float(np.ceil(now_s / self.model.period_s) * self.model.period_s)

    def _switch_on(self, now_s: float) -> None:
        if not self.laser_on:
            self.laser_on, self._spun_up_s = True, now_s + _SPIN_UP_S

    def _switch_off(self, now_s: float) -> None:
        self.laser_on, self.laser_off_at_s = False, now_s
        self._jobs.clear()

    @staticmethod
    def _sum(data: bytes) -> bytes:
        total = 0
        for byte in data:
            total += byte
        return bytes([total % 64 + 48])

    @staticmethod
    def _number(value: int, characters: int) -> bytes:
        digits = []
        for _ in range(characters):
            digits.append(value % 64 + 48)
            value //= 64
        return bytes(reversed(digits))
