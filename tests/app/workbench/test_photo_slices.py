"""The slices on each photograph: what an edit does not touch stays the same object, and whatever touches it is seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from testing.workbench.workbench_driver import WorkbenchDriver, kept_bench, registered


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """The sample, registered, with a blank photograph beside it."""
    bench = kept_bench("registered", tmp_path / "project", registered)
    blank = tmp_path / "blank.png"
    Image.fromarray(np.full((48, 64, 3), 120, np.uint8)).save(blank)
    bench.workbench.files.open(blank, blank.name, "photo", None, bench.client)
    yield bench
    bench.workbench.close()


@pytest.mark.slow
def test_an_edit_of_one_photograph_leaves_the_slices_of_another_as_they_are(bench: WorkbenchDriver) -> None:
    made = bench.workbench.publisher.all_slices
    bench.eventually(lambda: bench.slice("judged:p1"))
    before = made()
    bench.do("add_pick", photo="p2", kind="point", scan=[[1, 0, 0]], photo_uv=[[9, 9]])
    after = made()
    names = [name for name in before if name.endswith(":p1") and before[name] is not None]
    assert {"picks:p1", "poses:p1", "progress:p1"} <= set(names)
    assert not [name for name in names if before[name] is not after[name]]
    assert before["photos"][0] is after["photos"][0]
    assert len(after["picks:p2"]) == 1


@pytest.mark.slow
def test_what_becomes_known_of_a_pose_is_seen_without_an_edit(bench: WorkbenchDriver) -> None:
    workbench, document = bench.workbench, bench.workbench.session.document
    entry = document.photo("p1")
    assert entry is not None
    assert entry.pose is not None
    scan = workbench.loader.scan(document)
    assert scan is not None
    workbench.publisher.all_slices()
    workbench.loader._cache["assessment"].clear()
    without = workbench.publisher.all_slices()["poses:p1"]
    workbench.loader.assessment(scan, entry.pose)
    assert workbench.publisher.all_slices()["poses:p1"] != without, "its uncertainty is judged now"
