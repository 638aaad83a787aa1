"""Full disks, flipped bits and missing files."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from benchmarks.abuse.log import Log
from testing.attacks.filled_disks import LimitedDisk, full_disk, mounted_disk
from testing.attacks.project_damage import Damaged, flipped, make_project, missing

SECTION, DAMAGE = "disks", "damage"
_ENDS = ("torn", "kill", "wait", "stop")
_AT_A_TIME = 200


def run(log: Log, disks: int) -> None:
    """Fill this many disks: RAM disks where they can be mounted, else by limits of file sizes."""
    if sys.platform != "linux":
        return
    for number in range(len(log.of(SECTION)), disks):
        ends = _ENDS[number % len(_ENDS)]
        with mounted_disk() as mounted, tempfile.TemporaryDirectory(prefix="room-") as name:
            room = Path(name)
            (room / "disk").mkdir()
            # A limit tears records at any byte, a disk only at the end of a page: some of each.
            limited = mounted is None or number // len(_ENDS) % 2 == 1
            disk = LimitedDisk(room / "disk") if limited or mounted is None else mounted
            found = full_disk(room / "room", disk, seed=number, ends=ends)
        log.add(
            SECTION, number=number, disk=found.disk, ends=ends, saved=found.saved, unsaved=found.unsaved,
            lost=found.lost[:20], count=len(found.lost),
        )  # fmt: skip


def run_damage(log: Log, flips: int) -> None:
    """Flip this many single bits of a project, and remove each of its files."""
    with tempfile.TemporaryDirectory(prefix="damage-") as name:
        room = Path(name)
        os.environ["LADARREG_HOME"] = str(room / "home")
        reference = make_project(room / "project")
        if not log.of(DAMAGE, kind="missing"):
            found = [
                missing(reference, room, file, emptied=emptied)
                for file in reference.files()
                for emptied in (False, True)
            ]
            _note(log, "missing", 0, found)
        done = {row["first"] for row in log.of(DAMAGE, kind="flips")}
        for first in range(0, flips, _AT_A_TIME):
            if first not in done:
                numbers = range(first, min(first + _AT_A_TIME, flips))
                _note(log, "flips", first, [flipped(reference, room, seed=str(number)) for number in numbers])


def _note(log: Log, kind: str, first: int, found: list[Damaged]) -> None:
    losses = [f"{damaged.what}: {text}" for damaged in found for text in damaged.losses]
    hurt = sum(bool(damaged.losses) for damaged in found)
    log.add(DAMAGE, kind=kind, first=first, tried=len(found), hurt=hurt, losses=losses[:20])
