"""Questions a newcomer asks of the folder tree, each with the files that answer it: all of them exist.

Whether the tree alone leads a reader there is tried by showing a reader the list of files and the questions without
the answers; a rename that moves an answer has to say where it went.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

QUESTIONS: list[dict[str, Any]] = json.loads(Path(__file__).with_name("questions.json").read_text(encoding="utf-8"))


def test_there_are_forty() -> None:
    assert len({entry["question"] for entry in QUESTIONS}) == 40


@pytest.mark.parametrize("entry", QUESTIONS, ids=lambda entry: entry["answers"][0])
def test_the_answers_exist(entry: dict[str, Any], checkout: Path) -> None:
    missing = [name for name in entry["answers"] if not (checkout / name).is_file()]
    assert not missing
