"""Work on folders that is made to fail: a save, an export, a zip, results, a copy of a project, and runs.

Each case prepares a folder, does its work there in a process of its own, and says what is wrong with what is left.
"""

from __future__ import annotations

import json
import math
import shutil
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.acquisition.composition.panorama import add_to_run, compose
from ladarreg_core.acquisition.devices.folder_source import FolderSource
from ladarreg_core.acquisition.interfaces import PanTilt, UnitIdentity
from ladarreg_core.acquisition.plan import Axis, CameraPlan, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runs.runner import PieceKept, Run, RunEvent
from ladarreg_core.acquisition.simulated.world import FRAME_MOUNT
from ladarreg_core.errors import LadarregError
from ladarreg_core.export.json import registration_document, write_result
from ladarreg_core.export.outputs.integrity import check_integrity
from ladarreg_core.export.targets.folder import check_folder, export_registration, write_folder
from ladarreg_core.export.targets.zip_file import write_zip
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import NOBODY, History
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.duplicate import duplicate_project
from ladarreg_core.project.storage.folder import ProjectFolder, is_project
from ladarreg_core.storage.manifest import read_manifest
from testing.attacks.drawing import WHEN, draw
from testing.devices.simulated_clock import SimulatedClock
from testing.scenes.documents import with_an_answer
from testing.scenes.small_registration import sample_photo, sample_registration, sample_scan

Tell = Callable[[int], None]
"""Receives the number of the last edit, photograph or piece that was confirmed."""


@dataclass(frozen=True, slots=True)
class Case:
    """Work on a folder."""

    name: str
    prepare: Callable[[Path, Path], None]
    """Makes the folder before the work, and another one for what the work reads."""
    work: Callable[[Path, Path, Tell], None]
    """Does the work; raises what it raises."""
    fault: Callable[[Path, int, bool], str]
    """Says what is wrong with a folder, given how many things were confirmed and whether the work was done; it may
    recover what an interruption left, as the next program does."""
    starts_threads: bool = False
    """Whether memory is limited only after the first confirmation: Python waits for ever for a thread that finds no
    memory when it starts."""


# -- a project


def _save(room: Path, beside: Path, tell: Tell) -> None:
    from ladarreg.session.session import Session

    session: Session | None = None
    folder = ProjectFolder(room / "project")
    try:
        history = folder.read() if folder.begun else History.begun(Document(name="w"), label="B", author="", when=WHEN)
        if not folder.begun:
            folder.begin(history)
        session = Session(folder, history)
        tell(6 if session.document.photos else 0)
        picture = folder.inputs / "photo.png"
        if not session.document.photos:
            shutil.copyfile(beside / "photo.png", picture)  # as an upload
            source = Source(path="inputs/photo.png", name="photo.png", size=picture.stat().st_size)
            session.commit("Open", lambda d: edits.with_photo(d, source)[0], author=NOBODY)
        first = len(session.document.photos[0].picks)
        for k in range(first, first + 5):
            if draw(session, k):
                tell(k + 1)
        session.commit("Solve", lambda d: with_an_answer(d, seed=1), author=NOBODY)
        if draw(session, first + 5):
            tell(first + 6)
    finally:
        if session is not None:
            session._elsewhere = ()
            session.close()
        else:
            folder.close()


def _project_before(room: Path, beside: Path) -> None:
    beside.mkdir()
    (beside / "photo.png").write_bytes(b"a photograph " * 400)
    _save(room, beside, lambda done: None)


def _project_fault(room: Path, confirmed: int, done: bool) -> str:
    return _fault_of_project(room / "project", max(confirmed, 6), 12 if done else None)


def _fault_of_project(place: Path, least: int, exactly: int | None) -> str:
    folder = ProjectFolder(place)
    try:
        document = folder.read().document
    except LadarregError as error:
        return f"the project cannot be read: {error}"
    finally:
        folder.close()
    numbers = [round(pick.photo[0][0]) - 100 for photo in document.photos[:1] for pick in photo.picks]
    if numbers != list(range(len(numbers))):
        return f"edits are missing in between: {numbers}"
    if len(numbers) < least or (exactly is not None and len(numbers) != exactly):
        return f"{len(numbers)} edits, of {least} that were confirmed"
    for photo in document.photos:
        file = place / photo.source.path
        if not file.is_file() or file.stat().st_size != photo.source.size or not file.read_bytes().startswith(b"a ph"):
            return "the photograph is not what was opened"
        if any(pose.arrays.lost for pose in photo.poses):
            return "the arrays of a pose are lost"
    return ""


