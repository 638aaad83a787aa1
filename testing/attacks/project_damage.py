"""Projects with one flipped bit or one missing file, and their content when they are reopened."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec
from ladarreg.session.session import Session, now
from ladarreg.workbench.launch import open_workbench

from ladarreg_core.errors import FormatError
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Author, History
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.documents import a_pick, with_an_answer

_NEVER_DAMAGED = ("lock",)


@dataclass(frozen=True, slots=True)
class Reference:
    """An intact project and its content."""

    folder: Path
    document: Document
    labels: tuple[str, ...]

    def files(self) -> list[str]:
        """Return the files that may be damaged, relative."""
        found = [path.relative_to(self.folder).as_posix() for path in self.folder.rglob("*") if path.is_file()]
        return sorted(name for name in found if name not in _NEVER_DAMAGED)


@dataclass
class Damaged:
    """Losses beyond the damaged part."""

    what: str
    losses: list[str] = field(default_factory=list)


def make_project(folder: Path, *, picks: int = 20) -> Reference:
    """Write a project with two photographs, matches that were moved, and two results of estimators."""
    kept = ProjectFolder(folder)
    picture = next(sample_folder().glob("photo.*"))
    for name in ("first.png", "second.png"):
        shutil.copy(picture, kept.inputs / name)
    history = History.begun(Document(name="test"), label="Begin", author="", when=now())
    kept.begin(history)
    session = Session(kept, history)

    def commit(label: str, edit: Callable[[Document], Document], merge_key: str = "") -> None:
        session.commit(label, edit, author=Author("Operator 1", "one"), merge_key=merge_key)

    for name in ("first.png", "second.png"):
        source = Source(path=f"inputs/{name}", name=name, size=(kept.inputs / name).stat().st_size)
        commit(f"Open photograph {name}", partial(_with_photo, source=source))
    for k in range(picks):
        photo = session.document.photos[k % 2].id
        commit(f"Draw point {k} of the test", partial(_drawn, photo=photo, k=k))
        if k % 5 == 4:  # a drag, saved as amendments of one step
            for u in range(3):
                commit(f"Move match {k} of the test", partial(_moved, photo=photo, u=float(u)), merge_key=f"{k}")
        if k in (picks // 2, picks - 1):
            commit(f"Solve {k} of the test", partial(with_an_answer, seed=k))
    # The second result replaces the first, whose arrays are only referenced by the history.
    document, labels = session.document, tuple(entry.label for entry in session.history.entries)
    session.close()
    return Reference(folder, document, labels)


def _with_photo(document: Document, *, source: Source) -> Document:
    return edits.with_photo(document, source)[0]


def _drawn(document: Document, *, photo: str, k: int) -> Document:
    return edits.edited_photo(document, photo, lambda entry: edits.with_picks(entry, [a_pick(k)])[0])


def _moved(document: Document, *, photo: str, u: float) -> Document:
    """Return the document with the photograph's last match moved."""
    return edits.edited_photo(
        document, photo, lambda entry: edits.changed_pick(entry, entry.picks[-1].id, {"photo": ((u, 7.0),)})
    )


def flipped(reference: Reference, room: Path, *, seed: str) -> Damaged:
    """Flip one bit of a copy, open it, and return what is missing."""
    rng = random.Random(seed)
    files = reference.files()
    # Most of the bytes are pixels and arrays, but the records matter most.
    name = rng.choice(files if rng.random() < 0.3 else ["history.jsonl", "project.json"])
    data = bytearray((reference.folder / name).read_bytes())
    at, bit = rng.randrange(len(data)), rng.randrange(8)
    data[at] ^= 1 << bit
    before = (reference.folder / name).read_bytes()[:at]

    def damage(copy: Path) -> None:
        (copy / name).write_bytes(data)

    return _opened(reference, room, name, f"bit {bit} of byte {at} of {name}", damage, before, bytes(data))


def missing(reference: Reference, room: Path, name: str, *, emptied: bool = False) -> Damaged:
    """Remove or empty a file of a copy, open it, and return what is missing."""

    def damage(copy: Path) -> None:
        (copy / name).write_bytes(b"") if emptied else (copy / name).unlink()

    return _opened(reference, room, name, f"{name} {'emptied' if emptied else 'missing'}", damage, None, None)


