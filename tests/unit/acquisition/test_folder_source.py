"""Watched folders: which file belongs to which stop, however and whenever it is written."""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import pytest

from ladarreg_core.acquisition.devices.folder_source import FolderSource
from ladarreg_core.acquisition.interfaces import Arrival, PanTilt
from ladarreg_core.acquisition.trigger import TriggerPlan
from ladarreg_core.errors import Cancelled, DeviceError, FormatError, OptionError
from testing.devices.simulated_clock import SimulatedClock

AT = Arrival(3, PanTilt(0.5, -0.25))
WHOLE = b"begin of a measurement" * 20 + b"end"


def readable(path: Path) -> None:
    if not path.read_bytes().endswith(b"end"):
        raise FormatError("it does not end")


def goes_on() -> None:
    pass


class Room:
    """A watched folder on a simulated clock.

    Args:
        folder: an empty folder.
        trigger: of the source.
        timeout_s: of the source.
    """

    def __init__(self, folder: Path, trigger: TriggerPlan | None = None, *, timeout_s: float = 20) -> None:
        self.clock, self.watched, self.kept = SimulatedClock(), folder / "watched", folder / "kept"
        self.watched.mkdir()
        self.kept.mkdir()
        self._trigger, self._timeout_s = trigger, timeout_s
        self.source = self.connect()

    def connect(self) -> FolderSource:
        self.source = FolderSource(
            self.watched, is_readable=readable, timeout_s=self._timeout_s, device="the scanner",
            trigger=self._trigger, clock=self.clock,
        )  # fmt: skip
        return self.source

    def write(self, name: str, content: bytes = WHOLE) -> None:
        (self.watched / name).write_bytes(content)

    def append(self, name: str, content: bytes) -> None:
        with (self.watched / name).open("ab") as stream:
            stream.write(content)

    def later(self, seconds: float, name: str, content: bytes = WHOLE) -> None:
        self.clock.after(seconds, lambda: self.write(name, content))

    def next(self) -> Path:
        return self.source.next_file(self.kept, check=goes_on)


@pytest.fixture
def room(tmp_path: Path) -> Room:
    return Room(tmp_path)


def test_a_file_that_was_there_on_arrival_is_stray(room: Room) -> None:
    room.write("early.ptx")
    room.source.arrived(AT)
    room.later(5, "right.ptx", b"right" + WHOLE)
    assert room.next().read_bytes() == b"right" + WHOLE
    assert [path.name for path in room.source.keep_strays(room.kept / "stray")] == ["early.ptx"]
    assert (room.kept / "stray" / "early.ptx").read_bytes() == WHOLE
    assert room.source.keep_strays(room.kept / "stray") == [], "each is named once"


def test_a_file_that_still_grows_on_arrival_is_stray(room: Room) -> None:
    room.write("early.ptx", WHOLE[:100])
    room.source.arrived(AT)
    room.clock.after(0.5, lambda: room.append("early.ptx", WHOLE[100:]))
    room.later(5, "right.ptx")
    assert room.next().name == "right.ptx"


@pytest.mark.skipif(sys.platform == "win32", reason="a file that is open cannot be renamed there")
def test_a_file_that_gets_its_name_after_the_arrival_is_stray(room: Room) -> None:
    room.write("early.ptx.part", WHOLE[:100])
    room.source.arrived(AT)

    def finish() -> None:
        room.append("early.ptx.part", WHOLE[100:])
        os.replace(room.watched / "early.ptx.part", room.watched / "early.ptx")

    room.clock.after(0.5, finish)
    room.later(5, "right.ptx")
    assert room.next().name == "right.ptx"


def test_no_clock_is_compared(room: Room) -> None:
    """A scanner whose clock is a year behind, and a stray file from the future."""
    room.write("early.ptx")
    os.utime(room.watched / "early.ptx", (4e9, 4e9))
    room.source.arrived(AT)

    def write() -> None:
        room.write("right.ptx")
        os.utime(room.watched / "right.ptx", (1e9, 1e9))

    room.clock.after(1, write)
    assert room.next().name == "right.ptx"


