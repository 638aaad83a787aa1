import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.errors import ExportError
from ladarreg_core.export.json import registration_document, write_document
from ladarreg_core.frames import Rigid
from ladarreg_core.results.registration import Registration

PROMISED = {
    "version", "camera_from_scanner", "camera", "covariance", "sigma", "thesis_parameters", "accepted", "evidence",
    "reasons", "matches", "steps", "options", "seed", "inputs", "software", "labels",
}  # fmt: skip


@pytest.fixture
def document(tmp_path, registration):
    source = tmp_path / "secret place" / "scan.npz"
    source.parent.mkdir()
    source.write_bytes(b"123" * 1_000_000)
    write_document(tmp_path / "r.json", registration_document(registration, inputs=[source]))
    text = (tmp_path / "r.json").read_text(encoding="utf-8")
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))


def test_the_document_has_all_documented_fields(document, registration):
    assert document.keys() >= PROMISED
    assert document["inputs"] == [
        {"name": "scan.npz", "size": 3_000_000, "sha256": hashlib.sha256(b"123" * 1_000_000).hexdigest()}
    ]
    assert document["labels"] == {"0": "no_return", "1": "seen", "2": "occluded", "3": "out_of_frame",
                                  "4": "grazing", "5": "uncertain"}  # fmt: skip
    assert document["options"] == {"window_px": 11, "kinds": ["a", "b"], "none": None, "flag": True}
    assert [step["name"] for step in document["steps"]] == ["channels", "climb"]
    assert document["steps"][1]["matches"] == 5
    assert document["steps"][1]["detail"] == {"rounds": 3}
    assert document["diagnostics"] == {"planarity": 0.25, "worst": None, "3": [1, 2]}
    assert document["reasons"] == list(registration.reasons)
    assert (document["accepted"], document["evidence"], document["seed"]) == (True, "image", 7)


def test_numbers_come_back_exactly_and_absent_ones_as_null(document, registration):
    pose = Rigid.from_matrix(document["camera_from_scanner"])
    np.testing.assert_array_equal(pose.matrix, registration.camera_from_scanner.matrix)
    back = np.array(document["scanner_from_camera"])
    np.testing.assert_allclose(back @ pose.matrix, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(back[:3, 3], pose.centre, atol=1e-12)
    np.testing.assert_array_equal(document["covariance"], registration.covariance)
    assert document["sigma"]["chi2_per_dof"] is None
    assert document["camera"]["distortion"] == list(registration.camera.distortion)
    matches = document["matches"]
    assert [m["pick_id"] for m in matches] == list("abcde")
    assert [m["inlier"] for m in matches] == registration.inliers.tolist()
    assert matches[2]["residual_px"] == [None, None]
    assert matches[0]["stereo_depth_error_m"] is None
    np.testing.assert_array_equal(matches[1]["ray"], registration.matches.rays[1])
    thesis = document["thesis_parameters"]
    assert thesis["Tx"] == registration.thesis_parameters.Tx
    assert thesis["alpha"] == registration.thesis_parameters.alpha


def test_the_assessment_is_in_the_document(scan, registration, tmp_path):
    from ladarreg_core.quality.assessment import assess

    inliers = np.array([True] * 5)  # five rays at random places, some behind the camera
    found = assess(scan, replace(registration, inliers=inliers))
    write_document(tmp_path / "r.json", registration_document(registration, assessment=found))
    document = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    levels = {finding["name"]: finding["level"] for finding in document["findings"]}
    assert levels["matches"] == "poor"
    for finding in document["findings"]:
        assert finding.keys() == {"name", "level", "sentence", "what_to_do", "values"}
    assert 0 < document["uncertainty"]["median_px"] <= document["uncertainty"]["p95_px"]
    assert document["uncertainty"]["p95_px"] <= document["uncertainty"]["worst_px"]
    assert document["not_assessed"].keys() == found.absent.keys()
    for place in document["advice"]:
        assert place["sentence"].startswith("A match near")
        assert (len(place["cell"]), len(place["uv"])) == (2, 2)
    for match in document["matches"]:
        assert (match["influence"] is None) == ("influence" in found.absent)
    assert document["smoothing"] is None


def test_every_match_has_an_influence(tmp_path):
    from ladarreg_core.quality.assessment import assess
    from tests.unit.quality.test_next_match import clustered

    room, _, _, pose, _ = clustered(2, count=14)
    fields = {name: getattr(pose, name) for name in pose.__dataclass_fields__}
    result = Registration(**fields, method="manual")
    found = assess(room.scan, result)
    document = registration_document(result, assessment=found)
    for k, match in enumerate(document["matches"]):
        assert match["influence"] == {
            name: getattr(found.influence, name)[k] for name in ("position_m", "angle_rad", "pixels", "cook")
        }


def test_a_missing_input_is_named_in_the_error(tmp_path, registration):
    with pytest.raises(ExportError, match=r"gone\.npz"):
        registration_document(registration, inputs=[tmp_path / "gone.npz"])
