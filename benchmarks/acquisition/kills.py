"""Runs that are killed and devices that are unplugged, at random times: rows `kills` and `unplugs`.

The simulated devices are driven by a process of its own, again and again, with moves so slow that only a halt ends them
within a second. After each kill: whether every piece that was reported is there, and how long the unit moved on and the
laser stayed on. After each run that was resumed to its end: whether the panorama is, bit for bit, that of a run that
nothing disturbed. An unplugged device is plugged in again after the run has paused; until then the last moment is taken
at which the other device was not at rest. Runs without the guard process are the control.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.shared.bars import Row
from ladarreg_core.acquisition.composition.panorama import compose
from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan, write_plan
from ladarreg_core.acquisition.plan_reading import read_plan
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runs.runner import Paused, PieceKept, RunEvent
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.acquisition.simulated.world import LINE_MOUNT

LONGEST_S = 1.0
"""How long a device may go on after a kill."""
KILLS, UNPLUGS, SEED = 50, 20, 1
_QUICK_KILLS, _QUICK_UNPLUGS = 10, 5
_CONTROLS = 6
_SPEED_DEG_S = 5.0
_LONGEST_RUN_S = 4.0
_WAIT_S = 60.0
_POLL_S = 0.005
_LET_GO_S = 0.5


@dataclass
class Outcome:
    """What the kills or unplugs showed."""

    events: int = 0
    active: int = 0
    """Of these the ones at which the unit moved or the laser was on."""
    rest_s: list[float] = field(default_factory=list)
    """Time until all that could be stopped was at rest, s, each time."""
    lost_pieces: int = 0
    """Pieces that were reported kept and are not there."""
    runs: int = 0
    """Runs resumed to their end."""
    different: int = 0
    """Of these the ones whose panorama differs from the undisturbed one."""

    def rows(self, name: str) -> list[Row]:
        """Return the rows of the table."""
        longest, lost, of = (
            max(self.rest_s),
            self.lost_pieces,
            f"{self.events} {name}, {self.active} in motion or light",
        )
        return [
            Row(f"{of}: pieces that were reported kept and are missing", "0", str(lost), lost == 0),
            Row(f"{name}: time until at rest, longest", "<= 1 s", f"{longest:.2f} s", longest <= LONGEST_S),
            Row(
                f"{name}: panoramas of resumed runs, bit for bit as undisturbed", "all",
                f"{self.runs - self.different} of {self.runs}", self.different == 0,
            ),
        ]  # fmt: skip


class Driver:
    """A process that runs a plan, and says what it does."""

    def __init__(self, plan: Path, run: Path, *, guarded: bool = True) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.acquisition.kills", str(plan), str(run), "bare" * (not guarded)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.kept: set[int] = set()
        self.said = threading.Condition()
        self.words: list[str] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def await_word(self, word: str) -> bool:
        """Return whether it says a word before it ends."""
        with self.said:
            self.said.wait_for(lambda: word in self.words or "end" in self.words, _WAIT_S)
            return word in self.words

    def has_said(self, *words: str) -> bool:
        """Return whether it has said any of some words."""
        with self.said:
            return any(word in self.words for word in words)

    def resume(self) -> None:
        """Have it go on after a pause."""
        assert self.process.stdin is not None
        with self.said:
            self.words = [word for word in self.words if word != "paused"]
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            word, _, rest = line.strip().partition(" ")
            with self.said:
                if word == "kept":
                    self.kept.add(int(rest))
                self.words.append(word)
                self.said.notify_all()
        with self.said:
            self.words.append("end")
            self.said.notify_all()


def drive(plan: Path, run: Path, *, guarded: bool) -> None:
    """Run a plan, or go on with it, as the process that is killed."""
    from ladarreg_core.acquisition.devices.ports import Ports
    from ladarreg_core.acquisition.runs.connected import connected

    def say(event: RunEvent) -> None:
        if isinstance(event, PieceKept):
            print("kept", event.record.index, flush=True)
        elif isinstance(event, Paused):
            print("paused", event.reason, flush=True)

    folder = RunWriter.begin(run, read_plan(plan), resume=run.exists())
    with connected(folder.plan, ports=partial(Ports, guarded=guarded)) as devices:
        acquisition = devices.run(folder.plan, folder, say)

        def resume() -> None:
            for _ in sys.stdin:
                acquisition.resume()

        threading.Thread(target=resume, daemon=True).start()
        print("connected", flush=True)
        acquisition.go()
    folder.close()


def kills_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Kill runs at random times and resume them."""
    with _bench() as (twins, plan, scratch):
        found = kills(twins, plan, _QUICK_KILLS if quick else KILLS, scratch, show=show)
        control = kills(twins, plan, _CONTROLS, scratch / "bare", show=show, guarded=False)
    longest = max(control.rest_s)
    return [
        *found.rows("kills"),
        Row("kills, control without guard: time until at rest", "> 1 s", f"{longest:.2f} s", longest > LONGEST_S),
    ]


