"""Errors about a file that is none of ours do not show what it says: a project may name any file as a camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from ladarreg_core.acquisition.plan_reading import read_plan
from ladarreg_core.acquisition.runs.piece_list import read_piece_list
from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import describe, read_photo, read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.formats.documents.pose_file import read_initial
from ladarreg_core.formats.documents.rig_file import read_rig_table
from testing.files.small_scans import make_scan

READERS: dict[str, Callable[[Path], object]] = {
    "scan": read_scan,
    "photo": read_photo,
    "anything": describe,
    "camera": read_camera,
    "matches": lambda path: read_matches(path, make_scan()),
    "pose": lambda path: read_initial(path, None),
    "rig": read_rig_table,
    "pieces": read_piece_list,
    "plan": read_plan,
}


@pytest.mark.parametrize("reader", READERS)
def test_no_word_of_a_foreign_file_is_shown(tmp_path: Path, reader: str) -> None:
    for text in (
        "root:x:0:0:hunter2:/root:/bin/sh\n", "PASSWORD=hunter2\nB=1\n", "password: hunter2\nother: 1\n", "hunter2\n",
        "hunter2 1 2 3\n", "127.0.0.1 hunter2\n::1 x\n", "[hunter2]\nuser = hunter2\n", "# hunter2\n# x\n1 hunter2\n",
        "-----BEGIN hunter2-----\nhunter2\n", "hunter2,b,c\n1,2,3\n", "5 5 hunter2\n1 2 3\n", '["hunter2"]',
        '{"password": "hunter2"}', '{"a": hunter2', "<hunter2>hunter2</hunter2>", "%YAML 1.0\npassword: hunter2\n",
        "a: &hunter2 b\nkey: *hunter2\n", "key: [1, 2] hunter2\n", "\0\1hunter2\0",
    ):  # fmt: skip
        for ending in ("", ".txt", ".yaml", ".json", ".csv", ".xml", ".bin"):
            file = tmp_path / f"file{ending}"
            file.write_text(text)
            with pytest.raises(LadarregError) as refused:
                READERS[reader](file)
            assert "hunter2" not in str(refused.value), (text, ending, str(refused.value))