def _new_project_fault(room: Path, confirmed: int, done: bool) -> str:
    if not confirmed and not is_project(room / "project"):
        return ""
    return _fault_of_project(room / "project", confirmed, 6 if done else None)


def _photo_only(room: Path, beside: Path) -> None:
    room.mkdir(parents=True, exist_ok=True)
    beside.mkdir()
    (beside / "photo.png").write_bytes(b"a photograph " * 400)


def _duplicate(room: Path, beside: Path, tell: Tell) -> None:
    folder = ProjectFolder(room / "project")
    try:
        duplicate_project(folder, folder.read(), room / "copies" / "copy", name="copy", when=WHEN)
    finally:
        folder.close()


def _duplicate_fault(room: Path, confirmed: int, done: bool) -> str:
    if found := _fault_of_project(room / "project", 6, 6):
        return f"the original: {found}"
    copy = room / "copies" / "copy"
    if not done and not is_project(copy):
        return ""
    found = _fault_of_project(copy, 6, 6)
    return f"the copy: {found}" if found and done else ""  # what was not confirmed is removed by hand


# -- exports

_PARTS = ("registered.png", "labels.png", "model.glb")


def _files(generation: int) -> list[tuple[str, Callable[[Path], None]]]:
    described = registration_document(sample_registration())

    def part(path: Path) -> None:
        path.write_text(str(generation) * 5000)

    return [
        ("registration.json", lambda path: write_result(path, {**described, "seed": generation})),
        *((name, part) for name in _PARTS),
    ]


def _export_before(room: Path, beside: Path) -> None:
    room.mkdir(parents=True)
    write_folder(room / "out", lambda: _files(1))


def _export(room: Path, beside: Path, tell: Tell) -> None:
    write_folder(room / "out", lambda: _files(2), force=True)


def _new_export(room: Path, beside: Path, tell: Tell) -> None:
    write_folder(room / "deep" / "out", lambda: _files(2))


def _export_fault(room: Path, confirmed: int, done: bool) -> str:
    check_folder(room / "beside")  # as the next export there
    return _fault_of_export(room / "out", {2} if done else {1, 2})


def _new_export_fault(room: Path, confirmed: int, done: bool) -> str:
    if (room / "deep").is_dir():
        check_folder(room / "deep" / "beside")
    out = room / "deep" / "out"
    return "" if not done and not out.exists() else _fault_of_export(out, {2})


def _fault_of_export(out: Path, generations: set[int]) -> str:
    if not out.is_dir():
        return "there are no results"
    with suppress(LadarregError, OSError, ValueError):
        if check_integrity(out).damaged:
            return f"damaged: {check_integrity(out).damaged}"
        found = {json.loads((out / "registration.json").read_text())["seed"]}
        found |= {int((out / name).read_text()[0]) for name in _PARTS}
        listed = read_manifest(out) or {}
        if {*listed} != {"registration.json", *_PARTS}:
            return f"the manifest lists {sorted(listed)}"
        return "" if len(found) == 1 and found <= generations else f"of {found} in place of {generations}"
    return "the results cannot be read"


def _zip_before(room: Path, beside: Path) -> None:
    room.mkdir(parents=True)
    write_zip(room / "p1.zip", lambda: _files(1))


def _zip(room: Path, beside: Path, tell: Tell) -> None:
    write_zip(room / "p1.zip", lambda: _files(2))


def _zip_fault(room: Path, confirmed: int, done: bool) -> str:
    try:
        with zipfile.ZipFile(room / "p1.zip") as file:
            if file.testzip() is not None:
                return "damaged"
            generations = {json.loads(file.read("registration.json"))["seed"]}
            generations |= {int(file.read(name)[:1]) for name in _PARTS}
    except (OSError, zipfile.BadZipFile, KeyError, ValueError) as error:
        return f"no zip: {error}"
    return "" if generations in ([{2}] if done else [{1}, {2}]) else f"of {generations}"


