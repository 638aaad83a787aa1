"""Ports, the guard that holds them, and the link: over a real pseudo-terminal."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ladarreg_core.acquisition import twin_address
from ladarreg_core.acquisition.devices.guard import LONGEST_SILENCE_S
from ladarreg_core.acquisition.devices.link import Link
from ladarreg_core.acquisition.devices.ports import GuardEndedError, Ports
from ladarreg_core.acquisition.serial_port import PortLostError, SerialPort, why_shut
from ladarreg_core.acquisition.twin_address import check_twin
from ladarreg_core.errors import Cancelled, DeviceError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
STOP = b"\rH "
LONGEST_S = 30.0  # it takes tenths of a second, which benchmarks measure; a machine that runs tests is busy
CHECKOUT = Path(__file__).resolve().parents[3]


class Terminal:
    """A device at the far end of a pseudo-terminal, which answers by a function.

    Its name leads nowhere once it is unplugged; that of the terminal itself would soon be another one's.
    """

    def __init__(self, path: Path, answer: Callable[[bytes], bytes]) -> None:
        import pty
        import tty

        self._answer = answer
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.address = str(path)
        path.symlink_to(os.ttyname(self._slave))
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
        Path(self.address).unlink()
        for end in (self._master, self._slave):
            os.close(end)

    def await_bytes(self, wanted: bytes, seconds: float) -> bool:
        with self.heard:
            return self.heard.wait_for(lambda: wanted in self.received, seconds)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    found = Terminal(tmp_path / "tty", lambda data: b"* 17\r\n" if data.strip() == b"PP" else b"")
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
        while not link._buffer.endswith(b"\n"):
            link.require_present()  # receives what has come
            time.sleep(0.01)
        assert link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S) == b"* 17\r\n"
        assert [each.reply for each in link.exchanges] == [b"!P\r\n", b"* 17\r\n"]
        terminal.say(b"one\ntwo\n")
        assert link.receive(complete=ended, deadline_s=LONGEST_S) == b"one\n"
        assert link.receive(complete=ended, deadline_s=LONGEST_S) == b"two\n"
        with pytest.raises(DeviceError, match=r'no complete answer within 0.2 s .*sent "TT "'):
            link.exchange(b"TT ", complete=ended, deadline_s=0.2)
    assert terminal.await_bytes(STOP, LONGEST_S)


def test_a_halt_does_not_wait_for_the_exchange_that_is_going_on(terminal: Terminal) -> None:
    with Ports(guarded=False) as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        waiting = threading.Thread(target=lambda: link.exchange(b"A ", complete=ended, deadline_s=60))
        waiting.start()
        assert terminal.await_bytes(b"A ", LONGEST_S)
        link.urgent(b"H ")
        assert terminal.await_bytes(b"H ", LONGEST_S)
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


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [True, False])
def test_an_unplugged_device_is_said_to_be_so(terminal: Terminal, guarded: bool) -> None:
    with Ports(guarded=guarded) as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        assert link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S)
        terminal.unplug()
        with pytest.raises(PortLostError, match="disappeared"):
            link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S)


@pytest.mark.parametrize("guarded", [True, False])
def test_absent_and_busy_ports_are_refused(terminal: Terminal, guarded: bool) -> None:
    with Ports(guarded=guarded) as ports, Ports(guarded=guarded) as others:
        with pytest.raises(DeviceError, match=r"there is no port /dev/tty-absent; .*check the cable"):
            ports.open("/dev/tty-absent", 9600, stop=STOP, name="unit")
        ports.open(terminal.address, 9600, stop=STOP, name="unit")
        with pytest.raises(DeviceError, match="in use by another program"):
            others.open(terminal.address, 9600, stop=STOP, name="unit")
        for name in (terminal.address, os.path.realpath(terminal.address)):
            with pytest.raises(DeviceError, match="already used by another device"):
                ports.open(name, 9600, stop=STOP, name="scanner")
        with pytest.raises(DeviceError, match=r"socket://127\.0\.0\.1:1 cannot be opened"):
            ports.open("socket://127.0.0.1:1", 9600, stop=STOP, name="unit")


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("", "has no name"),
        ("/dev", "is no serial port"),
        (__file__, "is no serial port"),
        ("COM7", "no port COM7"),
        ("socket://localhost", "names no port"),
        ("socket://", "names no port"),
        ("nothing://here", "cannot be opened"),
        ("a\nb\0", "cannot be opened"),
    ],
)
def test_an_address_that_is_no_port_is_refused_in_one_line(address: str, said: str) -> None:
    with pytest.raises(DeviceError, match=said) as refused, Ports(guarded=False) as ports:
        ports.open(address, 9600, stop=STOP, name="unit")
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("guarded", [True, False])
def test_closing_ends_the_exchange_that_is_going_on_and_frees_the_port(terminal: Terminal, guarded: bool) -> None:
    failed: list[DeviceError] = []

    def wait_for_the_answer(link: Link) -> None:
        with pytest.raises(DeviceError) as error:
            link.exchange(b"A ", complete=ended, deadline_s=60)
        failed.append(error.value)

    with Ports(guarded=guarded) as ports, Ports(guarded=guarded) as others:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        waiting = threading.Thread(target=wait_for_the_answer, args=(link,), daemon=True)
        waiting.start()
        assert terminal.await_bytes(b"A ", LONGEST_S)
        link.close()
        waiting.join(LONGEST_S)
        assert failed
        until = time.monotonic() + LONGEST_S
        while True:
            try:
                others.open(terminal.address, 9600, stop=STOP, name="unit")
                break
            except DeviceError:  # the guard is about to close it
                assert time.monotonic() < until
                time.sleep(0.02)


def test_a_port_is_closed_before_it_is_opened_again(terminal: Terminal) -> None:
    with Ports() as ports:
        port = ports.open(terminal.address, 9600, stop=STOP, name="unit")
        for _ in range(3):
            port.reopen()
        assert Link(port, device="the unit").exchange(b"PP ", complete=ended, deadline_s=LONGEST_S) == b"* 17\r\n"
        assert terminal.received.count(STOP) == 3


@pytest.mark.parametrize("guarded", [True, False])
def test_a_device_that_never_falls_silent_is_left(terminal: Terminal, guarded: bool) -> None:
    with Ports(guarded=guarded) as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        talking = True

        def talk() -> None:
            while talking:
                if select.select([], [terminal._master], [], 0.02)[1]:
                    terminal.say(b"0123456789abcdef" * 64)

        talker = threading.Thread(target=talk)
        talker.start()
        try:
            with pytest.raises(DeviceError, match=r"the unit on .* sends without end \(\d+ bytes\)"):
                link.exchange(b"V ", complete=ended, deadline_s=60)
        finally:
            talking = False
            talker.join()


@pytest.mark.slow
def test_a_connection_that_is_not_answered_holds_up_no_other_device(terminal: Terminal) -> None:
    deaf = socket.create_server(("127.0.0.1", 0), backlog=0)
    waiting = [socket.socket() for _ in range(4)]  # until the system takes no more
    for one in waiting:
        one.setblocking(False)
        one.connect_ex(deaf.getsockname())
    refused: list[str] = []

    def connect(ports: Ports) -> None:
        with pytest.raises(DeviceError) as error:
            ports.open(f"socket://127.0.0.1:{deaf.getsockname()[1]}", 9600, stop=b"QT\n", name="scanner")
        refused.append(str(error.value))

    try:
        with Ports() as ports:
            link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
            connecting = threading.Thread(target=connect, args=(ports,), daemon=True)
            connecting.start()
            until = time.monotonic() + 2 * LONGEST_SILENCE_S
            while time.monotonic() < until:
                assert link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S) == b"* 17\r\n"
                time.sleep(0.05)
            assert connecting.is_alive()
            assert STOP not in terminal.received
            for one in (deaf, *waiting):
                one.close()
            connecting.join(LONGEST_S)
        assert "cannot be opened" in refused[0]
    finally:
        for one in (deaf, *waiting):
            one.close()


PROGRAM = """
    import signal, sys, time
    from ladarreg_core.acquisition.devices.ports import Ports
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell
    ports = Ports()
    port = ports.open(sys.argv[1], 9600, stop=b"\\rH ", name="unit")
    port.write(b"PP1000 ")
    print("ready", ports.guard().pid, flush=True)
    time.sleep(60)
