"""Readers in separate processes: one that hangs, crashes or grows only fails its own file."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, Cancelled, FormatError, OptionError
from ladarreg_core.formats import describe, read_photo, read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.formats.isolated import IsolatedReaders, ReaderLimits
from ladarreg_core.formats.isolated.messages import MessageError, read_message, write_message
from ladarreg_core.formats.isolated.pieces import Turn, write_piece
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner import gridding, grids
from ladarreg_core.scanner.grids import (
    AzimuthElevation,
    PinholeGrid,
    RingGrid,
    RotatedGrid,
    SphericalGrid,
    TabulatedGrid,
)
from ladarreg_core.simulate.sample import sample_folder
from tests.formats import misbehaving

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="the kernel's part of the limits is Linux's")
QUICK = ReaderLimits(silent_s=1.0, silent_s_per_mb=0)


@pytest.fixture(scope="module")
def readers() -> Iterator[IsolatedReaders]:
    found = IsolatedReaders()
    yield found
    found.close()


@pytest.fixture(scope="module")
def strict() -> Iterator[IsolatedReaders]:
    """Readers with short timeouts."""
    found = IsolatedReaders(QUICK)
    yield found
    found.close()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a file.e57"
    path.write_bytes(b"nothing much")
    return path


def gone(process: int, within_s: float = 60.0) -> bool:
    """Whether a process ends, zombies included."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            if Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.02)
    return False


# The same as without a process


def sample_scans() -> list[Scan]:
    azimuth = AzimuthElevation(5, 7, 0.01, 0.02, azimuth_offset_rad=0.001)
    turned = RotatedGrid(azimuth, Rigid.from_rotvec([0.1, 0.2, 0.3]).rotation)
    grids = [
        azimuth,
        PinholeGrid(Camera(7, 5, 10.0, 11.0, 3.0, 2.0, (0.1, 0.01, 0.0, 0.0))),
        SphericalGrid(5, 7, 0.01, 0.02, 0.1, 0.2),
        RingGrid(np.linspace(0.1, -0.1, 5), np.arange(5) / 3, 7, 0.02, 0.3),
        turned,
        TabulatedGrid(azimuth.rays * 1.7),
        TabulatedGrid(turned.rays, turned),
    ]
    rng = np.random.default_rng(0)
    ranges = rng.uniform(1, 5, (5, 7)).astype(np.float32)
    ranges[2, 3] = np.nan
    return [
        Scan(
            grid,
            ranges,
            rng.uniform(0, 1, (5, 7)),
            color=rng.integers(0, 256, (5, 7, 3), dtype=np.uint8),
            intensity_is="range_normalised",
            world_from_scanner=Rigid.from_rotvec([0.3, 0, 0.1], [1, 2, 3]),
            name="naïve",
            notes=("one", "two"),
        )
        for grid in grids
    ]


def fields_of(value: Any) -> Any:
    """A value as plain lists, so that it can be compared."""
    if dataclasses.is_dataclass(value):
        pairs = ((f.name, fields_of(getattr(value, f.name))) for f in dataclasses.fields(value))
        return type(value).__name__, dict(pairs)
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return [fields_of(item) for item in value] if isinstance(value, list | tuple) else value


@pytest.mark.parametrize("scan", sample_scans(), ids=lambda scan: type(scan.geometry).__name__)
def test_a_scan_comes_back_to_the_bit(scan: Scan) -> None:
    stream = io.BytesIO()
    write_message(stream, scan)
    stream.seek(0)
    found = read_message(stream, largest_bytes=1 << 20)
    assert fields_of(found) == fields_of(scan)
    assert np.array_equal(found.points, scan.points, equal_nan=True)
    assert not found.geometry.rays.flags.writeable
    assert stream.read() == b""


def test_every_geometry_can_be_sent() -> None:
    known = {type(scan.geometry) for scan in sample_scans()}
    every = {
        found
        for module in (grids, gridding)
        for found in vars(module).values()
        if dataclasses.is_dataclass(found) and isinstance(found, type) and hasattr(found, "ray_at")
    }
    assert every == known


