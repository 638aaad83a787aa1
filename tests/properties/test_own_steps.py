"""Undo and redo of one's own steps, in any interleaving of the edits of two people."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.matches import Pick
from ladarreg_core.project import edits, own_steps
from ladarreg_core.project.document import CameraGiven, Document, PoseEntry
from ladarreg_core.project.history import Author, Entry, History
from ladarreg_core.project.inverse import changed_parts, restored
from ladarreg_core.project.source import Source
from ladarreg_core.project.stored_arrays import StoredArrays

WHEN = "2026-01-01T00:00:00+00:00"
PEOPLE = {"ann": Author("Ann", "a"), "ben": Author("Ben", "b")}
EDITS = (
    "draw", "move", "move", "switch", "weight", "remove", "setting", "rename", "photo", "remove photo", "camera",
    "solve", "show", "scan",
)  # fmt: skip
MOVES = st.lists(
    st.tuples(st.sampled_from(sorted(PEOPLE)), st.sampled_from((*EDITS, "undo", "undo", "redo")), st.integers(0, 7)),
    max_size=25,
)


def source(name: str) -> Source:
    return Source(path=name, name=name, size=1)


def begun() -> History:
    document = edits.with_scan(Document(name="office"), source("scan.npz"))
    for name in ("one.png", "two.png"):
        document, _ = edits.with_photo(document, source(name))
    return History.begun(document, label="Begin", author="", when=WHEN)


def pose(stage: str, seed: int) -> PoseEntry:
    zeros = tuple((0.0,) * 6 for _ in range(6))
    return PoseEntry(
        stage=stage, method="m", arrays=StoredArrays.of({"a": np.array([seed])}), camera_from_scanner=zeros, camera={},
        covariance=zeros, chi2_per_dof=None, sigma_px=1.0, sigma_range_m=0.1,
    )  # type: ignore[arg-type] # fmt: skip


def edited(document: Document, what: str, k: int, *, fresh: int) -> Document:
    """Apply one of the edits; `k` chooses among what there is, `fresh` makes values that no other edit makes."""
    if what == "setting":
        return msgspec.structs.replace(document, settings=document.settings.changed({"seed": fresh}))
    if what == "rename":
        return msgspec.structs.replace(document, name=f"name {fresh}")
    if what == "photo":
        return edits.with_photo(document, source(f"{fresh}.png"))[0]
    if what == "scan":
        return edits.with_scan(document, source(f"{fresh}.npz"))
    if not document.photos:
        return document
    photo = document.photos[k % len(document.photos)]
    if what == "remove photo":
        return edits.without_photo(document, photo.id)
    if what == "draw":
        pick = Pick("new", "point", np.array([[1.0, 0.0, fresh / 1e4]]), np.array([[float(fresh), 2.0]]))
        return edits.edited_photo(document, photo.id, lambda p: edits.with_picks(p, [pick])[0])
    if what == "camera":
        return edits.edited_photo(document, photo.id, lambda p: edits.with_camera(p, CameraGiven(focal_px=fresh + 1.0)))
    if what == "solve":
        made = pose(("linear", "robust")[k % 2], fresh)
        return edits.edited_photo(document, photo.id, lambda p: edits.with_pose(p, made))
    if what == "show":
        return edits.edited_photo(document, photo.id, lambda p: edits.with_stage(p, p.poses[k % len(p.poses)].stage))
    chosen = photo.picks[k % len(photo.picks)]
    fields: dict[str, Any] = {
        "move": {"photo": ((float(fresh), 7.0),)},
        "switch": {"on": not chosen.on},
        "weight": {"weight": fresh + 2.0},
        "remove": {},
    }[what]
    if what == "remove":
        return edits.edited_photo(document, photo.id, lambda p: edits.without_picks(p, [chosen.id]))
    return edits.edited_photo(document, photo.id, lambda p: edits.changed_pick(p, chosen.id, fields))


def mine(author: Author) -> own_steps.Mine:
    return lambda entry: entry.by == author.id


def undone(history: History, author: Author, number: int | None = None) -> History:
    return own_steps.undone(history, mine(author), author, when=WHEN, number=number)


def redone(history: History, author: Author) -> History:
    return own_steps.redone(history, mine(author), author, when=WHEN)


def step(history: History, author: Author, what: str, k: int) -> History:
    """Make one move; what is refused changes nothing."""
    try:
        if what == "undo":
            return undone(history, author)
        if what == "redo":
            return redone(history, author)
        document = edited(history.document, what, k, fresh=history.next_number)
    except (LadarregError, ZeroDivisionError):
        return history
    if document == history.document:
        return history
    return history.committed(document, label=f"{what} {k}", author=author.name, by=author.id, when=WHEN)


def effects(entry: Entry, before: Entry) -> set[Any]:
    return set(changed_parts(before.document, entry.document))


@given(MOVES)
def test_an_undo_changes_what_ones_own_step_had_changed_and_nothing_else(moves: list[tuple[str, str, int]]) -> None:
    history = begun()
    for who, what, k in moves:
        author, before = PEOPLE[who], history
        history = step(history, author, what, k)
        if what not in ("undo", "redo") or history is before:
            continue
        target = (own_steps.undoable if what == "undo" else own_steps.redoable)(before, mine(author))
        assert target is not None
        assert target.by == author.id
        index = before.entries.index(target)
        touched = changed_parts(before.entries[index - 1].document, target.document)
        done = changed_parts(before.document, history.document)
        assert {part: (new, old) for part, (old, new) in touched.items()} == done, "exactly the inverse"


@given(MOVES)
def test_what_a_colleague_did_last_is_never_taken_back(moves: list[tuple[str, str, int]]) -> None:
    history = begun()
    last: dict[Any, str] = {}
    for who, what, k in moves:
        before = history
        history = step(history, PEOPLE[who], what, k)
        if history is before:
            continue
        for part in effects(history.present, before.present):
            if what in ("undo", "redo"):
                assert last[part] == PEOPLE[who].id
            last[part] = PEOPLE[who].id


@given(MOVES, st.sampled_from(sorted(PEOPLE)), st.integers(1, 6))
def test_undo_then_redo_is_the_identity(moves: list[tuple[str, str, int]], who: str, count: int) -> None:
    history, author = begun(), PEOPLE[who]
    for other, what, k in moves:
        history = step(history, PEOPLE[other], what, k)
    documents = [history.document]
    for _ in range(count):
        before, history = history, step(history, author, "undo", 0)
        if history is before:
            break
        documents.append(history.document)
    for document in reversed(documents[:-1]):
        history = redone(history, author)
        assert history.document == document


@given(MOVES)
def test_a_person_who_is_alone_can_undo_everything(moves: list[tuple[str, str, int]]) -> None:
    history, author = begun(), PEOPLE["ann"]
    first = history.document
    for _, what, k in moves:
        history = step(history, author, what, k)
    while own_steps.undoable(history, mine(author)):
        history = undone(history, author)
    assert not changed_parts(first, history.document)


@given(MOVES)
def test_the_inverse_of_an_edit_is_the_document_before_it(moves: list[tuple[str, str, int]]) -> None:
    history = begun()
    for who, what, k in moves:
        before = history.document
        history = step(history, PEOPLE[who], what, k)
        back = restored(history.document, before, history.document)
        assert not changed_parts(before, back)
        assert [photo.id for photo in back.photos] == [photo.id for photo in before.photos]
        for was, now in zip(before.photos, back.photos, strict=True):
            assert now.picks == was.picks, "in their order, too"
            assert now.poses == was.poses


def test_a_conflict_names_who_changed_what() -> None:
    ann, ben = PEOPLE["ann"], PEOPLE["ben"]
    history = step(begun(), ann, "draw", 0)
    history = step(history, ben, "move", 0)
    with pytest.raises(OptionError) as refusal:
        undone(history, ann)
    assert str(refusal.value) == (
        "Ben changed match 1 since ('move 0', 00:00:00), so 'draw 0' cannot be undone by itself; open History to go"
        " back before both"
    )
    history = undone(history, ben)
    history = undone(history, ann)
    assert history.present.label == "Undo draw 0"
    assert history.document.photos[0].picks == ()
    history = redone(history, ann)
    assert (history.present.label, own_steps.plain_label(history.present)) == ("Redo draw 0", "draw 0")


def test_a_step_is_undone_by_its_number_once() -> None:
    ann = PEOPLE["ann"]
    history = step(step(begun(), ann, "draw", 0), ann, "rename", 0)
    history = undone(history, ann, number=1)
    assert (history.document.name, history.document.photos[0].picks) == ("name 2", ())
    with pytest.raises(OptionError, match="undone already"):
        undone(history, ann, number=1)
    with pytest.raises(OptionError, match="not one of yours"):
        undone(history, PEOPLE["ben"], number=2)
    history = undone(history, ann)
    assert history.document.name == "office"


def test_matches_return_to_their_place() -> None:
    ann, ben = PEOPLE["ann"], PEOPLE["ben"]
    history = begun()
    for _ in range(3):
        history = step(history, ann, "draw", 0)
    history = step(history, ann, "remove", 4)
    history = step(history, ben, "draw", 0)
    assert [pick.id for pick in history.document.photos[0].picks] == ["1", "3", "4"]
    history = undone(history, ann)
    assert [pick.id for pick in history.document.photos[0].picks] == ["1", "2", "3", "4"]
