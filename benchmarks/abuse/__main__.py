"""Robustness benchmark of the workbench under attack, which can be interrupted and resumed.

python -m benchmarks.abuse --log abuse.jsonl [--only kills,readers,...] [--quick] [--clients-hours 8 --pace 4]
python -m benchmarks.abuse --summarise abuse.jsonl

Every result is a line of the log; a run with the same log continues where the last one ended. Files that caused a fault
are kept beside it. At the end, and with --summarise, a summary is printed as Markdown.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from benchmarks.abuse import clients, disks, faults, floods, hostile, kills, protocol, readers
from benchmarks.abuse.log import Log, machine
from benchmarks.abuse.report import summary

SECTIONS = (
    "readers",
    "protocol",
    "kills",
    "signals",
    "disks",
    "damage",
    "faults",
    "hostile",
    "forced",
    "floods",
    "clients",
)
_WHOLE = {"mutations": 2000, "messages": 20_000, "kills": 200, "pairs": 40, "disks": 20, "flips": 2000,
          "limits": 50, "every": 1, "hostile": 500, "forced": 25,
          "flood_seconds": 15.0, "clients_hours": 8.0}  # fmt: skip
_QUICK = {"mutations": 200, "messages": 2000, "kills": 10, "pairs": 6, "disks": 8, "flips": 100,
          "limits": 5, "every": 20, "hostile": 50, "forced": 3,
          "flood_seconds": 6.0, "clients_hours": 0.5}  # fmt: skip


def main() -> None:
    arguments = _parsed()
    if arguments.summarise is not None:
        print(summary(arguments.summarise))
        return
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
    ):  # also from a background shell, so that servers and disks are cleaned up
        signal.signal(number, _stop)
    log = Log(arguments.log)
    log.add("machine", **machine())
    size = {name: getattr(arguments, name) for name in _WHOLE}
    work: dict[str, Callable[[], None]] = {
        "readers": lambda: readers.run(log, size["mutations"]),
        "protocol": lambda: protocol.run(log, size["messages"]),
        "kills": lambda: kills.run(log, size["kills"]),
        "signals": lambda: kills.run_signals(log, size["pairs"]),
        "disks": lambda: disks.run(log, size["disks"]),
        "damage": lambda: disks.run_damage(log, size["flips"]),
        "faults": lambda: faults.run(log, size["limits"], size["every"]),
        "hostile": lambda: hostile.run(log, size["hostile"]),
        "forced": lambda: hostile.run_forced(log, size["forced"]),
        "floods": lambda: floods.run(log, size["flood_seconds"]),
        "clients": lambda: clients.run(log, size["clients_hours"], arguments.pace),
    }
    for name in SECTIONS:
        if name in arguments.only:
            began = time.monotonic()
            print(f"{name} ...", file=sys.stderr, flush=True)
            work[name]()
            print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    print(summary(arguments.log))


def _stop(number: int, frame: object) -> NoReturn:
    raise SystemExit(128 + number)


def _parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=Path, default=Path("abuse.jsonl"), help="log to read and append to")
    parser.add_argument("--summarise", type=Path, metavar="LOG", help="only print the summary of a log")
    parser.add_argument("--only", type=_sections, default=SECTIONS, metavar="A,B", help=", ".join(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="a tenth of the work, about ten minutes")
    parser.add_argument("--mutations", type=int, help="damaged files per format")
    parser.add_argument("--messages", type=int, help="hostile messages")
    parser.add_argument("--kills", type=int, help="kills while clients edit")
    parser.add_argument("--pairs", type=int, help="pairs of stop signals")
    parser.add_argument("--disks", type=int, help="full disks")
    parser.add_argument("--flips", type=int, help="projects with one flipped bit")
    parser.add_argument("--limits", type=int, help="limits of memory for each kind of work")
    parser.add_argument("--every", type=int, metavar="N", help="fail only every N-th call (1: all)")
    parser.add_argument("--hostile", type=int, help="hostile files of all formats")
    parser.add_argument("--forced", type=int, help="runs of each command with --force")
    parser.add_argument("--flood-seconds", type=float, help="duration of each flood")
    parser.add_argument("--clients-hours", type=float, help="hours of work of ten clients, at pace 1")
    parser.add_argument("--pace", type=float, default=1.0, help="speed of the clients relative to people")
    arguments = parser.parse_args()
    if arguments.pace <= 0:
        parser.error("--pace must be positive")
    for name, value in (_QUICK if arguments.quick else _WHOLE).items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    return arguments


def _sections(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    unknown = [name for name in names if name not in SECTIONS]
    if unknown:
        raise argparse.ArgumentTypeError(f"there is no section {', '.join(unknown)}; choose from {', '.join(SECTIONS)}")
    return names


if __name__ == "__main__":
    main()
