"""Runs in real time: a program that hangs or is killed, with a guard in a process of its own."""

from __future__ import annotations

import ctypes
import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.acquisition.devices.ports import Ports
from ladarreg_core.acquisition.plan import Axis
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runs.runner import Paused, PieceKept, Repeated, RunEvent
from ladarreg_core.acquisition.serial_port import why_shut
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from testing.devices.runs import Devices, pieces_of, same

pytestmark = pytest.mark.slow
CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def twins() -> Iterator[TwinDevices]:
    with TwinDevices("office", 5) as found:
        yield found


def hang(seconds: float) -> None:
    """Hold the interpreter, so that no thread of this program runs."""
    if sys.platform == "win32":
        ctypes.PyDLL("kernel32").Sleep(round(1e3 * seconds))
    else:
        ctypes.PyDLL(None).usleep(round(1e6 * seconds))


def goes_on_by_itself(
    devices: Devices, folder: RunWriter, events: list[RunEvent], on_event: Callable[[RunEvent], None] | None = None
) -> bool:
    """Run a plan; faults of devices that a busy machine holds up for a second are resumed."""

    def note(event: RunEvent) -> None:
        if isinstance(event, Paused):
            threading.Timer(0.1, run.resume).start()
        elif on_event is not None:
            on_event(event)

    run = devices.run(folder, events, note, fails=True)
    return run.go()


@pytest.mark.long
def test_a_program_that_hangs_for_a_moment_goes_on_by_itself(twins: TwinDevices, tmp_path: Path) -> None:
    """The guard has stopped the devices meanwhile: the piece is measured again, whatever was under way."""
    with Ports() as ports:
        devices = Devices(twins, ports)
        plan = devices.plan(pan=Axis(-2, 2, 2))
        whole = RunWriter.begin(tmp_path / "whole", plan)
        assert goes_on_by_itself(devices, whole, [])
        whole.close()
        events: list[RunEvent] = []

        def hang_twice(event: RunEvent) -> None:
            if isinstance(event, PieceKept) and event.done < 3:
                hang(1.2)

        folder = RunWriter.begin(tmp_path / "run", plan)
        assert goes_on_by_itself(devices, folder, events, hang_twice)
        folder.close()
    assert {event.index for event in events if isinstance(event, Repeated)} >= {1, 2}
    assert same(pieces_of(tmp_path / "whole"), pieces_of(tmp_path / "run"))


PROGRAM = """
    import sys, threading
    from ladarreg_core.acquisition.plan_reading import read_plan
    from ladarreg_core.acquisition.devices.ports import Ports
    from ladarreg_core.acquisition.devices.flir_unit import FlirUnit
    from ladarreg_core.acquisition.devices.scip_scanner import ScipScanner
    from ladarreg_core.acquisition.runs.run_folder import RunWriter
    from ladarreg_core.acquisition.runs.runner import Paused, PieceKept, Run
    plan = read_plan(sys.argv[1])

    def report(event):
        if isinstance(event, PieceKept):
            print(event.record.index, flush=True)
        elif isinstance(event, Paused):  # a busy machine has held up a simulated device
            threading.Timer(0.2, run.resume).start()

    with Ports() as ports:
        unit, scanner = FlirUnit.connect(ports, plan.unit), ScipScanner.connect(ports, plan.scanner)
        folder = RunWriter.begin(sys.argv[2], plan, resume=sys.argv[3] == "resume")
        run = Run(plan, folder, unit=unit, line_scanner=scanner, report=report)
        run.go()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_killed_run_keeps_every_piece_that_it_reported(twins: TwinDevices, tmp_path: Path) -> None:
    from textwrap import dedent

    from ladarreg_core.acquisition.plan import write_plan

    with Ports(guarded=False) as ports:
        devices = Devices(twins, ports)
        plan = devices.plan(pan=Axis(-2, 2, 1))
    write_plan(tmp_path / "plan.json", plan)

    def begun(how: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", dedent(PROGRAM), str(tmp_path / "plan.json"), str(tmp_path / "run"), how],
            stdout=subprocess.PIPE, text=True, cwd=CHECKOUT,
        )  # fmt: skip

    program = begun("new")
    assert program.stdout is not None
    reported = [int(program.stdout.readline()) for _ in range(2)]
    program.send_signal(signal.SIGKILL)
    assert devices.come_to_rest()
    program.wait()
    assert set(reported) <= set(RunFolder.open(tmp_path / "run").records)
    until = time.monotonic() + 30
    while any(why_shut(address) for address in twins.server.addresses.values()):  # the guard is about to let go of them
        assert time.monotonic() < until
        time.sleep(0.02)
    assert begun("resume").wait(120) == 0
    assert RunFolder.open(tmp_path / "run").complete
    assert math.isfinite(float(np.nanmean(pieces_of(tmp_path / "run")[0].ranges_m)))
