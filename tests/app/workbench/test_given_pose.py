"""A project with a pose that was given: it opens, states the verdict, and colours no model."""

from __future__ import annotations

from pathlib import Path

import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.project import edits
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.results import pose_entry
from ladarreg_core.registration.given import given_pose
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import open_bench, sample_bench


@pytest.mark.slow
def test_a_given_pose_in_a_project_is_never_shown_as_registered(tmp_path: Path) -> None:
    sample = sample_folder()
    photo = read_photo(sample / "photo.png", camera=sample / "camera.json")
    result = given_pose(read_scan(sample / "scan.npz"), photo, read_pose(sample / "truth.json"), check_images=False)
    pose = pose_entry("robust", result)
    bench = sample_bench(tmp_path / "project")
    bench.workbench.session.commit(
        "Give a pose",
        lambda document: edits.edited_photo(document, "p1", lambda entry: edits.with_pose(entry, pose)),
        author=NOBODY,
    )
    bench.workbench.close()

    bench = open_bench(tmp_path / "project")
    (stage,) = bench.slice("poses:p1")["stages"]
    assert not stage["accepted"]
    assert stage["verdict"] == "Given, not verified: this pose was applied, not solved."
    textures = bench.slice("model")
    assert not textures["accepted"]
    assert not any(choice["usable"] for choice in textures["choices"] if choice["value"] in ("colour", "label"))
    with pytest.raises(OptionError, match="accepted pose"):
        bench.workbench.model_parts.part("texture", {"photo": "p1", "kind": "colour"})
    bench.workbench._slow_slices()
    document, loader = bench.workbench.session.document, bench.workbench.loader
    scan, kept = loader.scan(document), document.photos[0].pose
    assert scan is not None
    assert kept is not None
    assert "given" in loader.assessment(scan, kept).absent["uncertainty"]
    bench.workbench.close()