def test_the_second_file_of_a_stop_is_stray_at_the_next(room: Room) -> None:
    for number in range(3):
        room.source.arrived(AT)
        room.later(1, f"shot_{number}.ptx", b"%d" % number + WHOLE)
        assert room.next().read_bytes() == b"%d" % number + WHOLE
        room.write(f"again_{number}.ptx")
    room.source.arrived(AT)
    strays = [path.name for path in room.source.keep_strays(room.kept / "stray")]
    assert strays == [f"again_{number}.ptx" for number in range(3)]


def test_a_file_that_is_written_anew_under_its_name_counts_for_its_stop(room: Room) -> None:
    for number in range(4):
        room.source.arrived(AT)
        room.later(1, "latest.ptx", b"%d" % number + WHOLE)
        assert room.next().read_bytes() == b"%d" % number + WHOLE
    room.source.arrived(AT)
    room.clock.after(1, lambda: room.append("latest.ptx", b"a preview, and an end"))
    with pytest.raises(DeviceError, match=r"latest\.ptx was there before the unit arrived"):
        room.next()


def test_a_name_of_a_removed_file_may_come_again(room: Room) -> None:
    """The system gives the inode of a removed file to the next one."""
    for number in range(4):
        room.source.arrived(AT)
        if number:
            room.clock.after(0.5, lambda n=number: (room.watched / f"shot_{n - 1}.ptx").unlink())
        room.later(0.5, f"shot_{number}.ptx", b"%d" % number + WHOLE)
        assert room.next().read_bytes() == b"%d" % number + WHOLE


def test_an_unreadable_file_is_said_and_a_late_one_is_waited_for(room: Room) -> None:
    room.source.arrived(AT)
    room.later(1, "broken.ptx", b"aborted")
    with pytest.raises(DeviceError, match=r"wrote broken\.ptx, which cannot be read \(it does not end\)"):
        room.next()
    with pytest.raises(DeviceError, match="no complete file"):
        room.next()
    with pytest.raises(Cancelled):
        room.source.next_file(room.kept, check=cancel)


def cancel() -> None:
    raise Cancelled


def test_a_command_triggers_each_shot(tmp_path: Path) -> None:
    code = "import sys,pathlib; pathlib.Path(sys.argv[1]).write_bytes(sys.argv[2].encode() + b' end')"
    target = str(tmp_path / "watched" / "shot_{stop}.ptx")
    room = Room(tmp_path, TriggerPlan(command=(sys.executable, "-c", code, target, "{pan_deg} {tilt_deg}")))
    room.source.arrived(AT)
    room.write("settling.ptx")  # after the arrival, but before the trigger
    let_programs_run(room)
    copy = room.next()
    assert copy.read_bytes() == b"28.6479 -14.3239 end"
    assert [path.name for path in room.source.keep_strays(room.kept)] == ["settling.ptx"]


def let_programs_run(room: Room) -> None:
    """Give programs some real time at each tick of the simulated clock."""
    room.clock.every_tick(lambda: threading.Event().wait(0.001))


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ([sys.executable, "-c", "raise SystemExit('no battery')"], "ended with 1: no battery"),
        (["/absent/shoot"], "cannot be started"),
        ([sys.executable, "-c", "import time; time.sleep(600)"], "has not ended within 2 s"),
    ],
)
def test_a_command_that_fails_is_said(tmp_path: Path, command: list[str], said: str) -> None:
    room = Room(tmp_path, TriggerPlan.from_fields({"command": command}), timeout_s=2)
    room.source.arrived(AT)
    let_programs_run(room)
    with pytest.raises(DeviceError, match=said):
        room.next()


