"""Runs that are killed and devices that are unplugged, at random times.

`python -m benchmarks.acquisition_kills [--kills 50] [--unplugs 20] [--seed 1]` drives the simulated devices by a
process of its own, again and again. After each kill: whether every piece that was reported is there, and how long the
unit moved on and the laser stayed on. After each run that was resumed to its end: whether the panorama is, bit for bit,
that of a run that nothing disturbed. An unplugged device is plugged in again after the run has paused; until then the
time is taken that the other device takes to come to rest.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan, read_plan, write_plan
from ladarreg_core.acquisition.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runner import Paused, PieceKept, RunEvent
from ladarreg_core.panorama import compose
from ladarreg_core.twins.devices import TwinDevices
from ladarreg_core.twins.world import LINE_MOUNT

LONGEST_S = 1.0
"""How long a device may go on after a kill."""
_LONGEST_RUN_S = 2.5
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

    def row(self, name: str) -> str:
        """Return a row of the table."""
        late = sum(rest > LONGEST_S for rest in self.rest_s)
        longest = max(self.rest_s, default=0.0)
        counts = (self.events, self.active, self.lost_pieces, late, f"{longest:.2f}", self.runs, self.different)
        return f"| {name} | {' | '.join(map(str, counts))} |"


class Driver:
    """A process that runs a plan, and says what it does."""

    def __init__(self, plan: Path, run: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.acquisition_kills", "--drive", str(plan), str(run)],
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


def drive(plan: Path, run: Path) -> None:
    """Run a plan, or go on with it, as the process that is killed."""
    from ladarreg_core.acquisition.connected import connected

    def say(event: RunEvent) -> None:
        if isinstance(event, PieceKept):
            print("kept", event.record.index, flush=True)
        elif isinstance(event, Paused):
            print("paused", event.reason, flush=True)

    folder = RunWriter.begin(run, read_plan(plan), resume=run.exists())
    with connected(folder.plan) as devices:
        acquisition = devices.run(folder.plan, folder, say)

        def resume() -> None:
            for _ in sys.stdin:
                acquisition.resume()

        threading.Thread(target=resume, daemon=True).start()
        print("connected", flush=True)
        acquisition.go()
    folder.close()


def kills(twins: TwinDevices, plan: Path, count: int, random: np.random.Generator, scratch: Path) -> Outcome:
    """Kill runs at random times and resume them."""
    truth = _panorama(_undisturbed(plan, scratch / "undisturbed"))
    found = Outcome()
    while found.events < count:
        run = scratch / f"kill-{found.runs}"
        while found.events < count:
            driver = Driver(plan, run)
            driver.await_word("connected")
            time.sleep(float(random.uniform(0, _LONGEST_RUN_S)))
            if driver.process.poll() is not None:
                break
            found.active += _is_active(twins)
            driver.process.kill()
            found.events += 1
            found.rest_s.append(_until_rest(twins, ("moving", "laser_on")))
            driver.process.wait()
            driver.await_word("end")
            found.lost_pieces += len(driver.kept - set(RunFolder.open(run).records))
            time.sleep(_LET_GO_S)  # the guard closes the ports
        if not RunFolder.open(run).complete:
            _undisturbed(plan, run)
        found.runs += 1
        found.different += _panorama(run) != truth
    return found


def unplugs(twins: TwinDevices, plan: Path, count: int, random: np.random.Generator, scratch: Path) -> Outcome:
    """Unplug a device at random times, plug it in again, and resume."""
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
            twins.fail(device, "unplugged")
            found.events += 1
            paused = driver.await_word("paused")
            found.rest_s.append(_until_rest(twins, (others[device],)))
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


def main() -> int:
    """Print the table; return 1 if anything was lost, late or different."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--unplugs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--drive", nargs=2, type=Path, metavar=("PLAN", "RUN"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.drive:
        drive(*arguments.drive)
        return 0
    random = np.random.default_rng(arguments.seed)
    with TwinDevices("office", arguments.seed) as twins, tempfile.TemporaryDirectory() as name:
        scratch, at = Path(name), twins.addresses
        plan = Plan(
            UnitPlan(at["flir-ptu"], baud=115_200), ScannerPlan("scip2", at["scip2"], lines=2), "sweep",
            pan=Axis(-30, 30, 5), tilt=Axis(0, 0, 0), mount=LINE_MOUNT, settle_s=0.1,
        )  # fmt: skip
        write_plan(scratch / "plan.json", plan)
        print("| event | events | in motion or light | pieces lost | later than 1 s | longest, s | runs | different |")
        print("|---|---|---|---|---|---|---|---|")
        found = []
        for what, measure, count in (("kill", kills, arguments.kills), ("unplug", unplugs, arguments.unplugs)):
            if count:
                found.append(measure(twins, scratch / "plan.json", count, random, scratch))
                print(found[-1].row(what), flush=True)
    return int(any(one.lost_pieces or one.different or max(one.rest_s) > LONGEST_S for one in found))


if __name__ == "__main__":
    sys.exit(main())
