"""Ports, the guard that holds them, and the link: over a real pseudo-terminal."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ladarreg_core.acquisition.link import Link
from ladarreg_core.acquisition.ports import Ports
from ladarreg_core.acquisition.serial_port import PortLostError
from ladarreg_core.acquisition.twin_address import check_twin
from ladarreg_core.errors import Cancelled, DeviceError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
STOP = b"\rH "
CHECKOUT = Path(__file__).resolve().parents[3]


class Terminal:
    """A device at the far end of a pseudo-terminal, which answers by a function."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        import pty
        import tty

        self._answer = answer
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.address = os.ttyname(self._slave)
        self.received = b""
        self.heard = threading.Condition()
        self._running = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while self._running:
            if not select.select([self._master], [], [], 0.02)[0]:
                continue
            try:
                data = os.read(self._master, 4096)
            except OSError:
                return
            with self.heard:
                self.received += data
                self.heard.notify_all()
            reply = self._answer(data)
            if reply:
                os.write(self._master, reply)

    def say(self, data: bytes) -> None:
        os.write(self._master, data)

    def unplug(self) -> None:
        self._running = False
        self._thread.join(1)
        for end in (self._master, self._slave):
            os.close(end)

    def await_bytes(self, wanted: bytes, seconds: float) -> bool:
        with self.heard:
            return self.heard.wait_for(lambda: wanted in self.received, seconds)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    found = Terminal(lambda data: b"* 17\r\n" if data.strip() == b"PP" else b"")
    yield found
    if found._running:
        found.unplug()


def ended(data: bytes) -> int:
    return data.find(b"\n") + 1


@pytest.mark.parametrize("guarded", [True, False])
def test_an_exchange_drops_what_was_stale_and_keeps_what_follows(terminal: Terminal, guarded: bool) -> None:
    with Ports(guarded=guarded) as ports:
        port = ports.open(terminal.address, 9600, stop=STOP, name="unit")
        link = Link(port, device="the unit")
        terminal.say(b"!P\r\n")
        time.sleep(0.2)
        assert link.exchange(b"PP ", complete=ended, deadline_s=2) == b"* 17\r\n"
        assert [each.reply for each in link.exchanges] == [b"!P\r\n", b"* 17\r\n"]
        terminal.say(b"one\ntwo\n")
        assert link.receive(complete=ended, deadline_s=2) == b"one\n"
        assert link.receive(complete=ended, deadline_s=2) == b"two\n"
        with pytest.raises(DeviceError, match=r'no complete answer within 0.2 s .*sent "TT "'):
            link.exchange(b"TT ", complete=ended, deadline_s=0.2)
    assert terminal.await_bytes(STOP, 1)


def test_a_halt_does_not_wait_for_the_exchange_that_is_going_on(terminal: Terminal) -> None:
    with Ports(guarded=False) as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        waiting = threading.Thread(target=lambda: link.exchange(b"A ", complete=ended, deadline_s=10))
        waiting.start()
        assert terminal.await_bytes(b"A ", 2)
        link.urgent(b"H ")
        assert terminal.await_bytes(b"H ", 1)
        assert waiting.is_alive()
        terminal.say(b"*\r\n")
        waiting.join()


def test_an_exchange_is_cancelled_at_once(terminal: Terminal) -> None:
    def cancel() -> None:
        raise Cancelled

    with Ports(guarded=False) as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        with pytest.raises(Cancelled):
            link.exchange(b"A ", complete=ended, deadline_s=60, check=cancel)


@pytest.mark.parametrize("guarded", [True, False])
def test_an_unplugged_device_is_said_to_be_so(terminal: Terminal, guarded: bool) -> None:
    with Ports(guarded=guarded) as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        assert link.exchange(b"PP ", complete=ended, deadline_s=2)
        terminal.unplug()
        with pytest.raises(PortLostError, match="disappeared"):
            link.exchange(b"PP ", complete=ended, deadline_s=5)


@pytest.mark.parametrize("guarded", [True, False])
def test_absent_and_busy_ports_are_refused(terminal: Terminal, guarded: bool) -> None:
    with Ports(guarded=guarded) as ports, Ports(guarded=guarded) as others:
        with pytest.raises(DeviceError, match=r"there is no port /dev/tty-absent; .*check the cable"):
            ports.open("/dev/tty-absent", 9600, stop=STOP, name="unit")
        ports.open(terminal.address, 9600, stop=STOP, name="unit")
        with pytest.raises(DeviceError, match="in use by another program"):
            others.open(terminal.address, 9600, stop=STOP, name="unit")
        with pytest.raises(DeviceError, match="already used by another device"):
            ports.open(terminal.address, 9600, stop=STOP, name="scanner")
        with pytest.raises(DeviceError, match=r"socket://127\.0\.0\.1:1 cannot be opened"):
            ports.open("socket://127.0.0.1:1", 9600, stop=STOP, name="unit")


PROGRAM = """
    import sys, time
    from ladarreg_core.acquisition.ports import Ports
    ports = Ports()
    port = ports.open(sys.argv[1], 9600, stop=b"\\rH ", name="unit")
    port.write(b"PP1000 ")
    print("ready", ports._guard._process.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("end", ["SIGKILL", "SIGSTOP", "SIGINT", "SIGTERM"])
def test_the_device_stops_within_a_second_of_the_programs_end(terminal: Terminal, end: str) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(PROGRAM), terminal.address],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=CHECKOUT, start_new_session=True,
    )  # fmt: skip
    try:
        assert program.stdout is not None
        guard = int(program.stdout.readline().split()[1])
        assert terminal.await_bytes(b"PP1000 ", 5)
        assert STOP not in terminal.received
        program.send_signal(getattr(signal, end))
        assert terminal.await_bytes(STOP, 1.5)
    finally:
        program.kill()
        program.wait(10)
    until = time.monotonic() + 5
    while Path(f"/proc/{guard}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{guard}").exists(), "the guard has ended"


def test_a_guard_that_is_killed_is_noticed(terminal: Terminal) -> None:
    with Ports() as ports:
        port = ports.open(terminal.address, 9600, stop=STOP, name="unit")
        assert ports._guard is not None
        ports._guard._process.kill()
        with pytest.raises(PortLostError, match="process that holds the ports has ended"):
            port.read(5)


def test_addresses_of_simulated_devices_are_checked() -> None:
    assert check_twin("twin:scip2?seed=3&scene=office") == ("scip2", (("scene", "office"), ("seed", "3")))
    for address, said in (("twin:", "names no device"), ("twin:a?sed=1", "'sed'"), ("twin:a?seed=-1", "whole number")):
        with pytest.raises(DeviceError, match=said):
            check_twin(address)