def unplugs_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Unplug a device at random times, plug it in again, and resume; the time is that of the other device."""
    with _bench() as (twins, plan, scratch):
        return unplugs(twins, plan, _QUICK_UNPLUGS if quick else UNPLUGS, scratch, show=show).rows("unplugs")


@contextmanager
def _bench() -> Iterator[tuple[TwinDevices, Path, Path]]:
    with TwinDevices("office", SEED) as twins, tempfile.TemporaryDirectory() as name:
        scratch, at = Path(name), twins.addresses
        plan = Plan(
            UnitPlan(at["flir-ptu"], baud=115_200, speed_deg_s=_SPEED_DEG_S),
            ScannerPlan("scip2", at["scip2"], lines=2), "sweep",
            pan=Axis(-30, 30, 10), tilt=Axis(0, 0, 0), mount=LINE_MOUNT, settle_s=0.0,
        )  # fmt: skip
        write_plan(scratch / "plan.json", plan)
        yield twins, scratch / "plan.json", scratch


def kills(
    twins: TwinDevices, plan: Path, count: int, scratch: Path, *, show: Callable[[str], None], guarded: bool = True
) -> Outcome:
    """Kill runs at random times and resume them."""
    scratch.mkdir(exist_ok=True)
    random = np.random.default_rng(SEED)
    truth = _panorama(_undisturbed(plan, scratch / "undisturbed"))
    found = Outcome()
    while found.events < count:
        run = scratch / f"kill-{found.runs}"
        while found.events < count:
            driver = Driver(plan, run, guarded=guarded)
            driver.await_word("connected")
            time.sleep(float(random.uniform(0, _LONGEST_RUN_S)))
            if driver.process.poll() is not None:
                break
            found.active += _is_active(twins)
            driver.process.kill()
            found.events += 1
            found.rest_s.append(_until_rest(twins, ("moving", "laser_on")))
            show(f"kill {found.events}: at rest after {found.rest_s[-1]:.2f} s")
            driver.process.wait()
            driver.await_word("end")
            found.lost_pieces += len(driver.kept - set(RunFolder.open(run).records))
            time.sleep(_LET_GO_S)  # the guard closes the ports
        if not RunFolder.open(run).complete:
            _undisturbed(plan, run)
        found.runs += 1
        found.different += _panorama(run) != truth
    return found


def unplugs(twins: TwinDevices, plan: Path, count: int, scratch: Path, *, show: Callable[[str], None]) -> Outcome:
    """Unplug a device at random times, plug it in again, and resume."""
    random = np.random.default_rng(SEED)
    truth = _panorama(_undisturbed(plan, scratch / "undisturbed-2"))
    found = Outcome()
    others = {"flir-ptu": "laser_on", "scip2": "moving"}
    while found.events < count:
        run = scratch / f"unplug-{found.runs}"
        driver = Driver(plan, run)
        driver.await_word("connected")
        while found.events < count:
            time.sleep(float(random.uniform(0, _LONGEST_RUN_S)))
            if driver.process.poll() is not None:
                break
            device = str(random.choice(list(others)))
            found.active += _is_active(twins)
            since = time.monotonic()
            twins.fail(device, "unplugged")
            found.events += 1
            last = since
            while not driver.has_said("paused", "end"):
                if twins.state()[others[device]]:
                    last = time.monotonic()
                time.sleep(_POLL_S)
            paused = driver.has_said("paused")
            found.rest_s.append(last - since)
            show(f"unplugged {found.events} ({device}): the other at rest after {found.rest_s[-1]:.2f} s")
            twins.fail(device, "plugged")
            if not paused:
                break
            driver.resume()
        driver.await_word("end")
        driver.process.wait()
        found.lost_pieces += len(driver.kept - set(RunFolder.open(run).records))
        time.sleep(_LET_GO_S)
        if not RunFolder.open(run).complete:
            _undisturbed(plan, run)
        found.runs += 1
        found.different += _panorama(run) != truth
    return found


def _undisturbed(plan: Path, run: Path) -> Path:
    driver = Driver(plan, run)
    driver.await_word("end")
    driver.process.wait()
    time.sleep(_LET_GO_S)
    return run


def _panorama(run: Path) -> tuple[bytes, ...]:
    """Return the arrays of a run's panorama, as bytes."""
    scan = compose(run).scan
    arrays = (scan.ranges, scan.intensity, scan.points)
    return tuple(np.ascontiguousarray(array).tobytes() for array in arrays)


def _is_active(twins: TwinDevices) -> bool:
    state = twins.state()
    return bool(state["moving"] or state["laser_on"])


def _until_rest(twins: TwinDevices, moved: tuple[str, ...]) -> float:
    begun = time.monotonic()
    while any(twins.state()[what] for what in moved) and time.monotonic() - begun < 10 * LONGEST_S:
        time.sleep(_POLL_S)
    return time.monotonic() - begun


if __name__ == "__main__":
    drive(Path(sys.argv[1]), Path(sys.argv[2]), guarded=sys.argv[3] != "bare")
