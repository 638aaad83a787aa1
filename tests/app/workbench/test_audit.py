"""The audit of a pose in the workbench: that a file states, or else the current one: right, wrong, undecidable."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.frames import Rigid
from ladarreg_core.project import edits
from ladarreg_core.project.history import NOBODY
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench

pytestmark = pytest.mark.slow


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    bench = sample_bench(tmp_path / "project")
    yield bench
    bench.workbench.close()


def state(bench: WorkbenchDriver, pose: Rigid) -> None:
    rows = tuple(tuple(float(value) for value in row) for row in pose.matrix)
    bench.workbench.session.commit(
        "State a pose",
        lambda document: edits.edited_photo(
            document, "p1", lambda entry: msgspec.structs.replace(entry, stated_pose=rows, stated_by="rig.json")
        ),
        author=NOBODY,
    )


def test_the_pose_that_a_file_states_is_judged_until_another_is_stated(bench: WorkbenchDriver) -> None:
    assert "no pose to judge" in bench.job("audit").message
    truth = read_pose(sample_folder() / "truth.json")
    state(bench, truth)
    assert bench.job("audit").state == "done"
    found = bench.slice("audit:p1")
    assert found["judged"] == "rig.json"
    assert found["outcome"] == "right"
    probabilities = [probability for _, probability in found["power"]["position_m"]]
    assert probabilities == sorted(probabilities)
    assert probabilities[-1] > 0.99
    assert 0 < found["power"]["smallest_position_m"] < 0.2

    moved = Rigid.from_centre(truth.rotation, truth.centre + np.array([0.0, 0.08, 0.0]))
    state(bench, moved)
    assert bench.slice("audit:p1") is None, "it was about another pose"
    bench.job("audit")
    found = bench.slice("audit:p1")
    assert found["outcome"] == "wrong"
    corrected = Rigid.from_matrix(np.array(found["camera_from_scanner"]))
    assert np.linalg.norm(corrected.centre - truth.centre) < 0.02
    assert bench.slice("poses:p1")["stages"] == [], "an audit changes nothing"


def test_without_a_stated_pose_the_shown_one_is_judged(bench: WorkbenchDriver) -> None:
    bench.job("auto")
    bench.job("audit")
    found = bench.slice("audit:p1")
    assert found["outcome"] == "right"
    assert found["judged"] == "Automatic"