def _opened(
    reference: Reference, room: Path, name: str, what: str, damage: Callable[[Path], None], before: bytes | None,
    bytes_: bytes | None,
) -> Damaged:  # fmt: skip
    found = Damaged(what)
    copy = room / "copy"
    shutil.copytree(reference.folder, copy)
    try:
        damage(copy)
        _compare(reference, copy, name, before, bytes_, found)
    except Exception as error:
        found.losses.append(f"{type(error).__name__}: {str(error)[:200]}")
    finally:
        shutil.rmtree(copy)
    return found


def _compare(
    reference: Reference, copy: Path, name: str, before: bytes | None, bytes_: bytes | None, found: Damaged
) -> None:
    document, labels = _read(copy)
    lost_pose = name.removeprefix("arrays/").removesuffix(".npz") if name.startswith("arrays/") else ""
    expected = _without_pose(reference.document, lost_pose)
    if _without_pose(document, lost_pose) != expected:
        found.losses.append(f"the document is another: {_difference(expected, _without_pose(document, lost_pose))}")
    if name == "history.jsonl":
        whole = () if before is None else _labels_in(before.rpartition(b"\n")[0], reference.labels)
        if labels[: len(whole)] != whole:
            found.losses.append(f"{len(whole)} steps before the damage were sound; {len(labels)} are there")
    elif not lost_pose and labels != reference.labels:
        found.losses.append(f"the history has {len(labels)} of {len(reference.labels)} steps")
    if bytes_ is not None and not any(path.is_file() and path.read_bytes() == bytes_ for path in copy.rglob("*")):
        found.losses.append("the damaged file was overwritten")
    _edit(copy, "after the damage")
    document, labels = _read(copy)
    if document.name != "after the damage":
        found.losses.append("an edit after the damage was lost")
    if _without_pose(msgspec.structs.replace(document, name=expected.name), lost_pose) != expected:
        found.losses.append("the document is another after an edit")


def _read(folder: Path) -> tuple[Document, tuple[str, ...]]:
    kept = ProjectFolder(folder)
    try:
        if not kept.begun:
            raise FormatError("it is taken for a folder without a project")
        history = kept.read()
        return history.document, tuple(entry.label for entry in history.entries)
    finally:
        kept.close()


def _edit(folder: Path, name: str) -> None:
    kept = ProjectFolder(folder)
    try:
        history = kept.read()
        document = msgspec.structs.replace(history.document, name=name)
        kept.save_commit(history.committed(document, label="Rename", author="", when=now()))
        kept.settle()
    finally:
        kept.close()


def opened_by_the_workbench(reference: Reference, room: Path, name: str) -> Document:
    """Return the document that the workbench shows for a copy without a file."""
    copy = room / "copy"
    shutil.copytree(reference.folder, copy)
    (copy / name).unlink()
    bench = open_workbench((), project=copy)
    try:
        return bench.session.document
    finally:
        bench.close()
        shutil.rmtree(copy)


def _without_pose(document: Document, arrays: str) -> Document:
    """Return the document without the result whose arrays have a given name."""
    if not arrays:
        return document
    photos = []
    for photo in document.photos:
        poses = tuple(pose for pose in photo.poses if pose.arrays.name != arrays)
        shown = photo.shown_stage if any(pose.stage == photo.shown_stage for pose in poses) else None
        photos.append(msgspec.structs.replace(photo, poses=poses, shown_stage=shown))
    return msgspec.structs.replace(document, photos=tuple(photos))


def _labels_in(records: bytes, labels: tuple[str, ...]) -> tuple[str, ...]:
    """Return the labels whose records are among these, in order."""
    whole = records.decode("utf-8", "replace")
    return tuple(label for label in labels if f'"{label}"' in whole)


def _difference(wanted: Document, found: Document) -> str:
    names = [name for name in wanted.__struct_fields__ if getattr(wanted, name) != getattr(found, name)]
    picks = [sum(len(photo.picks) for photo in document.photos) for document in (wanted, found)]
    return f"{', '.join(names)}; {picks[1]} of {picks[0]} matches"
