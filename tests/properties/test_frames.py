"""Laws of rigid transforms and of the thesis's six numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ladarreg_core.errors import DegenerateGeometryError, LadarregError, ShapeError
from ladarreg_core.frames import (
    CAMERA_AXES_FROM_SCANNER,
    Rigid,
    ThesisParameters,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from tests.properties.strategies import points, poses, rotvecs, unit_vectors


@given(poses(), points())
def test_the_inverse_undoes(a: Rigid, p: np.ndarray) -> None:
    np.testing.assert_allclose(a.inverse @ (a @ p), p, atol=1e-12)
    np.testing.assert_allclose((a @ a.inverse).matrix, np.eye(4), atol=1e-13)


@given(poses(), poses(), poses(), points())
def test_composition_is_associative_and_means_one_after_the_other(a: Rigid, b: Rigid, c: Rigid, p: np.ndarray) -> None:
    np.testing.assert_allclose(((a @ b) @ c).matrix, (a @ (b @ c)).matrix, atol=1e-12)
    np.testing.assert_allclose((a @ b) @ p, a @ (b @ p), atol=1e-11)
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-12)


@given(poses())
def test_matrix_and_centre_carry_the_whole_pose(a: Rigid) -> None:
    np.testing.assert_array_equal(Rigid.from_matrix(a.matrix).matrix, a.matrix)
    np.testing.assert_allclose(a @ a.centre, np.zeros(3), atol=1e-12)
    np.testing.assert_allclose(Rigid.from_centre(a.rotation, a.centre).matrix, a.matrix, atol=1e-13)


@given(rotvecs())
def test_rotation_vectors_go_there_and_back_from_zero_to_pi(w: np.ndarray) -> None:
    R = rotation_from_rotvec(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-14)
    back = rotvec_from_rotation(R)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    np.testing.assert_allclose(rotation_from_rotvec(back), R, atol=1e-9)
    if np.linalg.norm(w) < np.pi - 1e-6:  # at pi both signs are right
        np.testing.assert_allclose(back, w, atol=1e-9)


@given(poses(), rotvecs(), points(1))
def test_angle_and_distance_measure_what_was_added(a: Rigid, w: np.ndarray, shift: np.ndarray) -> None:
    turned = Rigid.from_centre(rotation_from_rotvec(w) @ a.rotation, a.centre + shift[0])
    assert turned.angle_to(a) == pytest.approx(np.linalg.norm(w), abs=1e-8)
    assert turned.distance_to(a) == pytest.approx(np.linalg.norm(shift[0]), abs=1e-11)


@given(poses(), st.floats(0, 4e-4), st.integers(0, 2**32 - 1))
def test_a_printed_rotation_is_projected_to_a_near_true_one(a: Rigid, error: float, seed: int) -> None:
    noisy = a.rotation + np.random.default_rng(seed).uniform(-error, error, (3, 3)) / 3
    b = Rigid(noisy, a.translation)
    np.testing.assert_allclose(b.rotation @ b.rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(b.rotation) == pytest.approx(1, abs=1e-13)
    assert b.angle_to(a) <= 2 * error + 1e-13


@given(poses(), st.floats(2e-3, 10))
def test_what_is_no_rotation_is_refused(a: Rigid, error: float) -> None:
    with pytest.raises(DegenerateGeometryError, match="orthonormal"):
        Rigid(a.rotation * (1 + error), a.translation)
    with pytest.raises(DegenerateGeometryError, match="reflection"):
        Rigid(a.rotation @ np.diag([1, 1, -1]), a.translation)


@pytest.mark.parametrize(
    "bad",
    [
        np.full((4, 4), np.nan),
        np.diag([1, 1, 1, np.inf]),
        np.eye(3),
        np.eye(5),
        "pose",
        [[1, 2], [3]],
        None,
        np.vstack([np.eye(4)[:3], [[0, 0, 1, 1]]]),
        np.zeros((4, 4)),
        np.diag([1, 1, 1, 2.0]),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused_in_one_line(bad: object) -> None:
    with pytest.raises(LadarregError) as caught:
        Rigid.from_matrix(bad)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_a_translation_of_another_shape_is_refused() -> None:
    with pytest.raises(ShapeError):
        Rigid(np.eye(3), np.zeros(4))


def test_points_keep_their_type_and_their_axes() -> None:
    pose = Rigid.from_rotvec([0.1, 0.2, 0.3], [1, 2, 3])
    assert (pose @ np.zeros((2, 7, 3), np.float32)).dtype == np.float32
    assert (pose @ np.zeros((2, 7, 3), np.float32)).shape == (2, 7, 3)
    assert (pose @ np.zeros(3, np.int64)).dtype == np.float64


def test_a_transform_cannot_be_changed_from_outside() -> None:
    R, t = np.eye(3), np.zeros(3)
    pose = Rigid(R, t)
    R[0, 0] = t[0] = 5.0
    np.testing.assert_array_equal(pose.matrix, np.eye(4))
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 1.0


_angles = st.floats(-1.5, 1.5)
_metres = st.floats(-3, 3)


@given(st.tuples(_metres, _metres, _metres, _angles, _angles, st.floats(-3.1, 3.1)))
def test_thesis_parameters_go_there_and_back(numbers: tuple[float, ...]) -> None:
    there = ThesisParameters(*numbers)
    back = ThesisParameters.from_pose(there.pose)
    names = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
    np.testing.assert_allclose([getattr(back, n) for n in names], numbers, atol=1e-9)


@given(poses())
def test_every_pose_has_thesis_parameters_even_straight_up(pose: Rigid) -> None:
    back = ThesisParameters.from_pose(pose).pose
    assert back.angle_to(pose) < 1e-7
    assert back.distance_to(pose) < 1e-9


@pytest.mark.parametrize("beta", [np.pi / 2, -np.pi / 2])
@given(alpha=_angles, gamma=_angles)
def test_looking_straight_down_or_up_is_still_the_same_pose(beta: float, alpha: float, gamma: float) -> None:
    pose = ThesisParameters(0.1, 0.2, 0.3, alpha, beta, gamma).pose
    assert ThesisParameters.from_pose(pose).pose.angle_to(pose) < 1e-7


@given(_metres, _metres, _metres, _angles, _angles, st.floats(-1.5, 1.5), unit_vectors(), st.floats(0.5, 20))
def test_thesis_equation_2_13(
    Tx: float, Ty: float, Tz: float, alpha: float, beta: float, gamma: float, ray: np.ndarray, range_m: float
) -> None:
    """The pixel of the pose is that of `X_camera = Q^T (X_ladar - C)` in the stereo frame, x = -lambda X / Z."""
    ca, sa, cb, sb, cg, sg = (f(v) for v in (alpha, beta, gamma) for f in (np.cos, np.sin))
    Ry = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])  # by -alpha
    Rx = np.array([[1, 0, 0], [0, cb, -sb], [0, sb, cb]])
    Rz = np.array([[cg, -sg, 0], [sg, cg, 0], [0, 0, 1]])
    X, Y, Z = ray * range_m
    stereo = (Ry @ Rx @ Rz).T @ (np.array([Y, Z, X]) - [Tx, Ty, Tz])
    camera = ThesisParameters(Tx, Ty, Tz, alpha, beta, gamma).pose @ np.array([X, Y, Z])
    np.testing.assert_allclose(camera, stereo * [-1, -1, 1], atol=1e-11)
    assume(stereo[2] > 0.1)
    np.testing.assert_allclose(camera[:2] / camera[2], -stereo[:2] / stereo[2], atol=1e-9)


def test_the_signs_in_words() -> None:
    """Tx is left, Ty up, Tz forward; alpha > 0 turns right, beta > 0 looks down, gamma > 0 rolls clockwise."""
    left = ThesisParameters(0.612, 0.047, -0.118, 0, 0, 0)
    np.testing.assert_allclose(left.pose.centre, [-0.118, 0.612, 0.047], atol=1e-12)
    assert left.describe_position() == "0.61 m left, 0.05 m up, 0.12 m back"
    assert (
        ThesisParameters(-0.612, -0.047, 0.118, 0, 0, 0).describe_position()
        == "0.61 m right, 0.05 m down, 0.12 m forward"
    )

    axis = {k: ThesisParameters(0, 0, 0, **{k: 0.2}, **dict.fromkeys({"alpha", "beta", "gamma"} - {k}, 0.0)).pose
            for k in ("alpha", "beta", "gamma")}  # fmt: skip
    looks_along = {k: pose.rotation.T @ [0, 0, 1] for k, pose in axis.items()}
    np.testing.assert_allclose(looks_along["alpha"], [np.cos(0.2), -np.sin(0.2), 0], atol=1e-12)  # right is -Y
    np.testing.assert_allclose(looks_along["beta"], [np.cos(0.2), 0, -np.sin(0.2)], atol=1e-12)  # down is -Z
    # Seen from behind the camera, what it calls right has sunk: it was turned like a clock's hand.
    np.testing.assert_allclose(axis["gamma"].rotation.T @ [1, 0, 0], [0, -np.cos(0.2), -np.sin(0.2)], atol=1e-12)

    turned = ThesisParameters(0, 0, 0, np.deg2rad(7.31), np.deg2rad(-1.2), np.deg2rad(0.94))
    assert turned.describe_orientation() == "7.31 deg right, 1.20 deg up, rolled 0.94 deg clockwise"
    other = ThesisParameters(0, 0, 0, np.deg2rad(-7.31), np.deg2rad(1.2), np.deg2rad(-0.94))
    assert other.describe_orientation() == "7.31 deg left, 1.20 deg down, rolled 0.94 deg counter-clockwise"


def test_a_camera_along_x_is_the_identity_of_the_parameters() -> None:
    pose = ThesisParameters(0, 0, 0, 0, 0, 0).pose
    np.testing.assert_array_equal(pose.rotation, CAMERA_AXES_FROM_SCANNER)
    np.testing.assert_array_equal(pose.rotation @ [1, 2, 3], [-2, -3, 1])


def test_thesis_corrected_numbers_of_the_two_translations() -> None:
    """T is the centre C of 2.18-2.21 and not the -RC of 2.10: the two differ for a turned camera."""
    p = ThesisParameters(5, 2, 2, 0.3, 0.2, 0.1)
    np.testing.assert_allclose(p.pose.centre, [2, 5, 2], atol=1e-12)
    assert np.linalg.norm(p.pose.translation - p.pose.centre) > 1
