"""A camera of which only the focal length is known: the stated uncertainty contains what is not known of it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.assumed_camera import LEAST, LINES, MOST, drawn_camera
from ladarreg_core.camera.uncertainty import CameraPrior, CameraUncertainty
from ladarreg_core.errors import FormatError, OptionError, ShapeError
from ladarreg_core.export.json import registration_document, write_document
from ladarreg_core.formats.documents.registration_file import read_registration
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.photo import Photo
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.assumed_camera import with_assumed_camera
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.project.results import pose_entry, registration_of
from ladarreg_core.quality.findings import findings
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan
from ladarreg_core.surface.uncertainty import picture_sigma, pixel_sigma
from testing.scenes.pose_case import difference
from testing.scenes.room import ROOM_CAMERA, room_case
from testing.scenes.room_lines import line_case

PHOTO = Photo(np.zeros((512, 768, 3), np.uint8), ROOM_CAMERA, assumed=True)


def registered(seed, *, camera=None, photo=PHOTO, options=None):
    """Eleven lines, drawn in the photo of a camera that is not quite the stated one."""
    case = line_case(seed, lines=LINES, camera=camera or drawn_camera(seed))
    return case, register(case.scan, photo, method="manual", picks=case.picks, options=options)


def mahalanobis(case, result):
    step = difference(case.pose, result.camera_from_scanner)
    return float(np.sqrt(step @ np.linalg.solve(result.covariance, step) / 6))


def named(result, name):
    return {finding.name: finding for finding in findings(result)}.get(name)


@pytest.mark.long
def test_the_stated_uncertainty_is_right_over_cameras_drawn_from_the_prior():
    found = []
    for seed in range(24):
        case = line_case(seed, lines=LINES, camera=drawn_camera(seed))
        matches, _ = matches_from_picks(case.scan, case.picks, camera=ROOM_CAMERA)
        found.append((case, solve_pose(matches, ROOM_CAMERA, PoseOptions(check_ambiguity=False), assumed=True)))
    assert all(result.accepted for _, result in found)
    assert LEAST <= np.sqrt(np.mean([mahalanobis(*each) ** 2 for each in found])) <= MOST


@pytest.mark.parametrize("method", ["linear", "epipolar_simplex", "fixed"])
def test_estimators_that_keep_the_camera_state_its_errors(method):
    """Their covariance is that of an exact camera, enlarged by the errors of the camera."""
    distances = []
    for seed in range(16):
        case = room_case(seed, count=60, camera=drawn_camera(seed))
        options = PoseOptions(method=method) if method != "fixed" else PoseOptions(intrinsics="fixed")
        result = solve_pose(case.matches, ROOM_CAMERA, options, initial=case.pose, assumed=True)
        assert result.camera == ROOM_CAMERA
        distances.append(mahalanobis(case, result))
    assert 0.4 < np.sqrt(np.mean(np.square(distances))) < 1.6  # tens if the camera were taken as exact


def test_a_rotation_that_compensates_the_camera_leaves_the_picture_certain():
    case, result = registered(1)
    pose, camera = result.camera_from_scanner, result.camera
    points = pose @ case.scan.points[case.scan.valid][::97].astype(float)
    alone = pixel_sigma(points, camera, pose.rotation, result.covariance)
    joint = pixel_sigma(points, camera, pose.rotation, result.camera_uncertainty)
    inside = camera.contains(camera.project(points))
    assert np.median(alone[inside]) > 3
    assert np.median(joint[inside]) < 1.5
    picture = picture_sigma(case.scan, camera, pose, result.joint_covariance)
    assert np.median(picture[case.scan.valid][::97][inside]) == pytest.approx(np.median(joint[inside]), rel=1e-3)
    labels = [
        texture_scan(case.scan, PHOTO, pose, camera=camera, covariance=covariance).labels
        for covariance in (None, result.joint_covariance)
    ]
    exact, stated = (np.mean(label == Label.UNCERTAIN) for label in labels)
    assert stated < exact + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.001, -0.001)])
def test_pixels_are_as_uncertain_as_samples_of_pose_and_camera_scatter(distortion):
    case, result = registered(2)
    camera, pose = replace(result.camera, distortion=distortion), result.camera_from_scanner
    joint = result.camera_uncertainty
    rng = np.random.default_rng(0)
    few = CameraUncertainty(joint.names, joint.covariance * 1e-4, joint.stated)  # small, where all is linear
    assert joint.names == ("focal_px", "k1", "cx", "cy")
    samples = rng.multivariate_normal(np.zeros(10), few.covariance, 2000)
    points = case.scan.points[60:300:60, 100:400:75].reshape(-1, 3).astype(float)
    seen = []
    for sample in samples:
        moved = Rigid.from_centre(rotation_from_rotvec(sample[:3]) @ pose.rotation, pose.centre + sample[3:6])
        k1, *others = camera.distortion or (0.0,) * 4
        factor = 1 + sample[6] / camera.focal_px
        other = replace(
            camera, fx=camera.fx * factor, fy=camera.fy * factor, cx=camera.cx + sample[8], cy=camera.cy + sample[9],
            distortion=(k1 + sample[7], *others),
        )  # fmt: skip
        seen.append(other.project(moved @ points))
    spread = [np.sqrt(np.linalg.eigvalsh(np.cov(column.T))[-1]) for column in np.stack(seen, axis=1)]
    np.testing.assert_allclose(pixel_sigma(pose @ points, camera, pose.rotation, few), spread, rtol=0.08)


def test_a_cropped_photo_is_found_and_its_pose_is_right():
    case, result = registered(3, camera=replace(ROOM_CAMERA, cx=ROOM_CAMERA.cx + 60))
    finding = named(result, "camera")
    assert finding.level == "poor"
    assert "cropped" in finding.sentence
    assert "right of the middle" in finding.sentence
    assert mahalanobis(case, result) < 2
    exact = register(case.scan, replace(PHOTO, assumed=False), method="manual", picks=case.picks)
    assert mahalanobis(case, exact) > 20


@pytest.mark.slow
def test_an_ordinary_camera_is_named_and_not_called_cropped():
    for seed in range(4):
        finding = named(registered(seed)[1], "camera")
        assert finding.level in ("good", "fair")
        assert "not calibrated" in finding.sentence


def test_an_exact_camera_and_a_prior_of_zero_are_the_same():
    none = RegisterOptions(pose=PoseOptions(camera_prior=CameraPrior(centre_of_width=0, k1=0, focal=0)))
    _, without = registered(5, options=none)
    _, exact = registered(5, photo=replace(PHOTO, assumed=False))
    assert without.camera_uncertainty is exact.camera_uncertainty is None
    assert (without.covariance == exact.covariance).all()
    assert (without.camera_from_scanner.matrix == exact.camera_from_scanner.matrix).all()
    assert named(exact, "camera") is None


def test_what_is_not_known_survives_files_and_projects(tmp_path):
    _, result = registered(6)
    document = registration_document(result)
    write_document(tmp_path / "registration.json", document)
    read = read_registration(tmp_path / "registration.json")
    kept = registration_of(pose_entry("robust", result))
    for other in (read.camera_uncertainty, kept.camera_uncertainty):
        assert other.as_fields() == result.camera_uncertainty.as_fields()
    assert (kept.joint_covariance.covariance[:6, :6] == kept.covariance).all()
    del document["camera_uncertainty"]  # as written by earlier versions, and for calibrated cameras
    write_document(tmp_path / "registration.json", document)
    assert read_registration(tmp_path / "registration.json").camera_uncertainty is None


@pytest.mark.parametrize(
    "damage", [{"names": ["cx", "k1"]}, {"covariance": [[1.0]]}, {"covariance": None}, {"prior": {"k1": "wide"}}]
)
def test_damaged_files_are_refused(tmp_path, damage):
    document = registration_document(registered(6)[1])
    document["camera_uncertainty"] = {**document["camera_uncertainty"], **damage}
    (tmp_path / "registration.json").write_text(json.dumps(document))
    with pytest.raises(FormatError):
        read_registration(tmp_path / "registration.json")


def test_wrong_priors_are_refused():
    for prior in ({"centre_of_width": -0.1}, {"k1": float("nan")}):
        with pytest.raises(OptionError):
            CameraPrior(**prior)
    with pytest.raises(OptionError):
        PoseOptions(camera_prior=0.05)
    with pytest.raises(ShapeError):
        CameraUncertainty(("cx", "k1"), np.eye(8), {})


def test_a_pose_without_enough_inliers_stays_as_it_is():
    result = solve_pose(room_case(0, count=20).matches, ROOM_CAMERA)
    few = replace(result, inliers=np.zeros(20, bool))
    assert with_assumed_camera(few, CameraPrior()) is few