def test_a_file_announces_the_arrival(tmp_path: Path) -> None:
    room = Room(tmp_path, TriggerPlan(file="arrived.json"))
    announced: list[dict[str, float]] = []

    def shoot() -> None:
        announced.append(json.loads((room.watched / "arrived.json").read_text()))
        room.write("shot.ptx")

    room.clock.when((room.watched / "arrived.json").exists, shoot)
    room.source.arrived(AT)
    assert room.next().name == "shot.ptx"
    assert announced[0] == {
        "stop": 3,
        "pan_deg": pytest.approx(28.6479, abs=1e-3),
        "tilt_deg": pytest.approx(-14.3239, abs=1e-3),
    }
    assert not (room.watched / "arrived.json").exists()
    room.write("arrived.json", b"somebody's notes")
    with pytest.raises(DeviceError, match=r"arrived\.json .* is there already"):
        room.connect()


def test_a_line_of_a_serial_port_is_pulsed(tmp_path: Path) -> None:
    room = Room(tmp_path, TriggerPlan(port="loop://", line="rts", pulse_s=0.2))
    line = room.source._trigger._line._serial  # type: ignore[union-attr]
    levels: list[tuple[float, bool]] = []
    room.clock.every_tick(lambda: levels.append((room.clock.now(), line.cts)))
    room.clock.when(lambda: line.cts, lambda: room.write("shot.ptx"))
    room.source.arrived(AT)
    assert room.next().name == "shot.ptx"
    high = [at for at, level in levels if level]
    assert high[-1] - high[0] == pytest.approx(0.2, abs=0.02)
    room.source.close()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("shoot.sh", "must be an object"),
        ({}, "needs one of"),
        ({"command": ["a"], "file": "b"}, "needs one of"),
        ({"command": "shoot.sh"}, "must be a list"),
        ({"file": "../arrived"}, "without a folder"),
        ({"port": "/dev/ttyUSB1", "line": "cts"}, "'rts' or 'dtr'"),
        ({"port": "/dev/ttyUSB1", "pulse_s": 60}, "0.0001 to 10"),
        ({"port": "/dev/ttyUSB1", "puls_s": 1}, "unknown key"),
    ],
)
def test_a_trigger_that_is_none_is_refused(fields: object, said: str) -> None:
    with pytest.raises(OptionError, match=said):
        TriggerPlan.from_fields(fields)


def test_triggers_of_plans_are_kept() -> None:
    for fields in ({"command": ["a", "{stop}"]}, {"file": "b.json"}, {"port": "COM5", "line": "dtr", "pulse_s": 0.5}):
        assert TriggerPlan.from_fields(fields).as_fields() == fields


LINKS = pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")


@LINKS
def test_links_are_not_followed(room: Room, tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"secret" + WHOLE)
    (room.watched / "before.ptx").symlink_to(tmp_path / "secret")
    room.source.arrived(AT)
    (room.watched / "a.ptx").symlink_to(tmp_path / "secret")
    (room.watched / "folder").symlink_to(tmp_path)
    room.later(3, "real.ptx", b"real" + WHOLE)
    assert room.next().read_bytes() == b"real" + WHOLE
    room.source.arrived(AT)
    assert room.source.keep_strays(room.kept / "stray") == []
    with pytest.raises(DeviceError, match=r"a\.ptx, before\.ptx, folder are symbolic links, not followed"):
        room.next()
    assert [path.name for path in room.kept.iterdir()] == ["real.ptx"]


@LINKS
@pytest.mark.parametrize("when", ["read", "stray"])
def test_a_file_that_is_exchanged_for_a_link_is_not_copied(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    (tmp_path / "secret").write_bytes(b"secret" + WHOLE)

    def exchange(path: Path) -> None:
        path.unlink()
        path.symlink_to(tmp_path / "secret")

    if when == "read":
        monkeypatch.setattr(room.source, "_is_readable", exchange)
        room.source.arrived(AT)
        room.later(1, "a.ptx")
        with pytest.raises(DeviceError):
            room.next()
    else:
        room.write("a.ptx")
        room.source.arrived(AT)
        exchange(room.watched / "a.ptx")
        assert room.source.keep_strays(room.kept) == []
    assert not any(path.is_file() for path in room.kept.rglob("*"))
