"""The targets `opencv` and `kalibr`: OpenCV and a reader of YAML find the pixels of the laser's points."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ladarreg_core.errors import ExportError
from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.formats.cameras.camera_file import camera_format, read_camera, read_cameras
from ladarreg_core.frames import Rigid
from testing.scenes.small_registration import POSE
from tests.unit.export.camera_cases import CAMERAS, TILTED, handed_over, photograph, scanner_points, world_points


def largest(error: np.ndarray, seen: np.ndarray) -> float:
    return float(np.nanmax(np.hypot(*error[seen].T)))


@pytest.mark.parametrize("frame", ["scanner", "world"])
@pytest.mark.parametrize("case", ["0 terms", "4 terms", "5 terms", "8 terms", "12 terms", "fisheye"])
def test_opencv_projects_the_points_where_they_are(tmp_path: Path, case: str, frame: FrameName) -> None:
    camera = CAMERAS[case]
    handed = handed_over(photograph(camera, "a-b", given=case == "5 terms"), frame=frame)
    export_to(tmp_path / "out", handed, ["opencv"])
    file = tmp_path / "out" / "opencv" / "a-b.yaml"

    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    K, D, rvec, tvec, R = (storage.getNode(name).mat() for name in ("K", "D", "rvec", "tvec", "R"))
    size = (storage.getNode("image_width").real(), storage.getNode("image_height").real())
    assert size == camera.size
    assert storage.getNode("camera_model").string() == camera.model
    assert (storage.getNode("fisheye_model").real() == 1) == (case == "fisheye")
    assert storage.getNode("photograph").string() == "Größe a-b .jpg"
    assert storage.getNode("pose_is").string() == ("given, not verified" if case == "5 terms" else "accepted (image)")
    assert ("# Pose: given, not verified" in file.read_text("utf-8")) == (case == "5 terms")
    assert np.allclose(storage.getNode("world_offset_m").mat().ravel(), handed.frame.offset_m)
    assert storage.getNode("world").string() == handed.frame.sentence

    points, ours = world_points(handed), camera.project(TILTED @ scanner_points(handed))
    seen = camera.contains(ours)
    assert seen.sum() > 200
    project = cv2.fisheye.projectPoints if case == "fisheye" else cv2.projectPoints

    def error(rotation: np.ndarray, matrix: np.ndarray) -> float:
        uv, _ = project(points[:, None], cv2.Rodrigues(rotation)[0], tvec, matrix, D)
        return largest(uv[:, 0] - ours, seen)

    assert np.allclose(cv2.Rodrigues(rvec)[0], R, atol=1e-12)
    assert error(R, K) < 1e-6
    assert error(R.T, K) > 10
    shifted = K.copy()
    shifted[:2, 2] += 0.5
    assert error(R, shifted) > 0.4
    assert read_camera(file) == camera


@pytest.mark.parametrize("case", ["0 terms", "4 terms", "fisheye"])
def test_kalibr_has_the_intrinsics_and_the_chain(tmp_path: Path, case: str) -> None:
    camera = CAMERAS[case]
    photos = [photograph(camera, "a"), photograph(CAMERAS["4 terms"], "b 2", pose=POSE, given=True)]
    handed = handed_over(*photos, photograph(CAMERAS["fisheye"], "c", pose=POSE), frame="world")
    export_to(tmp_path / "out", handed, ["kalibr"])
    folder = tmp_path / "out" / "kalibr"
    assert sorted(path.name for path in folder.iterdir()) == [
        "camchain-a.yaml", "camchain-b 2.yaml", "camchain-c.yaml", "camchain.yaml",
    ]  # fmt: skip
    chain = yaml.safe_load((folder / "camchain.yaml").read_text("utf-8"))
    assert "cam1: Pose: given, not verified" in (folder / "camchain.yaml").read_text("utf-8")
    assert chain["cam0"] | {"rostopic": ""} == {
        "cam_overlaps": [1, 2],
        "camera_model": "pinhole",
        "intrinsics": [camera.as_fields()[name] for name in ("fx", "fy", "cx", "cy")],
        "distortion_model": "equidistant" if case == "fisheye" else "radtan",
        "distortion_coeffs": camera.as_fields()["distortion"] or [0.0] * 4,
        "resolution": list(camera.size),
        "rostopic": "",
    }

    points, second = scanner_points(handed), CAMERAS["4 terms"]
    ours = second.project(POSE @ points)
    seen = second.contains(ours)
    k1, k2, p1, p2 = chain["cam1"]["distortion_coeffs"]
    fu, fv, pu, pv = chain["cam1"]["intrinsics"]

    def error(step: np.ndarray) -> float:
        """Project points of the first camera by the chain and the radtan model written out."""
        x, y, z = (Rigid.from_matrix(step) @ (TILTED @ points)).T
        x, y = x / z, y / z
        s = x * x + y * y
        radial = 1 + k1 * s + k2 * s * s
        xd = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        yd = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
        return largest(np.stack([fu * xd + pu, fv * yd + pv], axis=-1) - ours, seen)

    step = np.array(chain["cam1"]["T_cn_cnm1"])
    assert error(step) < 1e-6
    assert error(np.linalg.inv(step)) > 1

    found = read_cameras(folder / "camchain.yaml")
    assert [each.camera for each in found] == [camera, second, CAMERAS["fisheye"]]
    assert found[1].camera_from_first is not None
    assert found[1].camera_from_first.distance_to(POSE @ TILTED.inverse) < 1e-9
    assert camera_format(folder / "camchain-a.yaml") == "Kalibr camchain"
    assert read_camera(folder / "camchain-a.yaml") == camera


@pytest.mark.parametrize(
    ("target", "case", "sentence"),
    [
        ("opencv", "equirectangular", "is equirectangular, and OpenCV describes perspective and fisheye cameras only"),
        ("kalibr", "equirectangular", "is equirectangular; Kalibr has pinholes .* or export to colmap or nerfstudio"),
        ("kalibr", "8 terms", "8 terms, of which more than the first four are not zero; .* or export to opencv or ros"),
        ("kalibr", "12 terms", "12 terms, of which"),
    ],
)
def test_what_has_no_model_is_refused_before_anything_is_written(
    tmp_path: Path, target: str, case: str, sentence: str
) -> None:
    handed = handed_over(photograph(CAMERAS["0 terms"], "a"), photograph(CAMERAS[case], "b"))
    with pytest.raises(ExportError, match=sentence):
        export_to(tmp_path / "out", handed, [target])
    assert not list(tmp_path.iterdir())
