"""The journal of a run: what was recorded is found again, whatever the program was doing when it was killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from ladarreg_core.batches.photos.journal import JOURNAL_FILE, Journal
from ladarreg_core.errors import FormatError, NewerVersionError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    journal = Journal(tmp_path / JOURNAL_FILE)
    assert not journal
    journal.add("done", "a", "key 1", {"accepted": True})
    journal.add("done", "b", "key 1", {"accepted": False, "name": "Größe"})
    journal.add("done", "a", "key 2", {"accepted": False})
    journal.close()
    return tmp_path / JOURNAL_FILE


def test_the_last_record_of_a_task_counts_and_only_with_its_key(path: Path) -> None:
    journal = Journal(path)
    assert journal
    assert journal.find("done", "a", "key 2") == {"accepted": False}
    assert journal.find("done", "a", "key 1") is None
    assert journal.find("alone", "a", "key 2") is None
    assert journal.find("done", "b", "key 1") == {"accepted": False, "name": "Größe"}
    assert journal.names("done") == {"a": "key 2", "b": "key 1"}


def test_wherever_it_is_cut_off_the_lines_before_count_and_more_can_be_added(path: Path) -> None:
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    for length in range(head, len(data), 7):
        path.write_bytes(data[:length])
        journal = Journal(path)
        assert len(journal.names("done")) == min(2, data[head:length].count(b"\n"))
        journal.add("done", "c", "key", {})
        journal.close()
        assert Journal(path).find("done", "c", "key") == {}


def test_a_changed_line_and_what_follows_do_not_count(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b'"Gr', b'"gr'))
    assert Journal(path).names("done") == {"a": "key 1"}


@pytest.mark.parametrize("content", [b"", b"{}\n", b"not JSON\n", b'{"kind": "batch", "version": 1}\n'])
def test_another_file_is_refused_and_stays(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / JOURNAL_FILE
    path.write_bytes(content)
    with pytest.raises(FormatError, match="not the journal"):
        Journal(path)
    assert path.read_bytes() == content


def test_a_newer_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg_core.batches.photos.journal._VERSION", 2)
    Journal(tmp_path / JOURNAL_FILE).close()
    monkeypatch.undo()
    with pytest.raises(NewerVersionError, match="newer version"):
        Journal(tmp_path / JOURNAL_FILE)
