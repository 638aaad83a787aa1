"""Ten clients that edit at random; `python -m benchmarks.workbench --minutes 60` runs them for an hour."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from testing.workbench.served import Page, many_clients, served, with_camera_and_picks

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="no Ctrl-C to send")]


@pytest.mark.long
def test_ten_clients_see_the_same_document(tmp_path: Path) -> None:
    project = tmp_path / "project"
    with served(project) as (found, _):
        watching = Page(found)
        with_camera_and_picks(watching, 20)
        _, edits = many_clients(found, 0.1)
        assert edits > 40
        watching.ask("list_served")
        coming = Page(found)
        assert coming.slices["picks:p1"] == watching.slices["picks:p1"], "an old and a new client"
    kept = json.loads((project / "project.json").read_bytes())["photos"][0]["picks"]
    assert [pick["id"] for pick in kept] == [pick["id"] for pick in coming.slices["picks:p1"]]
    numbers = [pick["number"] for pick in kept]
    assert len(set(numbers)) == len(numbers)
