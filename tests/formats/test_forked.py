"""Reads in a process that is forked from a command: the same results, nothing else within reach."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ladarreg_core.formats.isolated import confinement

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="files are read in the command's own process there")
CONFINED = all(state.startswith("yes") for _, state in confinement())
PROGRAM = """
import sys
from pathlib import Path
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.isolated.forked import read_confined
from tests.formats import misbehaving

path = Path(sys.argv[1])
assert read_confined(misbehaving.size_of, path) == 12
assert read_confined(misbehaving.process_id) != read_confined(misbehaving.process_id)
for reader in map(misbehaving.__dict__.__getitem__, ("refuses", "crashes", "exits", "fails", "writes_nonsense")):
    try:
        read_confined(reader, path)
    except FormatError as error:
        print(str(error).partition(";")[0])
print(read_confined(misbehaving.breaks_out, path, 9))
print(len(read_confined(misbehaving.open_files)))
"""


def test_what_takes_a_read_over_can_do_nothing(tmp_path: Path, checkout: Path) -> None:
    path = tmp_path / "a file.e57"
    path.write_bytes(b"nothing much")
    (tmp_path / "neighbour").write_bytes(b"foreign")
    command = [sys.executable, "-c", PROGRAM, str(path)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    *refusals, permitted, files = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert refusals == [
        "a file.e57: it is no good",
        "a file.e57: its reader crashed (Segmentation fault)",
        "a file.e57: its reader ended with code 0x3 and no answer",
        "a file.e57: its reader failed (ZeroDivisionError)",
        "a file.e57: its reader sent an invalid answer",
    ]
    assert permitted == "[]" or not CONFINED
    assert int(files) <= 5  # the null device three times, the pipe, and the one that lists them


@pytest.mark.slow
def test_info_describes_a_strangers_file_in_another_process(tmp_path: Path, checkout: Path) -> None:
    from testing.files.seed_files import write_seeds

    program = "import sys; from ladarreg.cli import main; sys.exit(main(['info', sys.argv[1]]))"
    file = next(seed.file for seed in write_seeds(tmp_path) if seed.format == "NPZ")
    trace = (
        "import os\nimport ladarreg_core.formats.registry as registry\nbefore = registry.describe\n"
        "def describe(*args, **kwargs):\n    assert os.getppid() == int(os.environ['COMMAND'])\n"
        "    return before(*args, **kwargs)\nregistry.describe = describe\nos.environ['COMMAND'] = str(os.getpid())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", trace + program, str(file)], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "NPZ" in done.stdout


def test_with_other_threads_it_is_read_here() -> None:
    from ladarreg_core.formats.isolated.forked import read_confined
    from tests.formats import misbehaving

    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    try:
        assert read_confined(misbehaving.process_id) == os.getpid()
    finally:
        done.set()
        other.join()
