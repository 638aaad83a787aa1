"""Projects with flipped bits, missing files and truncated records: undamaged parts are recovered completely."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import ExportError, FormatError, LadarregError, NewerVersionError
from ladarreg_core.frames import ThesisParameters
from ladarreg_core.matches import Pick
from ladarreg_core.pose.estimate import estimate_pose
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document, PoseEntry
from ladarreg_core.project.history import History
from ladarreg_core.project.results import pose_entry, registration_of
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.folder import ProjectFolder

WHEN = "2026-01-02T03:04:05+00:00"
OLD = Path(__file__).resolve().parents[1] / "unit" / "project" / "without_checksums"
Files = dict[str, bytes]


def named(document: Document, name: str) -> Document:
    return msgspec.structs.replace(document, name=name)


def an_answer(stage: str, seed: int) -> PoseEntry:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(3, 6, 20), rng.uniform(-1.5, 1.5, (20, 2))])
    pose, camera = ThesisParameters(0.5, -0.1, 0.05, 0.1, -0.05, 0.02).pose, Camera.from_focal(640, 480, 600)
    ranges = np.linalg.norm(points, axis=1)
    uv = camera.project(pose @ points) + rng.normal(0, 0.3, (20, 2))
    return pose_entry(stage, estimate_pose(points / ranges[:, None], ranges, uv, camera))  # type: ignore[arg-type]


class Work:
    """A simulated operator of a project."""

    def __init__(self, place: Path) -> None:
        self.folder = ProjectFolder(place)
        document = Document(name="work", scan=Source(path="scan.npz", name="scan.npz", size=9))
        document, _ = edits.with_photo(document, Source(path="photo.png", name="photo.png", size=3))
        self.history = History.begun(document, label="Begin", author="", when=WHEN)
        self.folder.begin(self.history)
        self.passed = [document]

    def commit(self, label: str, edit: Callable[[Document], Document]) -> None:
        self.history = self.history.committed(edit(self.history.document), label=label, author="a", when=WHEN)
        self.folder.save_commit(self.history)
        self.passed.append(self.history.document)

    def draw(self, k: int) -> None:
        pick = Pick("new", "point", np.array([[1.0, k / 20, 0.1]]), np.array([[100.0 + k, 50.0]]))
        self.commit(f"Draw {k}", lambda d: edits.edited_photo(d, "p1", lambda p: edits.with_picks(p, [pick])[0]))

    def solve(self, stage: str, seed: int) -> None:
        found = an_answer(stage, seed)
        self.commit(f"Solve {stage}", lambda d: edits.edited_photo(d, "p1", lambda p: edits.with_pose(p, found)))

    def undo(self) -> None:
        self.history = self.history.moved(-1)
        self.folder.save_move(self.history)
        self.passed.append(self.history.document)


@dataclass(frozen=True)
class Kept:
    """A project on disk, and its state when it was written."""

    files: Files
    history: History
    passed: list[Document]


def files_of(place: Path) -> Files:
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in place.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    place = tmp_path_factory.mktemp("kept") / "p"
    work = Work(place)
    for k in range(4):
        work.draw(k)
    work.solve("linear", 1)
    work.solve("robust", 2)
    work.commit("Rename", lambda d: named(d, "another"))
    work.undo()
    for k in range(4, 7):
        work.draw(k)
    work.undo()
    work.folder.settle()
    work.folder.close()
    return Kept(files_of(place), work.history, work.passed)


def steps(history: History) -> tuple[list[tuple[int, str, Document]], int]:
    return [(entry.number, entry.label, entry.document) for entry in history.entries], history.at


def written(place: Path, files: Files) -> Path:
    shutil.rmtree(place, ignore_errors=True)
    for name, data in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)
    return place


def opened(place: Path) -> tuple[History, tuple[str, ...]]:
    folder = ProjectFolder(place)
    try:
        return folder.read(), folder.remarks
    finally:
        folder.close()


def opened_twice(place: Path) -> tuple[History, tuple[str, ...]]:
    """Open a damaged project twice: by then it is repaired, except for what is lost permanently."""
    history, said = opened(place)
    again, said_again = opened(place)
    assert steps(again) == steps(history)
    assert all("matches" in sentence.lower() for sentence in said_again)
    return history, said


def flipped(data: bytes, index: int, bit: int) -> bytes:
    return data[:index] + bytes([data[index] ^ 1 << bit]) + data[index + 1 :]


def places_to_flip(data: bytes, count: int) -> list[tuple[int, int]]:
    """Bits all over a file, including those at the ends of its lines."""
    rng = random.Random(len(data))
    ends = [index for index, byte in enumerate(data) if byte == ord("\n")]
    indices = {rng.randrange(len(data)) for _ in range(count)} | set(rng.sample(ends, min(len(ends), count // 4)))
    return [(index, rng.randrange(8)) for index in sorted(indices | {0, len(data) - 1})]


def aside(place: Path, name: str) -> list[bytes]:
    path = place / name
    return [found.read_bytes() for found in path.parent.glob(f"{path.stem}.damaged-*{path.suffix}")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["history.jsonl", "project.json"])
def test_a_flipped_bit_loses_nothing(kept: Kept, tmp_path: Path, name: str) -> None:
    for index, bit in places_to_flip(kept.files[name], 60):
        damaged = flipped(kept.files[name], index, bit)
        place = written(tmp_path / "p", kept.files | {name: damaged})
        history, said = opened_twice(place)
        assert steps(history) == steps(kept.history), (index, bit)
        assert said, "it is said"
        assert aside(place, name) == [damaged], "and the damaged file is kept"


def test_a_flipped_bit_in_arrays_loses_only_their_matches(kept: Kept, tmp_path: Path) -> None:
    for name in [name for name in kept.files if name.startswith("arrays/")]:
        for index, bit in places_to_flip(kept.files[name], 8):
            damaged = flipped(kept.files[name], index, bit)
            place = written(tmp_path / "p", kept.files | {name: damaged})
            history, said = opened_twice(place)
            assert_only_lost(history, kept, name)
            assert any("solve again" in sentence for sentence in said)
            assert aside(place, name) == [damaged]


def assert_only_lost(history: History, kept: Kept, name: str) -> None:
    assert steps(history) == steps(kept.history)
    poses = history.document.photos[0].poses
    assert len(poses) == 2
    for pose in poses:
        if name == f"arrays/{pose.arrays.name}.npz":
            with pytest.raises(FormatError, match="missing; solve again"):
                registration_of(pose)
        else:
            assert len(registration_of(pose).matches) == 20


def test_any_single_file_can_be_missing(kept: Kept, tmp_path: Path) -> None:
    for name in kept.files:
        place = written(tmp_path / "p", {other: data for other, data in kept.files.items() if other != name})
        history, said = opened_twice(place)
        assert bool(said) == (name != "lock")
        if name == "history.jsonl":
            assert history.document == kept.history.document
            assert [entry.label for entry in history.entries] == ["Recovered"]
        elif name.startswith("arrays/"):
            assert_only_lost(history, kept, name)
        else:
            assert steps(history) == steps(kept.history)
        assert files_of(place).keys() >= kept.files.keys() - ({name} if name.startswith("arrays/") else set())


@pytest.mark.parametrize("name", ["history.jsonl", "project.json"])
@pytest.mark.parametrize("damage", ["cut to nothing", "cut", "zeros", "a line", "other bytes"])
def test_worse_damage_of_one_file_loses_only_undo_steps(kept: Kept, tmp_path: Path, name: str, damage: str) -> None:
    data = kept.files[name]
    for at in range(0, len(data), max(len(data) // 12, 1)):
        cut = {
            "cut to nothing": b"",
            "cut": data[:at],
            "zeros": data[:at] + bytes(len(data[at : at + 512])) + data[at + 512 :],
            "a line": b"\n".join(line for k, line in enumerate(data.split(b"\n")) if k != 12 * at // len(data)),
            "other bytes": data[:at] + bytes(random.Random(at).randbytes(40)) + data[at + 40 :],
        }[damage]
        place = written(tmp_path / "p", kept.files | {name: cut})
        history, _ = opened_twice(place)
        assert history.document == kept.history.document
        whole = steps(kept.history)[0]
        sound = [entry for entry in steps(history)[0] if entry in whole]
        assert len(sound) >= (len(whole) if name == "project.json" else 0)
        if name == "history.jsonl" and damage == "zeros":
            before = [json.loads(line) for line in data[:at].split(b"\n")[:-1]]
            numbers = {record["commit"]["number"] for record in before if "commit" in record}
            assert [entry for entry in whole if entry[0] in numbers and entry not in sound] == [], "the sound prefix"


def test_records_after_project_json_survive_the_loss_of_earlier_ones(tmp_path: Path) -> None:
    """Records are lost before a kill after which project.json is outdated: it and the records after it are used."""
    work = Work(tmp_path / "work")
    for k in range(6):
        work.draw(k)
    work.folder.settle()
    for k in range(6, 9):
        work.draw(k)
    files = files_of(tmp_path / "work")
    work.folder.close()
    lines = files["history.jsonl"].split(b"\n")
    for first, last in ((2, 4), (5, 8), (0, 7), (7, 9)):
        damaged = b"\n".join(b"#" * len(line) if first <= k < last else line for k, line in enumerate(lines))
        history, _ = opened_twice(written(tmp_path / "p", files | {"history.jsonl": damaged}))
        picks = [pick.photo[0][0] - 100 for pick in history.document.photos[0].picks]
        assert picks == [k for k in range(9) if k < 6 or not first <= k + 2 < last]
    assert json.loads(files["project.json"])["seq"] < json.loads(lines[-2])["seq"]


def test_a_truncated_record_within_the_file_loses_only_itself(kept: Kept, tmp_path: Path) -> None:
    """As left by versions that treated a truncated record as complete when the disk was full."""
    lines = kept.files["history.jsonl"].split(b"\n")
    for torn in range(1, len(lines) - 2):
        joined = [*lines[:torn], lines[torn][: len(lines[torn]) // 2] + lines[torn + 1], *lines[torn + 2 :]]
        history, _ = opened_twice(written(tmp_path / "p", kept.files | {"history.jsonl": b"\n".join(joined)}))
        assert history.document == kept.history.document


def test_two_unreadable_files_are_left_unchanged(kept: Kept, tmp_path: Path) -> None:
    place = written(tmp_path / "p", {**kept.files, "history.jsonl": b"#" * 50, "project.json": b""})
    before = files_of(place)
    with pytest.raises(FormatError, match="both damaged"):
        opened(place)
    assert files_of(place) == before


@pytest.mark.parametrize("name", ["project.json", "history.jsonl"])
def test_a_project_of_a_newer_version_is_refused_and_left_unchanged(kept: Kept, tmp_path: Path, name: str) -> None:
    newer = json.dumps({"version": 2, "name": "newer", "photos": {"of another": "shape"}}).encode()
    line = json.dumps({"commit": {"number": 0, "label": "", "author": "", "when": WHEN}, "document": json.loads(newer)})
    files = {"project.json": newer} if name == "project.json" else {"history.jsonl": line.encode() + b"\n"}
    place = written(tmp_path / "p", files)
    with pytest.raises(NewerVersionError, match="newer version"):
        opened(place)
    assert {name: data for name, data in files_of(place).items() if name != "lock"} == files


@pytest.mark.parametrize("left", ["both", "project.json", "history.jsonl"])
def test_unknown_fields_are_preserved(kept: Kept, tmp_path: Path, left: str) -> None:
    """A version that adds fields without changing the meaning of others."""
    place = written(tmp_path / "p", kept.files)

    def more(fields: dict) -> dict:
        fields |= {"mood": {"good": True}}
        fields["scan"]["colour"] = "red"
        fields["photos"][0]["stars"] = 4
        fields["photos"][0]["picks"][1:2] = [pick | {"by": "hand"} for pick in fields["photos"][0]["picks"][1:2]]
        fields.pop("crc", None)
        return fields

    if left == "history.jsonl":
        first = {"commit": {"number": 0, "label": "Begin", "author": "", "when": WHEN}, "document": {}}
        whole = json.loads(kept.files["project.json"])
        (place / left).write_bytes(json.dumps(first | {"document": more(whole)}).encode() + b"\n")
        (place / "project.json").unlink()
    else:
        (place / "project.json").write_bytes(json.dumps(more(json.loads(kept.files["project.json"]))).encode())
    if left == "project.json":
        (place / "history.jsonl").unlink()
    for name in ("renamed", "again"):
        folder = ProjectFolder(place)
        read = folder.read()
        read = read.committed(named(read.document, name), label="Rename", author="", when=WHEN)
        folder.save_commit(read)
        folder.settle()
        folder.close()
        fields = json.loads((place / "project.json").read_bytes())
        assert (fields["name"], fields["mood"], fields["scan"]["colour"]) == (name, {"good": True}, "red")
        assert (fields["photos"][0]["stars"], fields["photos"][0]["picks"][1]["by"]) == (4, "hand")


def test_a_project_without_checksums_opens_with_its_history(tmp_path: Path) -> None:
    place = shutil.copytree(OLD, tmp_path / "p")
    folder = ProjectFolder(place)
    read = folder.read()
    assert folder.remarks == ()
    assert [entry.label for entry in read.entries] == ["Begin", "Solve", "Draw point 4", "Rename to third"]
    assert (read.at, read.document.name) == (2, "test")
    assert len(registration_of(read.document.photos[0].poses[0]).matches) == 40
    read = read.moved(1)
    folder.save_move(read)
    read = read.committed(named(read.document, "fourth"), label="Rename to fourth", author="", when=WHEN)
    folder.save_commit(read)
    folder.close()
    again, said = opened(place)
    assert steps(again) == steps(read)
    assert said == ()


@pytest.mark.slow
def test_a_project_without_checksums_opens_after_any_flipped_bit(tmp_path: Path) -> None:
    files = files_of(OLD)
    document = opened(shutil.copytree(OLD, tmp_path / "sound"))[0].document
    for name in ("history.jsonl", "project.json"):
        for index, bit in places_to_flip(files[name], 60):
            place = written(tmp_path / "p", files | {name: flipped(files[name], index, bit)})
            try:
                history, _ = opened(place)
            except NewerVersionError:
                assert name == "project.json"
                continue
            assert document in [entry.document for entry in history.entries]
            opened(place)


def test_a_lock_that_was_removed_still_holds(tmp_path: Path) -> None:
    work = Work(tmp_path / "p")
    (tmp_path / "p" / "lock").unlink()
    with pytest.raises(ExportError, match="open in another program"):
        ProjectFolder(tmp_path / "p")
    work.draw(1)
    work.folder.close()
    ProjectFolder(tmp_path / "p").close()


def test_a_removed_or_replaced_history_is_rewritten(tmp_path: Path) -> None:
    work = Work(tmp_path / "p")
    log = tmp_path / "p" / "history.jsonl"
    log.unlink()
    work.draw(1)
    log.unlink()
    log.write_bytes(b"something else")
    work.draw(2)
    log.write_bytes(log.read_bytes()[:40])
    work.draw(3)
    work.folder.close()
    assert b"something else" in aside(tmp_path / "p", "history.jsonl")
    history, said = opened(tmp_path / "p")
    assert steps(history) == steps(work.history)
    assert said == ()


def test_a_folder_without_a_project_is_refused(tmp_path: Path) -> None:
    folder = ProjectFolder(tmp_path / "p")
    assert not folder.begun
    with pytest.raises(LadarregError, match="no project"):
        folder.read()
    folder.close()