def _results_before(room: Path, beside: Path) -> None:
    room.mkdir(parents=True)
    export_registration(room / "out", sample_registration(accepted=False), sample_scan(), sample_photo())


def _results(room: Path, beside: Path, tell: Tell) -> None:
    export_registration(room / "out", sample_registration(), sample_scan(), sample_photo(), force=True)


def _results_fault(room: Path, confirmed: int, done: bool) -> str:
    check_folder(room / "beside")
    out = room / "out"
    try:
        if check_integrity(out).damaged:
            return f"damaged: {check_integrity(out).damaged}"
        names = {path.name for path in out.iterdir()}
        accepted = json.loads((out / "registration.json").read_text())["accepted"]
    except (LadarregError, OSError, ValueError) as error:
        return f"the results cannot be read: {error}"
    if done and not accepted:
        return "the old results are there after the new ones were confirmed"
    return "" if ("model.glb" in names) == accepted == ("rejected_overlay.png" not in names) else f"a mixture: {names}"


# -- runs

_STOPS = 3


class _Unit:
    """A unit that is where it is sent, and has a scanner and a camera that write into the watched folders."""

    identity = UnitIdentity(
        "simulated", PanTilt(1e-4, 1e-4), PanTilt(-math.pi, -1.0), PanTilt(math.pi, 1.0), PanTilt(1.0, 1.0)
    )

    def __init__(self, beside: Path) -> None:
        self._beside, self._at = beside, PanTilt(0.0, 0.0)

    def position(self) -> PanTilt:
        return self._at

    def move_to(self, target: PanTilt, *, check: Callable[[], None]) -> PanTilt:
        self._at = target
        return target

    def shoot(self) -> None:
        number = 1 + len(list((self._beside / "scans").iterdir()))
        shutil.copyfile(self._beside / "seed.npz", self._beside / "scans" / f"scan-{number}.npz")
        picture = self._beside / "photos" / f"photo-{number}.png"
        picture.write_bytes(b"a photograph " * 300 + b"%d" % number)

    def supply(self) -> dict[str, float]:
        return {}

    def halt(self) -> None:
        pass

    def require_present(self) -> None:
        pass


class _Shots(FolderSource):
    """A watched folder into which a measurement comes as soon as one is awaited."""

    unit: _Unit | None = None

    def next_file(self, folder: Path, *, check: Callable[[], None]) -> Path:
        if self.unit is not None:
            self.unit.shoot()
        return super().next_file(folder, check=check)


def a_plan(beside: Path, first_deg: float) -> Plan:
    """Return the plan of a run that begins at an angle and watches folders."""
    return Plan(
        UnitPlan("none"), ScannerPlan("folder", folder=str(beside / "scans"), timeout_s=60), "mosaic",
        Axis(first_deg, first_deg + 20, 10), Axis(0, 0, 0), mount=FRAME_MOUNT, settle_s=0.0,
        camera=CameraPlan(folder=str(beside / "photos")),
    )  # fmt: skip


def _acquire(room: Path, beside: Path, tell: Tell, first_deg: float, *, force: bool) -> None:
    plan, clock, unit = a_plan(beside, first_deg), SimulatedClock(), _Unit(beside)
    watched = {
        name: _Shots(beside / name, is_readable=lambda path: None, timeout_s=60.0, device=name, clock=clock)
        for name in ("scans", "photos")
    }
    watched["scans"].unit = unit  # both come with the scan

    def see(event: RunEvent) -> None:
        if isinstance(event, PieceKept):
            tell(event.done)

    folder = RunWriter.begin(room / "run", plan, force=force)
    try:
        Run(
            plan,
            folder,
            unit=unit,
            frames=watched["scans"],
            camera=watched["photos"],
            report=see,
            clock=clock,  # type: ignore[arg-type]
        ).go()
    finally:
        folder.close()
    add_to_run(room / "run", compose(room / "run"))


