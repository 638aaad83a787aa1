"""Scanners that an inclinometer has made level, in networks of targets."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.frames import rotation_from_rotvec, rotvec_from_rotation

_LEVEL_DEG, _SIGMA_M = 0.02, 0.002
Scans = dict[str, dict[str, lr.SurveyTarget]]


def _network(seed: int, *, lean_deg: float = 0.0) -> tuple[Scans, list[lr.Rigid], np.ndarray]:
    """Return the targets of four scans, their poses and the places (6, 3); the last scan leans."""
    rng = np.random.default_rng([45, seed])
    places = np.column_stack([rng.uniform(-5, 5, (6, 2)), rng.uniform(-0.5, 0.5, 6)])
    scans, poses = {}, []
    for k in range(4):
        w = np.append(rng.normal(0, np.radians(_LEVEL_DEG), 2), 0.0)
        w[0] += np.radians(lean_deg) * (k == 3)
        turn = rotation_from_rotvec([0, 0, rng.uniform(-3, 3)]) @ rotation_from_rotvec(-w)
        poses.append(lr.Rigid(turn, np.append(rng.uniform(-1.5, 1.5, 2), rng.uniform(-0.2, 0.2))))
        scans[f"scan {k}"] = {
            f"T{n}": lr.SurveyTarget(
                center + rng.normal(0, _SIGMA_M, 3), _SIGMA_M**2 * np.eye(3), 0.0725, _SIGMA_M, 50, 0
            )
            for n, center in enumerate(poses[k].inverse @ places)
        }
    return scans, poses, places


def _levels(**changes: float) -> dict[str, float]:
    return {f"scan {k}": _LEVEL_DEG for k in range(4)} | changes


def _errors(found: lr.TargetNetwork, poses: list[lr.Rigid], world: lr.Rigid) -> tuple[float, float]:
    """Return the Mahalanobis distance of the free poses over the root of their unknowns, and the RMS tilt, deg."""
    up = world.rotation[:, 2]
    each, tilts = [], []
    for pose, true in zip(found.world_from_scanner.values(), (world @ pose for pose in poses), strict=True):
        w = rotvec_from_rotation(true.rotation @ pose.rotation.T)
        each += [w, true.translation - pose.translation]
        tilts.append(np.degrees(np.linalg.norm(w - up * (up @ w))))
    free = np.diag(found.covariance) > 0
    errors, covariance = np.concatenate(each)[free], found.covariance[np.ix_(free, free)]
    distance = np.sqrt(errors @ np.linalg.solve(covariance, errors) / free.sum())
    return float(distance), float(np.sqrt(np.mean(np.square(tilts))))


@pytest.mark.slow
@pytest.mark.parametrize("has_coordinates", [False, True])
def test_levels_hold_the_tilt_as_their_covariance_says(has_coordinates: bool) -> None:
    found: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    for seed in range(25):
        scans, poses, places = _network(seed)
        rng = np.random.default_rng(seed)
        coordinates = {f"T{n}": places[n] + rng.normal(0, 0.002, 3) for n in range(3)} if has_coordinates else {}
        world = lr.Rigid.identity() if has_coordinates else poses[0].inverse
        for is_used in found:
            placed = lr.register_targets(scans, coordinates, sigma_m=0.002, levels=_levels() if is_used else {})
            assert not placed.reasons
            found[is_used].append(_errors(placed, poses, world))
    distance, tilt = np.sqrt(np.mean(np.square([found[True], found[False]]), axis=1)).T
    assert distance == pytest.approx([1, 1], abs=0.1)
    assert tilt[0] < 0.75 * tilt[1]


def test_a_scan_that_leans_is_named_and_its_level_is_not_used() -> None:
    scans, poses, _ = _network(1, lean_deg=0.5)
    placed = lr.register_targets(scans, levels=_levels())
    assert len(placed.reasons) == 1
    assert placed.reasons[0].startswith("The level of scan scan 3 contradicts the targets and is not used")
    assert not placed.left_out
    assert _errors(placed, poses, poses[0].inverse)[0] < 1.6


def test_levels_count_in_the_sum_of_squares_and_nothing_else_changes_without_them() -> None:
    scans, _, _ = _network(2)
    plain, levelled = lr.register_targets(scans), lr.register_targets(scans, levels=_levels())
    assert levelled.dof == plain.dof + 2 * 4 - 2, "two of each, less the up of all"
    assert levelled.chi2 > plain.chi2
    alone = lr.register_targets(scans, levels={"scan 2": 0.001})
    assert alone.dof == plain.dof
    assert alone.chi2 == pytest.approx(plain.chi2), "the level of one scan says nothing of the others"
    assert np.allclose(alone.covariance, plain.covariance)


def test_a_level_is_given_as_a_covariance_too() -> None:
    scans, _, _ = _network(3)
    covariance = np.diag([np.radians(_LEVEL_DEG) ** 2] * 2 + [0.0])
    by_number = lr.register_targets(scans, levels=_levels())
    by_matrix = lr.register_targets(scans, levels=dict.fromkeys(scans, covariance))
    assert np.allclose(by_number.covariance, by_matrix.covariance)


@pytest.mark.parametrize(
    ("levels", "said"),
    [
        ({"attic": 0.02}, r"the level of 'attic' is given, which is none of several scans"),
        ({"scan 0": -0.1}, r"the level of scan scan 0, deg is -0.1"),
        ({"scan 0": float("nan")}, r"the level of scan scan 0, deg is nan"),
        ({"scan 0": np.zeros((3, 3))}, r"the covariance of the level of scan scan 0 is none of a level"),
        ({"scan 0": [0.1, 0.1]}, r"the level of scan scan 0 has the shape 2; it must be 3 x 3"),
    ],
)
def test_bad_levels_are_refused(levels: dict[str, float], said: str) -> None:
    scans, _, _ = _network(4)
    with pytest.raises((OptionError, ShapeError), match=said):
        lr.register_targets(scans, levels=levels)
