"""The history of a project, and the folder that holds it."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document, PhotoEntry
from ladarreg_core.project.history import History
from ladarreg_core.project.results import pose_entry, registration_of
from ladarreg_core.project.storage.codec import decode_document, encode
from ladarreg_core.project.storage.delta import apply_change, change_between
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.project.stored_arrays import StoredArrays
from testing.scenes.documents import SOURCE, a_document, a_pick, a_result, with_an_answer

WHEN = "2026-01-02T03:04:05+00:00"


def named(document: Document, name: str) -> Document:
    return msgspec.structs.replace(document, name=name)


@given(st.lists(st.sampled_from(["commit", "undo", "redo", "amend"]), max_size=40))
def test_undo_and_redo_walk_along_what_was_committed(moves: list[str]) -> None:
    history = History.begun(Document(name="0"), label="Begin", author="", when=WHEN)
    model, at = ["0"], 0
    for k, move in enumerate(moves, 1):
        if move == "commit":
            history = history.committed(named(history.document, str(k)), label=str(k), author="a", when=WHEN)
            model, at = [*model[: at + 1], str(k)], at + 1
        elif move == "amend":
            history = history.amended(named(history.document, f"{k}!"), when=WHEN)
            model = [*model[:at], f"{k}!"]
        else:
            history = history.moved(-1 if move == "undo" else 1)
            at = min(max(at + (-1 if move == "undo" else 1), 0), len(model) - 1)
        assert [entry.document.name for entry in history.entries] == model
        assert history.document.name == model[at]
        assert (history.undone is None, history.redone is None) == (at == 0, at == len(model) - 1)
        numbers = [entry.number for entry in history.entries]
        assert numbers == sorted(set(numbers))
    assert history.gone_to(history.entries[0].number).at == 0


def test_the_number_of_undo_steps_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg_core.project.history.MAX_STEPS", 5)
    history = History.begun(Document(name="0"), label="Begin", author="", when=WHEN)
    for k in range(1, 9):
        history = history.committed(named(history.document, str(k)), label=str(k), author="a", when=WHEN)
    assert [entry.document.name for entry in history.entries] == ["4", "5", "6", "7", "8"]
    assert history.document.name == "8"
    assert history.moved(-9).undone is None


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None)
@given(
    moves=st.lists(st.sampled_from(["commit", "undo", "redo", "amend", "solve", "settle"]), max_size=12),
    cut=st.integers(0, 60),
)
def test_a_saved_project_survives_a_truncated_history(
    tmp_path_factory: pytest.TempPathFactory, moves: list[str], cut: int
) -> None:
    place = tmp_path_factory.mktemp("project")
    log = place / "history.jsonl"
    folder = ProjectFolder(place)
    history = History.begun(a_document(), label="Begin", author="", when=WHEN)
    folder.begin(history)
    settled, settled_size = history.document, log.stat().st_size
    told = [(log.stat().st_size, history.document)]
    for k, move in enumerate(moves):
        if move in ("undo", "redo"):
            history = history.moved(-1 if move == "undo" else 1)
            folder.save_move(history)
        elif move == "amend":
            history = history.amended(named(history.document, f"{k}!"), when=WHEN)
            folder.save_commit(history, amended=True)
        elif move == "settle":
            folder.settle()
            settled, settled_size = history.document, log.stat().st_size
        else:
            document = with_an_answer(history.document, k) if move == "solve" else named(history.document, str(k))
            history = history.committed(document, label=move, author="a", when=WHEN)
            folder.save_commit(history)
        told.append((log.stat().st_size, history.document))
    folder.close()

    shutil.copytree(place, torn := place.with_name(f"{place.name}-torn"))
    again = ProjectFolder(place)
    read = again.read()
    again.close()
    assert [(e.number, e.label, e.document) for e in read.entries] == [
        (e.number, e.label, e.document) for e in history.entries
    ]
    assert read.at == history.at
    assert reading_of(place) == history.document, "who opens a project leaves its file with what counts"

    whole = (torn / log.name).read_bytes()[: -cut or None]
    (torn / log.name).write_bytes(whole)
    left = [document for size, document in told if size - 1 <= len(whole)]  # only the line's end may be missing
    for _ in range(2):
        folder = ProjectFolder(torn)
        read = folder.read()
        newest = left[-1] if settled_size - 1 <= len(whole) else settled
        assert read.document == newest, "all that was appended whole, and no less"
        assert reading_of(torn) == read.document
        folder.save_commit(read.committed(named(read.document, "after"), label="after", author="", when=WHEN))
        folder.close()
        left, settled_size = [named(read.document, "after")], 0


def test_a_long_history_is_shortened_and_keeps_its_position(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg_core.project.storage.folder._MAX_ENTRIES", 8)
    folder = ProjectFolder(tmp_path / "p")
    history = History.begun(a_document(), label="Begin", author="", when=WHEN)
    folder.begin(history)
    for k in range(12):
        history = history.committed(named(a_document(), str(k)), label=str(k), author="a", when=WHEN)
        folder.save_commit(history)
    folder.close()
    for _ in range(2):
        folder = ProjectFolder(tmp_path / "p")
        read = folder.read()
        folder.close()
        assert [entry.label for entry in read.entries] == ["8", "9", "10", "11"]
        assert read.document == history.document == reading_of(tmp_path / "p")


def reading_of(place: Path) -> Document:
    """Content of project.json."""
    return decode_document(
        (place / "project.json").read_bytes(), lambda name: StoredArrays((place / f"arrays/{name}.npz").read_bytes())
    )


def edited_at_random(document: Document, seed: int) -> Document:
    rng = np.random.default_rng(seed)

    def edit(photo: PhotoEntry) -> PhotoEntry:
        what, ids = rng.integers(6), [pick.id for pick in photo.picks]
        if what == 0 or len(ids) < 2:
            return edits.with_picks(photo, [a_pick(seed + k, str(rng.choice(["point", "line"]))) for k in range(3)])[0]
        some = set(rng.choice(ids, 2))
        if what == 1:
            return edits.without_picks(photo, some)
        if what == 2:
            return edits.switched(photo, {name: bool(rng.integers(2)) for name in some})
        if what == 3:
            return edits.changed_pick(photo, ids[0], {"weight": float(rng.uniform(0.1, 9))})
        if what == 4:
            return msgspec.structs.replace(photo, picks=tuple(rng.permutation(np.array(photo.picks, dtype=object))))
        return edits.with_pose(photo, pose_entry("robust", ANSWERS[seed % 2]))

    what = rng.integers(8)
    if what == 0:
        return edits.with_photo(document, SOURCE)[0] if len(document.photos) < 4 else document
    if what == 1 and len(document.photos) > 1:
        return edits.without_photo(document, document.photos[0].id)
    if what == 2:
        return msgspec.structs.replace(document, settings=document.settings.changed({"seed": seed % 9}))
    return edits.edited_photo(document, str(rng.choice([photo.id for photo in document.photos])), edit)


ANSWERS = [a_result(0), a_result(1)]


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(seeds=st.lists(st.integers(0, 10**6), min_size=1, max_size=12))
def test_a_change_that_was_written_makes_one_document_of_the_other(seeds: list[int]) -> None:
    stored = {entry.arrays.name: entry.arrays for entry in (pose_entry("robust", answer) for answer in ANSWERS)}
    before = mine = a_document()
    for seed in seeds:
        after = edited_at_random(before, seed)
        change = json.loads(encode(change_between(before, after)))
        mine = apply_change(mine, change, stored.__getitem__)
        assert mine == after
        assert (change == {}) == (after == before)
        before = after


def test_a_change_is_small_and_shares_what_stays() -> None:
    before = a_document(200)
    after = edits.edited_photo(before, "p1", lambda p: edits.changed_pick(p, "7", {"photo": ((1.0, 2.0),)}))
    change = change_between(before, after)
    ((name, fields),) = change["photos"]["in"]["p1"]["picks"].pop("in").items()
    assert (name, fields["photo"]) == ("7", ((1.0, 2.0),))
    assert len(encode(change_between(before, after))) < 200
    again = apply_change(before, json.loads(encode(change_between(before, after))), lambda name: StoredArrays(b""))
    assert all(a is b for a, b in zip(before.photos[0].picks, again.photos[0].picks, strict=True) if a.id != "7")


@pytest.mark.parametrize(
    "change",
    [
        7,
        {"name": 3},
        {"photos": []},
        {"photos": {"in": {"p9": {}}}},
        {"photos": {"gone": ["p9"]}},
        {"photos": {"order": ["p1", "p1"]}},
        {"photos": {"order": [[], 1]}},
        {"photos": {"new": [{"id": "p2"}]}},
        {"photos": {"in": {"p1": {"picks": {"in": {"1": {"scan": [[0, 0, 0]]}}}}}}},
        {"photos": {"in": {"p1": {"picks": {"new": [{"id": "x"}]}}}}},
    ],
)
def test_a_damaged_change_is_refused_in_one_line(change: object) -> None:
    with pytest.raises(FormatError) as caught:
        apply_change(a_document(), change, lambda name: StoredArrays(b""))
    assert "\n" not in str(caught.value)


def test_a_folder_has_one_user_at_a_time(tmp_path: Path) -> None:
    first = ProjectFolder(tmp_path / "p")
    with pytest.raises(ExportError, match="open in another program"):
        ProjectFolder(tmp_path / "p")
    first.close()
    ProjectFolder(tmp_path / "p").close()


def _die_holding(place: str, ready: multiprocessing.synchronize.Event) -> None:
    folder = ProjectFolder(place)
    history = History.begun(a_document(), label="Begin", author="", when=WHEN)
    folder.begin(history)
    folder.save_commit(history.committed(named(history.document, "last"), label="Rename", author="", when=WHEN))
    ready.set()
    os.kill(os.getpid(), 9)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no kill -9 to send")
def test_a_folder_is_free_again_and_whole_after_a_crash(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_die_holding, args=(str(tmp_path / "p"), ready))
    process.start()
    process.join(60)
    assert reading_of(tmp_path / "p") == a_document(), "it had no time to settle"
    folder = ProjectFolder(tmp_path / "p")
    assert folder.read().document == named(a_document(), "last")
    folder.close()
    assert reading_of(tmp_path / "p") == named(a_document(), "last")


def test_sources_inside_move_with_the_folder(tmp_path: Path) -> None:
    folder = ProjectFolder(tmp_path / "p")
    assert folder.relative(folder.inputs / "a.png") == "inputs/a.png"
    assert folder.source_path("inputs/a.png") == folder.inputs / "a.png"
    outside = tmp_path / "b.png"
    assert folder.source_path(folder.relative(outside)) == outside
    folder.close()


def test_missing_and_exchanged_arrays_lose_only_their_matches(tmp_path: Path) -> None:
    document = with_an_answer(a_document())
    folder = ProjectFolder(tmp_path / "p")
    folder.begin(History.begun(document, label="Begin", author="", when=WHEN))
    folder.close()
    (stored,) = (tmp_path / "p" / "arrays").iterdir()
    whole = stored.read_bytes()
    stored.write_bytes(b"something else")
    for _ in ("exchanged", "missing"):
        again = ProjectFolder(tmp_path / "p")
        read = again.read()
        assert read.document == document
        with pytest.raises(FormatError, match="solve again"):
            registration_of(read.document.photos[0].poses[0])
        assert [sentence for sentence in again.remarks if "one result" in sentence]
        read = read.committed(named(read.document, "work goes on"), label="Rename", author="", when=WHEN)
        again.save_commit(read)
        again.settle()
        document = read.document
        again.close()
        assert not stored.exists()
        assert stored.with_name(f"{stored.stem}.damaged-1.npz").read_bytes() == b"something else"
    stored.write_bytes(whole)
    again = ProjectFolder(tmp_path / "p")
    assert len(registration_of(again.read().document.photos[0].poses[0]).matches) == 40, "put back, it is found"
    assert again.remarks == ()
    again.close()


def test_undo_steps_over_automatic_results_and_consecutive_ones_replace_each_other(tmp_path: Path) -> None:
    folder = ProjectFolder(tmp_path / "project")
    history = History.begun(a_document(0), label="Begin", author="", when=WHEN)
    folder.begin(history)

    def committed(name: str, *, automatic: bool = False) -> None:
        nonlocal history
        document = msgspec.structs.replace(history.document, name=name)
        amended = automatic and history.present.automatic
        if amended:
            history = history.amended(document, when=WHEN)
        else:
            history = history.committed(document, label=name, author="", when=WHEN, automatic=automatic)
        folder.save_commit(history, amended=amended)

    for name in ("one", "two"):
        committed(name)
        committed(f"{name}, solved", automatic=True)
        committed(f"{name}, verified", automatic=True)
    folder.close()
    folder = ProjectFolder(tmp_path / "project")
    history = folder.read()
    assert [entry.automatic for entry in history.entries] == [False, False, True, False, True]
    assert (history.document.name, history.edit.label) == ("two, verified", "two")
    assert history.undone is not None
    assert history.undone.label == "two"
    back = history.moved(-1)
    assert back.document.name == "one, verified"
    assert back.redone is not None
    assert (back.redone.label, back.moved(1).document.name) == ("two", "two, verified")
    assert history.moved(-9).document.name == "test"
    assert history.moved(-9).undone is None
    assert history.gone_to(history.entries[1].number).document.name == "one, verified"
    assert [entry.label for entry in history.latest_edits(2)] == ["one", "two"]
    folder.close()
