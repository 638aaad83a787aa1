"""Commands with `--force` on folders with foreign files, which must be there afterwards, as they were."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.acquisition.plan import write_plan
from ladarreg_core.export.targets.folder import export_registration, write_folder
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import MANIFEST_FILE
from testing.attacks.fault_cases import CASES, a_plan
from testing.scenes.small_registration import sample_photo, sample_registration, sample_scan

_NAMES = (
    "holiday.jpg", "model.glb", "cloud.ply", "scan.npz", "photos/holiday.jpg", "pieces/holiday.npz", "report.html",
    "notes/deep/mine.txt", "registered.png", "mine.html", "ply/mine.ply", "stray/000/mine", ".hidden", "export.json",
    "truth.json",
)  # fmt: skip
_PAGES = ("mine.html", "mine.html", "report.html", "notes.html")


@dataclass
class Forced:
    """What came of some runs."""

    runs: int = 0
    refused: int = 0
    """Refused because of the foreign files."""
    others: int = 0
    """Ended for another reason, such as a device that is not there."""
    replaced: int = 0
    """Replaced the command's own results."""
    lost: list[str] = field(default_factory=list)
    """Foreign files that are gone, or were changed."""


def _results(out: Path) -> None:
    export_registration(out, sample_registration(), sample_scan(), sample_photo())


def _one_document(out: Path, name: str, **fields: object) -> None:
    text = json.dumps({"version": 1, "software": {"name": "ladarreg", "version": "1"}, **fields})
    write_folder(out, lambda: [(name, lambda path: _write(path, text))])


def _write(path: Path, text: str) -> None:
    path.write_text(text)


def _simulated(out: Path) -> None:
    assert _run(["simulate", "boxes", "-o", out, "--seed", "1"]) == ExitCode.ACCEPTED


def _run_of_devices(out: Path) -> None:
    case = CASES["run again"]
    with tempfile.TemporaryDirectory(prefix="forced-run-") as name:
        case.prepare(Path(name, "room"), Path(name, "beside"))
        shutil.move(Path(name, "room", "run"), out)


def _registered(out: Path) -> None:
    assert _run(["register", _SCAN, _PHOTO, "--camera", _CAMERA, "-o", out]) == ExitCode.ACCEPTED
    shutil.copy(out / "report.html", out / "mine.html")


_SCAN, _PHOTO, _CAMERA = (str(sample_folder() / name) for name in ("scan.npz", "photo.png", "camera.json"))
COMMANDS: dict[str, tuple[Callable[[Path], None], Callable[[Path, Path], list[object]]]] = {
    "register": (_results, lambda out, beside: ["register", _SCAN, _PHOTO, "--camera", _CAMERA, "-o", out]),
    "apply": (
        _results,
        lambda out, beside: ["apply", _SCAN, _PHOTO, "--pose", beside / "pose.json", "--camera", _CAMERA, "-o", out],
    ),
    "compare": (
        lambda out: _one_document(
            out, "comparison.json", columns=[], inputs=[], camera_from_scanner_is="maps scanner points"
        ),
        lambda out, beside: ["compare", _SCAN, _PHOTO, "--camera", _CAMERA, "-o", out],
    ),
    "export": (
        lambda out: _one_document(out, "export.json", kind="export", files=[]),
        lambda out, beside: ["export", beside / "results", "--to", "report", "-o", out],
    ),
    "report": (
        _registered, lambda out, beside: ["report", out, "--inputs", sample_folder(), "-o", out / "mine.html"]
    ),
    "simulate": (_simulated, lambda out, beside: ["simulate", "boxes", "-o", out, "--seed", "2"]),
    "panorama": (
        lambda out: _one_document(out, "panorama.json", kind="panorama"),
        lambda out, beside: ["panorama", beside / "run", "-o", out],
    ),
    "register-scans": (
        lambda out: _one_document(out, "stations.json", kind="stations", stations=[]),
        lambda out, beside: ["register-scans", _SCAN, _SCAN, "-o", out],
    ),
    "acquire": (_run_of_devices, lambda out, beside: ["acquire", beside / "plan.json", "-o", out]),
}  # fmt: skip
"""Each command with `--force`: what makes its results, and its arguments."""


def forced_runs(command: str, times: int, *, seed: int = 0) -> Forced:
    """Run a command with `--force` on its own results, each time beside other foreign files.

    Args:
        command: one of `COMMANDS`.
        times: how often.
        seed: of the foreign files.
    """
    rng, found = random.Random(f"{command} {seed}"), Forced()
    made, words = COMMANDS[command]
    with tempfile.TemporaryDirectory(prefix="forced-") as name:
        place = Path(os.path.realpath(name))
        beside = place / "beside"
        beside.mkdir()
        (beside / "pose.json").write_text('{"camera_from_scanner": [[0,-1,0,0],[0,0,-1,0],[1,0,0,0],[0,0,0,1]]}')
        for watched in ("scans", "photos"):
            (beside / watched).mkdir()
        write_plan(beside / "plan.json", a_plan(beside, 5))
        _results(beside / "results")
        _run_of_devices(beside / "run")
        made(place / "before")
        for _ in range(times):
            out = place / "out"
            shutil.copytree(place / "before", out, symlinks=True)
            foreign = _disturbed(out, rng, place, _PAGES if command == "report" else _NAMES)
            said = io.StringIO()
            code = _run([*words(out, beside), "--force"], said)
            done, refused = code in (ExitCode.ACCEPTED, ExitCode.NOT_ACCEPTED), "replaced" in said.getvalue()
            found.runs += 1
            found.refused += refused and not done
            found.replaced += done
            found.others += not done and not refused
            for path, content in foreign.items():
                if _content(out / path) != content:
                    found.lost.append(f"{command}: {path}, with {code}")
            shutil.rmtree(out)
    return found


def _disturbed(out: Path, rng: random.Random, place: Path, names: Sequence[str]) -> dict[str, bytes]:
    """Add files, change some of the program's, or both; return what must be there afterwards, by name."""
    ours = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    foreign: dict[str, bytes] = {}
    for _ in range(rng.randrange(1, 3)):
        what = rng.choice(("add", "add", "change", "link", "forge"))
        if what == "change":
            path = out / rng.choice([name for name in ours if name != MANIFEST_FILE])
            content = bytearray(path.read_bytes() or b"-")
            content[rng.randrange(len(content))] ^= 1
            path.write_bytes(content)
        else:
            path = out / rng.choice(names)
            path.unlink(missing_ok=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            if what == "link":
                (place / "elsewhere").write_bytes(b"a holiday")
                path.symlink_to(place / "elsewhere")
            else:
                path.write_bytes(b"a holiday" * rng.randrange(1, 9))
        if what == "forge" and (out / MANIFEST_FILE).is_file():
            text = (out / MANIFEST_FILE).read_text()
            (out / MANIFEST_FILE).write_text(text.replace('"files": [', f'"files": [{{"name": "{path.name}"}},', 1))
        names_so_far = {*foreign, path.relative_to(out).as_posix()}
        foreign = {name: _content(out / name) for name in names_so_far}
    return foreign


def _content(path: Path) -> bytes:
    if path.is_symlink():
        return b"-> " + os.fsencode(os.readlink(path)) + b": " + path.read_bytes()
    return path.read_bytes() if path.is_file() else b"nothing"


def _run(words: list[object], said: io.StringIO | None = None) -> int:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said or io.StringIO()):
        try:
            return main([str(word) for word in words])
        except SystemExit as stop:
            return int(stop.code or 0)