@pytest.mark.slow
def test_readers_return_the_same_as_in_this_process(readers: IsolatedReaders, tmp_path: Path) -> None:
    folder = sample_folder()
    photo = next(folder.glob("photo.*"))
    scan = readers.run(read_scan, folder / "scan.npz", scan_index=0)
    assert fields_of(scan) == fields_of(replace(read_scan(folder / "scan.npz"), source=None))  # the caller knows it
    camera = readers.run(read_camera, folder / "camera.json")
    assert camera == read_camera(folder / "camera.json")
    for options in ({"camera": camera}, {"camera": folder / "camera.json"}, {"focal_px": 500.0}):
        here = replace(read_photo(photo, **options), source=None)
        assert fields_of(readers.run(read_photo, photo, **options)) == fields_of(here)
    for path in (folder / "scan.npz", photo, folder / "camera.json"):
        assert fields_of(readers.run(describe, path)) == fields_of(describe(path))
    matches = {"kind": "line", "scan": [[10.5, 11], [20, 30.25]], "photo": [[1.5, 2], [3, 4]], "weight": 2.5}
    file = tmp_path / "matches.json"
    file.write_text(json.dumps({"version": 1, "scan_coordinates": "cell", "matches": [matches]}))
    (found,), (direct,) = readers.run(read_matches, file, scan), read_matches(file, scan)
    assert (found.id, found.kind, found.on, found.weight) == (direct.id, "line", True, 2.5)
    assert np.allclose(found.scan, direct.scan, rtol=0, atol=1e-15)
    assert np.array_equal(found.photo, direct.photo)


def test_a_thermal_image_keeps_its_temperatures() -> None:
    kelvin = np.linspace(290, 300, 12, dtype=np.float32).reshape(3, 4)
    photo = Photo(np.zeros((3, 4, 3), np.uint8), Camera.from_focal(4, 3, 5.0), temperature_k=kelvin, calibrated=True)
    stream = io.BytesIO()
    write_message(stream, photo)
    stream.seek(0)
    assert fields_of(read_message(stream, largest_bytes=1 << 20)) == fields_of(photo)


@pytest.mark.parametrize("value", [None, True, -3, 0.1, float("inf"), "ü\n", [1, (2, "x")], {"a": {"#": 1}}, Path("x")])
def test_plain_values_come_back(readers: IsolatedReaders, value: Any) -> None:
    found = readers.run(misbehaving.echo, value)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("dtype", ["?", "u1", ">u2", "<i8", "f4", ">f8"])