"""


# All of its group: as a terminal does by Ctrl-C and Ctrl-Z, and as the end of a session does.
@pytest.mark.slow
@pytest.mark.parametrize("end", ["SIGKILL", "SIGSTOP", "SIGINT", "SIGTERM"])
def test_the_device_stops_soon_after_the_programs_end(terminal: Terminal, end: str) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(PROGRAM), terminal.address],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=CHECKOUT, start_new_session=True,
    )  # fmt: skip
    try:
        assert program.stdout is not None
        guard = int(program.stdout.readline().split()[1])
        assert terminal.await_bytes(b"PP1000 ", LONGEST_S)
        assert STOP not in terminal.received
        os.killpg(program.pid, getattr(signal, end))
        stopped = terminal.await_bytes(STOP, LONGEST_S)
        assert stopped, (terminal.received, f"program: {program.poll()}", f"guard: {Path(f'/proc/{guard}').exists()}")
    finally:
        program.kill()
        program.wait(10)
    until = time.monotonic() + LONGEST_S
    while Path(f"/proc/{guard}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{guard}").exists(), "the guard has ended"


@pytest.mark.parametrize("end", ["SIGKILL", "SIGTERM"])
def test_the_end_of_the_guard_is_said_before_another_one_takes_over(terminal: Terminal, end: str) -> None:
    with Ports() as ports:
        link = Link(ports.open(terminal.address, 9600, stop=STOP, name="unit"), device="the unit")
        set_up: list[bool] = []
        link.when_connected(lambda: set_up.append(True))
        assert link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S)
        os.kill(ports.guard().pid, getattr(signal, end))
        why = {"SIGKILL": "has ended unexpectedly", "SIGTERM": "because it was told to end"}[end]
        with pytest.raises(GuardEndedError, match=f"process that holds the ports has ended.*{why.split()[-1]}"):
            link.receive(complete=ended, deadline_s=LONGEST_S)
        with pytest.raises(GuardEndedError):
            link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S)
        if end == "SIGTERM":
            assert terminal.await_bytes(STOP, LONGEST_S)
        assert not set_up
        assert link.exchange(b"PP ", complete=ended, deadline_s=LONGEST_S) == b"* 17\r\n"
        assert set_up


HANGING_PROGRAM = """
    import sys
    from ladarreg_core.acquisition.devices.link import Link
    from ladarreg_core.acquisition.devices.ports import Ports
    from ladarreg_core.errors import DeviceError
    with Ports() as ports:
        link = Link(ports.open(sys.argv[1], 9600, stop=b"\\rH ", name="unit"), device="the unit")
        print("ready", flush=True)
        for line in sys.stdin:
            try:
                print(link.exchange(b"PP ", complete=lambda data: data.find(b"\\n") + 1, deadline_s=30), flush=True)
            except DeviceError as error:
                print(error, flush=True)