def _run_inputs(room: Path, beside: Path) -> None:
    room.mkdir(parents=True, exist_ok=True)
    beside.mkdir()
    for name in ("scans", "photos"):
        (beside / name).mkdir()
    write_npz_xyz(beside / "seed.npz", sample_scan())


def _run_before(room: Path, beside: Path) -> None:
    _run_inputs(room, beside)
    _acquire(room, beside, lambda done: None, -10, force=False)


def _run_anew(room: Path, beside: Path, tell: Tell) -> None:
    _acquire(room, beside, tell, 0, force=True)


def _run_first(room: Path, beside: Path, tell: Tell) -> None:
    _acquire(room, beside, tell, 0, force=False)


def _run_anew_fault(room: Path, confirmed: int, done: bool) -> str:
    folder = room / "run"
    try:
        found = RunFolder.open(folder)
    except LadarregError as error:
        return f"the run cannot be read: {error}"
    if found.plan.pan.first_deg == -10:
        return _fault_of_run(folder, _STOPS, done=True) if not confirmed and not done else "it is the old run"
    if wrong := _fault_of_run(folder, confirmed, done=done):
        return wrong
    earlier = [*folder.glob(".earlier-run-*")]
    if found.complete:  # then the earlier one is removed; what cannot be removed goes after the next run
        return ""
    for old in earlier:
        if wrong := _fault_of_run(old, _STOPS, done=True):
            return f"the earlier run: {wrong}"
    return "" if earlier else "the earlier run is gone"


def _run_first_fault(room: Path, confirmed: int, done: bool) -> str:
    if not confirmed and not done and not (room / "run" / "plan.json").is_file():
        begun = [path.name for path in (room / "run").iterdir()] if (room / "run").is_dir() else []
        return "" if not [name for name in begun if not name.startswith(".")] else f"only {begun}"
    return _fault_of_run(room / "run", confirmed, done=done)


def _fault_of_run(folder: Path, confirmed: int, *, done: bool) -> str:
    try:
        run = RunFolder.open(folder)
    except LadarregError as error:
        return f"the run cannot be read: {error}"
    if run.faults:
        return "; ".join(run.faults)
    if len(run.records) < confirmed:
        return f"{len(run.records)} pieces of {confirmed} that were confirmed"
    for index, record in run.records.items():
        try:
            run.piece(index)
        except LadarregError as error:
            return f"piece {index}: {error}"
        photo = folder / str(record.photo)
        if not photo.is_file() or not photo.read_bytes().startswith(b"a photograph"):
            return f"the photograph of piece {index} is not what was taken"
    listed = read_manifest(folder) or {}
    for name, one in listed.items():
        if wrong := one.fault(folder):
            return f"{name} {wrong}"
    there = {name for name in ("scan.npz", "panorama.json", "provenance.png") if (folder / name).exists()}
    if (there and there != {"scan.npz", "panorama.json", "provenance.png"}) or not there <= {*listed}:
        return f"of the panorama there is {sorted(there)}, listed is {sorted(listed)}"
    if done and (not there or not run.complete):
        return "the run is not complete"
    return ""


def _compose_again(room: Path, beside: Path, tell: Tell) -> None:
    add_to_run(room / "run", compose(room / "run"))


def _composed_fault(room: Path, confirmed: int, done: bool) -> str:
    return _fault_of_run(room / "run", _STOPS, done=True)


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("save", _project_before, _save, _project_fault, starts_threads=True),
        Case("first save", _photo_only, _save, _new_project_fault, starts_threads=True),
        Case("copy", _project_before, _duplicate, _duplicate_fault),
        Case("export", _export_before, _export, _export_fault),
        Case("first export", lambda room, beside: room.mkdir(parents=True), _new_export, _new_export_fault),
        Case("zip", _zip_before, _zip, _zip_fault),
        Case("results", _results_before, _results, _results_fault),
        Case("run", _run_inputs, _run_first, _run_first_fault),
        Case("run again", _run_before, _run_anew, _run_anew_fault),
        Case("panorama", _run_before, _compose_again, _composed_fault),
    )
}
"""All cases by their names."""