@pytest.mark.parametrize("shape", [(), (0, 3), (4,), (2, 3, 4)])
def test_arrays_come_back(dtype: str, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    stream = io.BytesIO()
    write_message(stream, [array, array.T])
    stream.seek(0)
    found, turned = read_message(stream, largest_bytes=1 << 10)
    assert fields_of(found) == fields_of(array)
    assert np.array_equal(turned, array.T)


def test_errors_of_ours_come_back_as_they_are(readers: IsolatedReaders, tmp_path: Path) -> None:
    folder = sample_folder()
    cut = tmp_path / "cut.npz"
    cut.write_bytes((folder / "scan.npz").read_bytes()[:-400])
    calls: list[tuple[type[Exception], Callable[..., Any], tuple[Any, ...], dict[str, Any]]] = [
        (FormatError, read_scan, (cut,), {}),
        (FormatError, read_scan, (tmp_path / "none.e57",), {}),
        (OptionError, read_scan, (folder / "scan.npz",), {"scan_index": 4}),
        (CameraError, read_photo, (next(folder.glob("photo.*")),), {}),
        (FormatError, misbehaving.refuses, (cut,), {}),
    ]
    for kind, function, args, kwargs in calls:
        with pytest.raises(kind) as here:
            function(*args, **kwargs)
        with pytest.raises(kind) as there:
            readers.run(function, *args, **kwargs)
        assert type(there.value) is type(here.value)
        assert str(there.value) == str(here.value)


# Failures


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reader", "says"),
    [
        (misbehaving.crashes, "its reader crashed (Seg"),
        (misbehaving.aborts, "its reader crashed (Abort"),
        (misbehaving.exits, "its reader ended with code 0x3 and no answer"),
        (misbehaving.fails, "its reader failed (ZeroDivisionError)"),
        (misbehaving.returns_code, "its reader failed (TypeError)"),
        (misbehaving.writes_nonsense, "its reader sent an invalid answer"),
        (misbehaving.sleeps, "its reader hung and was stopped after"),
        (misbehaving.computes, "its reader hung and was stopped after"),
        (misbehaving.holds_the_interpreter, "its reader hung and was stopped after"),
        (misbehaving.marks_time, "its reader hung and was stopped after"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
@pytest.mark.skipif(sys.platform == "win32", reason="a crash has another code there")
def test_every_failure_is_one_refusal(
    strict: IsolatedReaders, file: Path, reader: Callable[[Path], None], says: str
) -> None:
    with pytest.raises(FormatError) as refused:
        strict.run(reader, file)
    text = str(refused.value)
    assert text.startswith(f"a file.e57: {says}")
    assert text.endswith("the file is probably damaged: copy or export it again")
    assert strict.run(misbehaving.size_of, file) == 12


@LINUX
def test_a_reader_that_takes_memory_is_refused(file: Path) -> None:
    readers = IsolatedReaders(ReaderLimits(memory_bytes=64 << 20))
    assert readers.run(misbehaving.grows, file, 40) == 1
    with pytest.raises(FormatError, match=r"a file\.e57: it needs more memory than a file of its size may"):
        readers.run(misbehaving.grows, file, 80)
    assert readers.run(misbehaving.grows, file, 40) == 1
    readers.close()


def test_large_files_get_more() -> None:
    limits = ReaderLimits()
    assert limits.memory_for(1 << 20) < 1.1 * 2**30
    assert limits.memory_for(1 << 40) == limits.most_memory_bytes
    assert limits.silence_for(100 << 20) > 2 * limits.silence_for(0)
    assert limits.silence_for(1 << 40) == limits.most_silent_s


@pytest.mark.slow
def test_a_file_that_crashed_is_refused_at_once_until_it_changes(strict: IsolatedReaders, file: Path) -> None:
    for _ in range(2):
        with pytest.raises(FormatError, match="hung"):
            strict.run(misbehaving.sleeps, file)
    process = strict.run(misbehaving.server_id)
    with pytest.raises(FormatError, match="hung"):
        strict.run(misbehaving.sleeps, file)
    assert strict.run(misbehaving.server_id) == process, "it was not read"
    assert strict.run(misbehaving.size_of, file) == 12  # another reader may try
    file.write_bytes(b"it is another file now")
    with pytest.raises(FormatError, match="hung"):
        strict.run(misbehaving.sleeps, file)
    assert strict.run(misbehaving.server_id) != process


@pytest.mark.slow
def test_progress_is_forwarded_and_restarts_the_timeout(file: Path) -> None:
    told: list[Progress] = []
    steps, step_s, silent_s = 8, 0.3, 2.0  # more than the limit in all, and each much less, on a busy machine as well
    readers = IsolatedReaders(ReaderLimits(silent_s=silent_s, silent_s_per_mb=0))
    assert readers.run(misbehaving.goes_on, file, steps, step_s, report=told.append) == steps
    read = [progress for progress in told if progress.total]
    assert {progress.label for progress in read} == {"reading"}
    assert [p.done for p in read] == sorted(p.done for p in read)
    assert len({p.done for p in read}) >= steps / 2
    assert readers.run(misbehaving.goes_on, file, steps, step_s) == steps  # also without a listener
    readers.close()


@pytest.mark.slow
def test_cancelling_ends_the_process_even_without_progress(readers: IsolatedReaders, file: Path) -> None:
    process = readers.run(misbehaving.server_id)
    begun = time.monotonic()

    def report(progress: Progress) -> None:
        if time.monotonic() - begun > 0.1:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        readers.run(misbehaving.holds_the_interpreter, file, report=report)
    if sys.platform != "win32":  # where it would be Ctrl-C
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
    assert readers.run(misbehaving.server_id) != process


@LINUX
def test_every_file_has_a_process_of_its_own(readers: IsolatedReaders, file: Path) -> None:
    server = readers.run(misbehaving.server_id)
    processes = [readers.run(misbehaving.process_id) for _ in range(3)]
    with pytest.raises(FormatError):
        readers.run(misbehaving.refuses, file)
    assert len({server, *processes}) == 4
    assert readers.run(misbehaving.server_id) == server
    assert all(gone(process) for process in processes)
    # What confines a process holds for its threads only if there is one, and forking is safe for the same reason.
    assert len(os.listdir(f"/proc/{server}/task")) == 1


@pytest.mark.slow
@LINUX
def test_where_a_scanner_stood_is_told_to_the_next_reader_of_the_same_files_only(tmp_path: Path) -> None:
    readers = IsolatedReaders()
    files = [tmp_path / name for name in "abc"]
    for path in files:
        path.write_bytes(b"x")
    first, second, other = files
    assert readers.run(misbehaving.learns, first, "aa") == ["aa"]
    assert readers.run(misbehaving.learns, first, "bb") == ["aa", "bb"]
    assert readers.run(misbehaving.learns, other, "cc") == ["cc"]
    assert readers.run(misbehaving.learns, first, "dd", more=[second]) == ["aa", "bb", "dd"]
    first.write_bytes(b"changed")
    assert readers.run(misbehaving.learns, first, "ee") == ["ee"]
    readers.close()


@pytest.mark.skipif(sys.platform == "linux", reason="there every file has a process of its own")
def test_only_a_damaged_file_replaces_the_process(readers: IsolatedReaders, file: Path) -> None:
    first = readers.run(misbehaving.process_id)
    assert readers.run(misbehaving.size_of, file) == 12
    assert readers.run(misbehaving.process_id) == first
    with pytest.raises(FormatError):
        readers.run(misbehaving.refuses, file)
    assert readers.run(misbehaving.process_id) != first


@pytest.mark.slow
@LINUX
def test_a_large_program_does_not_replace_its_readers(checkout: Path) -> None:
    program = (
        "import numpy as np\nheld = np.ones(90_000_000)\n"
        "from ladarreg_core.formats.isolated import IsolatedReaders\nfrom tests.formats import misbehaving\n"
        "readers = IsolatedReaders()\n"
        "assert readers.run(misbehaving.server_id) == readers.run(misbehaving.server_id)\nreaders.close()\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=checkout, check=True, env={**os.environ, "PYTHONPATH": "."})


def test_a_process_that_was_killed_meanwhile_is_replaced(readers: IsolatedReaders) -> None:
    process = readers.run(misbehaving.server_id)
    os.kill(process, signal.SIGTERM)
    assert gone(process)
    assert readers.run(misbehaving.server_id) != process


PARENT = """
import sys
from pathlib import Path
from ladarreg_core.formats.isolated import IsolatedReaders
from tests.formats import misbehaving
readers = IsolatedReaders()
print(readers.run(misbehaving.server_id), flush=True)
if sys.argv[1]:
    readers.run(getattr(misbehaving, sys.argv[1]), Path(__file__ if "__file__" in dir() else sys.argv[2]))
input()
"""


@pytest.mark.slow
@LINUX
@pytest.mark.parametrize("during", ["", "sleeps", "computes", "holds_the_interpreter"])
def test_the_process_ends_with_its_parent(checkout: Path, file: Path, during: str) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, during, str(file)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
    )  # fmt: skip
    assert parent.stdout is not None
    server = int(parent.stdout.readline())
    time.sleep(0.3)
    running = Path(f"/proc/{server}/task/{server}/children").read_text().split()
    assert len(running) == bool(during)
    assert not any(gone(int(process), 0.05) for process in (server, *running))
    parent.kill()
    parent.communicate()
    assert all(gone(int(process)) for process in (server, *running))


@LINUX
def test_the_process_inherits_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LADARREG_TOKEN", "secret-secret")
    with socket.create_server(("127.0.0.1", 0)) as server:
        os.set_inheritable(server.fileno(), True)
        readers = IsolatedReaders()
        kinds = {name.partition(":")[0] for name in readers.run(misbehaving.open_files)}
        names = readers.run(misbehaving.environment)
        readers.close()
    assert "socket" not in kinds
    assert not [name for name in names if name.startswith("LADARREG_")]


# Messages of a compromised process


def message(text: object, rest: bytes = b"") -> io.BytesIO:
    data = json.dumps(text).encode()
    return io.BytesIO(len(data).to_bytes(8, "little") + data + rest)


AZIMUTH = {
    "rows": 2, "columns": 3, "d_azimuth_rad": 0.1, "d_elevation_rad": 0.1,
    "azimuth_offset_rad": 0.0, "elevation_offset_rad": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    "value",
    [
        {"no": "mark"},
        {"#": "Popen", "fields": {}},
        {"#": "array", "dtype": "O", "shape": [1]},
        {"#": "array", "dtype": "f8", "shape": [1 << 40]},
        {"#": "array", "dtype": "f8", "shape": [-1]},
        {"#": "array", "dtype": "f8", "shape": [1.5]},
        {"#": "AzimuthElevation", "fields": {**AZIMUTH, "rows": "2"}},
        {"#": "AzimuthElevation", "fields": {**AZIMUTH, "rows": True}},
        {"#": "AzimuthElevation", "fields": {**AZIMUTH, "d_azimuth_rad": 7}},
        {"#": "AzimuthElevation", "fields": {"rows": 2}},
        {"#": "AzimuthElevation", "fields": {**AZIMUTH, "more": 1}},
        {"#": "Rigid", "fields": {"rotation": 1, "translation": 2}},
        {"#": "TabulatedGrid", "fields": {"table": {"#": "array", "dtype": "f8", "shape": [1, 1, 3]}, "law": None}},
        {"#": "PinholeGrid", "fields": {"camera": {"#": "path", "path": "x"}}},
    ],
    ids=lambda value: json.dumps(value)[:40],
)
def test_messages_of_the_wrong_kind_are_refused(value: Any) -> None:
    with pytest.raises(MessageError):
        read_message(message(value, bytes(24)), largest_bytes=1 << 20)


@LINUX
def test_a_process_cannot_speak_for_the_next_one(readers: IsolatedReaders, file: Path) -> None:
    with pytest.raises(FormatError, match="sent an invalid answer"):
        readers.run(misbehaving.answers_twice, file)
    assert readers.run(misbehaving.size_of, file) == 12


def test_a_turn_ends_where_its_last_piece_says() -> None:
    stream = io.BytesIO()
    for data in (b"of one", b"x" * (3 << 20), b"", b"of another", b""):
        write_piece(stream, data)
    stream.seek(0)
    assert io.BufferedReader(Turn(stream)).read() == b"of one" + b"x" * (3 << 20)
    assert io.BufferedReader(Turn(stream)).read() == b"of another"
    with pytest.raises(EOFError):
        io.BufferedReader(Turn(stream)).read()
    with pytest.raises(ValueError, match="at most"):
        io.BufferedReader(Turn(io.BytesIO(b"\xff" * 100))).read()


def test_messages_that_end_too_soon_are_refused() -> None:
    stream = io.BytesIO()
    write_message(stream, sample_scans()[0])
    whole = stream.getvalue()
    for length in range(0, len(whole), 97):
        with pytest.raises(EOFError):
            read_message(io.BytesIO(whole[:length]), largest_bytes=1 << 20)
    with pytest.raises(MessageError, match="at most"):
        read_message(io.BytesIO(b"\xff" * 100), largest_bytes=1 << 20)