"""


@pytest.mark.slow
def test_a_program_that_hung_is_told_that_its_devices_were_stopped(terminal: Terminal) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(HANGING_PROGRAM), terminal.address],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT,
    )  # fmt: skip
    try:
        assert program.stdin is not None
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
        program.send_signal(signal.SIGSTOP)
        assert terminal.await_bytes(STOP, LONGEST_S)
        program.send_signal(signal.SIGCONT)
        program.stdin.write("1\n2\n")
        program.stdin.flush()
        assert "because this program hung for more than 0.7 s" in program.stdout.readline()
        assert "* 17" in program.stdout.readline()
        program.stdin.close()
        assert program.wait(LONGEST_S) == 0
    finally:
        program.kill()
        program.wait(10)


def test_addresses_of_simulated_devices_are_checked() -> None:
    assert check_twin("twin:scip2?seed=3&scene=office") == ("scip2", (("scene", "office"), ("seed", "3")))
    for address, said in (("twin:", "names no device"), ("twin:a?sed=1", "'sed'"), ("twin:a?seed=-1", "whole number")):
        with pytest.raises(DeviceError, match=said):
            check_twin(address)


@pytest.mark.parametrize("guarded", [False, True])
def test_a_port_whose_device_did_not_answer_can_be_used_again(tmp_path: Path, guarded: bool) -> None:
    terminal = Terminal(tmp_path / "port", lambda data: b"")
    try:
        with Ports(guarded=guarded) as ports:
            first = ports.open(terminal.address, 9600, stop=STOP, name="unit")
            with pytest.raises(DeviceError, match="already used by another device"):
                ports.open(terminal.address, 9600, stop=STOP, name="scanner")
            first.close()
            again = ports.open(terminal.address, 9600, stop=STOP, name="scanner")
            again.write(b"hello")
            assert terminal.await_bytes(b"hello", LONGEST_S)
    finally:
        terminal.unplug()


def test_a_port_that_another_program_uses_is_said_to_be_in_use(tmp_path: Path) -> None:
    terminal = Terminal(tmp_path / "port", lambda data: b"")
    try:
        assert why_shut(terminal.address) == ""
        port = SerialPort(terminal.address, 9600)
        assert "in use by another program" in why_shut(terminal.address)
        port.close()
        assert why_shut(terminal.address) == ""
    finally:
        terminal.unplug()


def test_simulated_devices_that_do_not_start_in_time_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(twin_address, "_START_S", 0.0)
    with pytest.raises(DeviceError, match="did not answer within 0 s"):
        twin_address.resolved_twin("twin:flir-ptu?seed=918273")
