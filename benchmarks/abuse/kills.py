"""Hundreds of kills while clients edit, and pairs of stop signals."""

from __future__ import annotations

import random
import signal
import tempfile
from pathlib import Path

from benchmarks.abuse.log import Log
from testing.attacks.kill_rounds import kill_rounds
from testing.attacks.stop_rounds import stopped_while_editing

SECTION, SIGNALS = "kills", "signals"
_ON_ONE_PROJECT = 10


def run(log: Log, kills: int) -> None:
    """Kill the server this many times, ten times per project."""
    done = len(log.of(SECTION))
    while done < kills:
        count = min(_ON_ONE_PROJECT, kills - done)
        with tempfile.TemporaryDirectory(prefix="kills-") as name:
            before = done
            for found in kill_rounds(Path(name), count, seed=done, scan=True):
                log.add(SECTION, number=done, answered=found.answered, lost=found.lost[:20], count=len(found.lost))
                done += 1
            if done - before < count:  # the project could not be opened any more; go on with another
                continue


def run_signals(log: Log, pairs: int) -> None:
    """Stop the server this many times by two signals."""
    if not hasattr(signal, "SIGHUP"):
        return
    known = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    for number in range(len(log.of(SIGNALS)), pairs):
        rng = random.Random(f"signals {number}")
        first, second = rng.sample(known, 2)
        with tempfile.TemporaryDirectory(prefix="signals-") as name:
            found = stopped_while_editing(Path(name), first, second, apart_s=rng.uniform(0, 1.0), seed=number)
        log.add(SIGNALS, number=number, signals=found.signals, answered=found.answered, faults=found.faults[:10])
