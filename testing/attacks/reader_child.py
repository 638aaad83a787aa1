"""A process that reads damaged files and reports the cost of each.

`python -m testing.attacks.reader_child FOLDER FORMAT FIRST LAST ...` prints one JSON line per damaged file. Its
parent concludes from a missing line that the file killed it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import FORMATS, describe, extract_images, read_photo, read_scan
from ladarreg_core.formats.cameras.camera_file import read_cameras
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.formats.documents.pose_file import read_initial, read_pose
from ladarreg_core.formats.documents.registration_file import read_offset, read_registration
from ladarreg_core.frames import Rigid
from testing.attacks.mutations import mutated
from testing.files.seed_files import REFERENCE_SCAN, seeds_in

MAX_SECONDS, MAX_MB = 5.0, 1024.0
"""Limits for files of less than 1 MB."""
LONGEST_SENTENCE = 300
_ADDRESS_SPACE = 5 << 30
"""Memory limit beyond that of the idle process: a file that needs more is detected without harming the machine. Less
would reject libraries that reserve the size that a 32-bit length claims without ever using it."""


def readers_of(kind: str, name: str, folder: Path) -> dict[str, Callable[[Path], object]]:
    """Return all readers of a format."""
    found: dict[str, Callable[[Path], object]] = {"describe": describe}
    if kind == "scan":
        found["read_scan"] = read_scan
        found["read_scan, origin stated"] = lambda path: read_scan(path, origin=(0.0, 0.0, 0.0))
    if kind == "photo":
        found["read_photo"] = lambda path: read_photo(path, focal_px=50.0)
        found["read_photo, own camera"] = read_photo
    if kind == "camera":
        found["read_cameras"] = read_cameras
    if kind == "pose":
        found |= {"read_pose": read_pose, "read_registration": read_registration, "read_offset": read_offset}
        found["read_initial"] = lambda path: read_initial(path, Rigid.identity())
    if kind == "matches":
        scan = read_scan(folder / REFERENCE_SCAN)
        found["read_matches"] = lambda path: read_matches(path, scan)
    if name == "E57":
        found["extract_images"] = lambda path: extract_images(path, path.parent / "extracted")
    return found


def main(folder: str, names: str, first: str, last: str, patience_s: str, keep: str = "") -> None:
    """Read the damaged files of a range of numbers, of one format after the other.

    Args:
        folder: contains the seeds.
        names: of the formats, as a JSON list.
        first: number of the first damaged file of the first format; the others begin with 0.
        last: number after the last of each.
        patience_s: wall time after which the process ends itself.
        keep: folder that files are copied to which cost too much or raise what they should not.
    """
    for name in json.loads(names):
        _read_format(Path(folder), name, range(int(first), int(last)), float(patience_s), keep)
        first = "0"


def _read_format(home: Path, name: str, numbers: range, patience_s: float, keep: str) -> None:
    seeds = [seed for seed in seeds_in(home) if seed.format == name]
    kind = next(known.kind for known in FORMATS if known.name == name)
    readers = readers_of(kind, name, home)
    for seed in seeds:  # imports everything that the readers need; valid files must be readable
        for reader in readers.values():
            with contextlib.suppress(LadarregError):
                reader(seed.file)
    _limit_address_space()
    room = home / f"work-{os.getpid()}"
    for number in numbers:
        seed = seeds[number % len(seeds)]
        shutil.copytree(seed.file.parent, room)
        data = mutated(seed.damaged.read_bytes(), seed=f"{seed.name} {number}")
        (room / seed.damaged.name).write_bytes(data)
        row = {"format": name, "number": number, "seed": seed.name, "bytes": len(data)}
        row |= _read(room / seed.file.name, readers, patience_s)
        if row["faults"] and keep:
            Path(keep).mkdir(parents=True, exist_ok=True)
            shutil.copyfile(room / seed.damaged.name, Path(keep) / f"{number}-{seed.damaged.name}")
        sys.stdout.write(f"{json.dumps(row)}\n")
        sys.stdout.flush()
        shutil.rmtree(room)


def _read(path: Path, readers: dict[str, Callable[[Path], object]], patience_s: float) -> dict[str, Any]:
    """Return the outcome of all readers for a file."""
    faults: list[str] = []
    seconds = megabytes = 0.0
    refused: set[str] = set()
    for name, reader in readers.items():
        before, began = _processor_s(), time.perf_counter()
        with _peak() as peak_mb:
            error = _tried(reader, path, patience_s)
        spent = min(_processor_s() - before, time.perf_counter() - began)  # excludes the load of other programs
        seconds, megabytes = max(seconds, spent), max(megabytes, peak_mb())
        if isinstance(error, LadarregError):
            refused.add(name)
        faults += [f"{name}: {fault}" for fault in _faults(error)]
        if spent > MAX_SECONDS:
            faults.append(f"{name}: slow, {spent:.1f} s")
        if peak_mb() > MAX_MB:
            faults.append(f"{name}: memory, {peak_mb():.0f} MB")
    reading = [*readers][1:] or [*readers]  # the first only describes
    every = refused.issuperset(reading)
    return {"refused": every, "seconds": round(seconds, 4), "mb": round(megabytes, 1), "faults": faults}


def _tried(reader: Callable[[Path], object], path: Path, patience_s: float) -> BaseException | None:
    faulthandler.dump_traceback_later(patience_s, exit=True)  # also from inside a library that holds the GIL
    try:
        reader(path)
    except Exception as error:
        return error
    finally:
        faulthandler.cancel_dump_traceback_later()
    return None


def _faults(error: BaseException | None) -> Iterator[str]:
    """Return what is wrong with the refusal of a file."""
    if error is None:
        return
    if not isinstance(error, LadarregError):
        yield f"{type(error).__name__}: {str(error)[:200]}"
        return
    cause: BaseException | None = error
    for _ in range(20):
        if isinstance(cause, MemoryError):
            yield f"memory, more than {_ADDRESS_SPACE >> 20} MB were asked for"
            return
        cause = None if cause is None else cause.__cause__ or cause.__context__
    text = str(error)
    if not text.isprintable() or not 20 < len(text) <= LONGEST_SENTENCE:
        yield f"no sentence: {text[:200]!r}"


def _processor_s() -> float:
    """Return the processor time of this process and of its finished children, s."""
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


@contextlib.contextmanager
def _peak() -> Iterator[Callable[[], float]]:
    """Yield a function that returns the peak resident memory above that at the beginning, MB; 0 where unknown."""
    before = _resident_mb("VmRSS")
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    found = 0.0

    def value() -> float:
        return found

    yield value
    found = max(0.0, _resident_mb("VmHWM") - before)


def _resident_mb(field: str) -> float:
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(field)), 0.0)


def _limit_address_space() -> None:
    if sys.platform != "linux":  # elsewhere there is no such limit, or it is ignored
        return
    import resource

    now_mb = _resident_mb("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, ((int(now_mb) << 20) + _ADDRESS_SPACE, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main(*sys.argv[1:])
