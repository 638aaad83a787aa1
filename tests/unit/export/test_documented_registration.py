"""`registration.json` and the codes of labels.png, as docs/outputs.md lists them: every field, and no other."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.export.json import registration_document
from ladarreg_core.export.targets.folder import registration_files
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.matches import Pick
from ladarreg_core.quality.assessment import assess
from ladarreg_core.quality.smoothing import SmoothedScan
from ladarreg_core.registration.given import given_pose
from ladarreg_core.registration.register import register
from ladarreg_core.results.compared_blocks import ComparedBlocks
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.replacement import OFFSET_FILE, REFUSED_FILES, REGISTRATION_FILES
from ladarreg_core.surface.texture.registered_texture import Label

PAGE = (Path(__file__).parents[3] / "docs" / "outputs.md").read_text(encoding="utf-8")
FREE = {
    "camera", "camera_sigmas", "camera_uncertainty", "diagnostics", "options", "labels", "not_assessed",
    "steps[].detail", "findings[].values", "inputs[].read_with",
}  # fmt: skip
"""Fields whose own fields differ between cameras, methods and steps."""


def section(name: str) -> str:
    return PAGE.split(f"\n## {name}\n")[1].split("\n## ")[0]


def listed(name: str) -> list[str]:
    """Return the first column of a section's table, without the ticks of code."""
    return [match.group(1) for match in re.finditer(r"^\| `?([^`|]+?)`? \|", section(name), re.MULTILINE)]


def fields_of(value: Any, name: str = "") -> set[str]:
    """Return the names of all fields, with dots between them and [] for the items of a list."""
    if name in FREE:
        return set()
    if isinstance(value, dict):
        inner = {key: f"{name}.{key}" if name else key for key in value}
        return set(inner.values()).union(*(fields_of(value[key], inner[key]) for key in value))
    if isinstance(value, list):
        return set().union(*(fields_of(one, f"{name}[]") for one in value if isinstance(one, dict)))
    return set()


@pytest.fixture(scope="module")
def documents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """The documents of one registration that is accepted and one that is refused, and of a given pose."""
    sample, path = sample_folder(), tmp_path_factory.mktemp("documents") / "registration.json"
    scan, truth = read_scan(sample / "scan.npz"), read_pose(sample / "truth.json")
    photo = read_photo(sample / "photo.png", camera=sample / "camera.json")
    points = scan.points[40::90, 40::90].reshape(-1, 3).astype(float)
    points = points[np.isfinite(points).all(axis=1)]
    uv = photo.camera.project(truth @ points)
    seen = photo.camera.contains(uv)
    ranges = np.linalg.norm(points, axis=1)
    picks = [
        Pick(str(k), "point", (points[k : k + 1] / ranges[k]), uv[k : k + 1], lengths_m=(float(ranges[k]),))
        for k in np.flatnonzero(seen)
    ]
    accepted = register(scan, photo, method="manual", picks=picks, initial=truth)
    assert accepted.accepted, accepted.reasons
    block = ComparedBlocks(
        ids=("b0.0",), uv=[[1, 2]], offset_px=[[0, 0]], information=[np.eye(2)], correlation=[0.5], agrees=[True]
    )  # type: ignore[arg-type]
    # As of a camera that was assumed, which takes three searches to register.
    joint = np.zeros((7, 7))
    joint[:6, :6], joint[6, 6] = accepted.covariance, 1.0
    uncertainty = CameraUncertainty(("focal_px",), joint, {"focal_px": 974.0})
    accepted = replace(accepted, blocks=block, camera_uncertainty=uncertainty)
    refused = replace(accepted, accepted=False, evidence="none")
    rests_on = {"matches": ["1"], "current": True, "sentence": "The pose rests on 1 match."}
    smoothed = SmoothedScan(scan, 1, "One.")
    described = registration_document(
        accepted,
        assessment=assess(scan, accepted),
        smoothed=smoothed,
        inputs=[sample / "scan.npz"],
        read_with=[{"scan_index": 0}],
        folder=path.parent,
    )
    found = {}
    for name, result, more in (
        ("accepted", accepted, {"smoothed": smoothed, "saved_document": lambda: {**described, "rests_on": rests_on}}),
        ("refused", refused, {"open_command": "ladarreg serve"}),
        ("given", given_pose(scan, photo, truth, check_images=False), {}),
    ):
        jobs = registration_files(
            result, scan, photo, [sample / "scan.npz"], read_with=[{"scan_index": 0}], folder=path.parent, **more
        )  # type: ignore[arg-type]
        jobs[0][1](path)
        found[name] = json.loads(path.read_text(encoding="utf-8"))
        found[name]["written files"] = [job for job, _ in jobs]
    return found


@pytest.mark.slow
def test_every_field_that_is_written_is_documented_and_no_other(documents: dict[str, dict[str, Any]]) -> None:
    written = set()
    for document in documents.values():
        written |= fields_of({key: value for key, value in document.items() if key != "written files"})
    documented = listed("registration.json")
    assert len(documented) == len(set(documented))
    assert written - set(documented) == set()
    assert set(documented) - {"field", "---"} - written == set()


@pytest.mark.slow
def test_a_refused_document_has_no_number_that_could_be_taken_for_a_pose(
    documents: dict[str, dict[str, Any]],
) -> None:
    refused, accepted = documents["refused"], documents["accepted"]
    for name in ("camera_from_scanner", "scanner_from_camera", "camera_from_world", "thesis_parameters"):
        assert refused[name] is None
    assert refused["rejected_guess"] == accepted["camera_from_scanner"]
    assert accepted["rejected_guess"] is None
    assert "open_in_workbench" not in accepted


def test_the_files_of_each_kind_of_result_are_listed(documents: dict[str, dict[str, Any]]) -> None:
    known = set(listed("A folder of results")) - {"file", "---"}
    assert known == {*REGISTRATION_FILES, *REFUSED_FILES, OFFSET_FILE}
    rows = re.findall(r"^\| `(\S+)` \|.*\| ([^|]+) \|$", section("A folder of results"), re.MULTILINE)
    assert len(rows) == len(known)
    for file, when in rows:
        if file == OFFSET_FILE:
            continue
        for name, document in documents.items():
            said = when == "always" or name in re.findall(r"\w+", when)
            assert (file in document["written files"]) == said, (file, name)


def test_the_codes_of_labels_are_listed() -> None:
    rows = re.findall(r"^\| (\d) \| ([a-z ]+) \|", section("labels.png"), re.MULTILINE)
    assert [(int(code), name) for code, name in rows] == [
        (one.value, one.name.lower().replace("_", " ")) for one in Label
    ]
