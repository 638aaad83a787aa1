"""Several scanners placed by the targets that their scans share, with and without coordinates."""

import json
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.frames import rotvec_from_rotation

_PLACES = np.random.default_rng(3).uniform([-8, -8, -1], [8, 8, 2], (12, 3))
_POSES = {
    name: lr.Rigid.from_rotvec([0.01, -0.02, turn], at)
    for name, turn, at in (("hall", 0.0, [0, 0, 0]), ("attic", 1.2, [3.0, -2.0, 2.5]), ("yard", -2.5, [-4, 5, 0.2]))
}
_SEEN = {"hall": range(8), "attic": range(2, 10), "yard": range(4, 12)}


def _target(center: np.ndarray, sigma_m: float = 0.0008, side_m: float | None = None) -> lr.SurveyTarget:
    radius = 0.0725 if side_m is None else None
    return lr.SurveyTarget(np.asarray(center), sigma_m**2 * np.eye(3), radius, 0.001, 50, 0, side_m)


def _scans(seed: int = 0, seen: Mapping[str, Sequence[int]] = _SEEN) -> dict[str, dict[str, lr.SurveyTarget]]:
    rng = np.random.default_rng(seed)
    return {
        name: {f"S{k}": _target(_POSES[name].inverse @ _PLACES[k] + rng.normal(0, 0.0008, 3)) for k in own}
        for name, own in seen.items()
    }


def _coordinates(*which: int, seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {f"S{k}": _PLACES[k] + rng.normal(0, 0.001, 3) for k in which}


def _moved(
    scans: dict[str, dict[str, lr.SurveyTarget]], scan: str, name: str, by: list[float]
) -> dict[str, dict[str, lr.SurveyTarget]]:
    return {**scans, scan: {**scans[scan], name: _target(scans[scan][name].center + by)}}


def _distance(found: lr.TargetNetwork, world: lr.Rigid) -> float:
    """Return the Mahalanobis distance of all free poses, over the root of their number of unknowns."""
    errors = np.concatenate([
        np.concatenate([
            rotvec_from_rotation((world @ _POSES[name]).rotation @ pose.rotation.T),
            (world @ _POSES[name]).translation - pose.translation,
        ])
        for name, pose in found.world_from_scanner.items()
    ])  # fmt: skip
    free = np.diag(found.covariance) > 0
    errors, covariance = errors[free], found.covariance[np.ix_(free, free)]
    return float(np.sqrt(errors @ np.linalg.solve(covariance, errors) / len(errors)))


def test_scans_are_placed_in_the_frame_of_the_first_without_coordinates():
    found = lr.register_targets(_scans())
    assert not found.in_coordinates
    assert np.array_equal(found.world_from_scanner["hall"].matrix, np.eye(4))
    assert not found.covariance_of("hall").any()
    assert _distance(found, _POSES["hall"].inverse) < 2
    assert found.left_out == ()
    assert found.dof == 3 * 20 - 3 * 8 - 12, "S0, S1, S10 and S11 are seen once and say nothing"
    assert "S0" not in found.residuals_m["hall"]
    assert all(np.linalg.norm(off) < 0.004 for own in found.residuals_m.values() for off in own.values())


def test_three_coordinates_that_no_single_scan_shows_put_all_scans_into_their_world():
    found = lr.register_targets(_scans(), _coordinates(0, 5, 11))
    assert found.in_coordinates
    assert set(found.coordinate_residuals_m) == {"S0", "S5", "S11"}
    assert _distance(found, lr.Rigid.identity()) < 2
    assert all((np.linalg.eigvalsh(found.covariance_of(name)) > 0).all() for name in _POSES)


@pytest.mark.parametrize("known", [(0, 5), ()])
def test_fewer_coordinates_do_not_make_a_world(known):
    found = lr.register_targets(_scans(), _coordinates(*known))
    assert not found.in_coordinates
    assert found.coordinate_residuals_m == {}
    assert ("of 2 targets in the scans" in " ".join(found.reasons)) == bool(known)


@pytest.mark.slow
def test_distances_and_covariances_hold_over_many_networks():
    squares = [_distance(lr.register_targets(_scans(seed), _coordinates(0, 3, 5, 8, seed=seed + 500)),
                         lr.Rigid.identity()) ** 2 for seed in range(40)]  # fmt: skip
    assert 0.85 < np.sqrt(np.mean(squares)) < 1.15


def test_the_pose_between_two_scans_has_the_covariance_of_both():
    found = lr.register_targets(_scans(4), _coordinates(0, 3, 5, 8))
    pose, covariance = found.between("attic", "yard")
    truth = _POSES["attic"].inverse @ _POSES["yard"]
    off = np.concatenate([rotvec_from_rotation(truth.rotation @ pose.rotation.T), truth.translation - pose.translation])
    assert off @ np.linalg.solve(covariance, off) / 6 < 3
    apart = np.trace(found.covariance_of("attic")[3:, 3:] + found.covariance_of("yard")[3:, 3:])
    assert np.trace(covariance[3:, 3:]) < apart, "both share the errors of the coordinates"


def test_a_target_that_was_moved_between_scans_is_left_out_and_named():
    found = lr.register_targets(_moved(_scans(), "attic", "S4", [0, 0.03, 0]))
    assert found.left_out == (("attic", "S4"),), "hall and yard agree on it"
    assert np.linalg.norm(found.residuals_m["attic"]["S4"]) == pytest.approx(0.03, abs=0.004)
    assert _distance(found, _POSES["hall"].inverse) < 2
    both = lr.register_targets(_moved(_scans(), "attic", "S2", [0, 0.03, 0]))
    assert both.left_out == (("hall", "S2"), ("attic", "S2")), "only two see it: either may be wrong"
    assert _distance(both, _POSES["hall"].inverse) < 2


def test_a_wrong_coordinate_is_left_out_and_named():
    coordinates = _coordinates(0, 3, 4, 5, 8) | {"S4": _PLACES[4] + [0.05, 0, 0]}
    found = lr.register_targets(_scans(), coordinates)
    assert found.left_out == ((None, "S4"),)
    assert _distance(found, lr.Rigid.identity()) < 2
    assert found.coordinate_residuals_m["S4"] == pytest.approx([0.05, 0, 0], abs=0.005)


def test_exchanged_names_in_one_scan_are_left_out():
    scans = _scans()
    own = scans["attic"]
    found = lr.register_targets({**scans, "attic": own | {"S4": own["S5"], "S5": own["S4"]}})
    assert set(found.left_out) == {("attic", "S4"), ("attic", "S5")}
    assert _distance(found, _POSES["hall"].inverse) < 2


def test_scans_that_share_too_few_targets_are_named():
    seen = {"hall": (0, 1, 2, 3, 4), "attic": (1, 2, 3, 4, 5), "yard": (4, 5, 6, 7)}
    with pytest.raises(DegenerateGeometryError, match=r"scan yard cannot be joined to scan hall and scan attic"):
        lr.register_targets(_scans(seen=seen))
    line = {
        name: {f"L{k}": _target(_POSES[name].inverse @ [k, 1.0, 0.0]) for k in range(4)} for name in ("hall", "attic")
    }
    with pytest.raises(DegenerateGeometryError, match="lie on a line"):
        lr.register_targets(line)


def test_contradictions_that_cannot_be_resolved_are_refused():
    seen = {"hall": (0, 1, 2, 3), "attic": (0, 1, 2, 3)}
    wrong = _moved(_moved(_scans(seen=seen), "attic", "S1", [0, 0.1, 0.3]), "attic", "S3", [0.2, 0.1, -0.3])
    with pytest.raises(DegenerateGeometryError, match="cannot be decided"):
        lr.register_targets(wrong)


def test_mixed_arguments_are_refused():
    scans = _scans()
    with pytest.raises(OptionError, match="some targets are given by scan"):
        lr.register_targets({**scans, "S1": scans["hall"]["S1"]})
    with pytest.raises(OptionError, match="give other scans as scans"):
        lr.register_targets(scans, scans["hall"])


def test_the_statement_is_json():
    fields = json.loads(json.dumps(lr.register_targets(_scans(), _coordinates(0, 3, 5)).as_fields()))
    assert [one["scan"] for one in fields["scans"]] == list(_POSES)
    assert all(one["used"] for scan in fields["scans"] for one in scan["targets"])
    assert {one["name"] for one in fields["coordinates"]} == {"S0", "S3", "S5"}


# --- names


def _unnamed(seed: int, false: int = 5) -> tuple[dict[str, list[lr.SurveyTarget]], dict[int, str]]:
    """Return found targets of scans in any order, false ones among them, and what each is by its identity."""
    rng = np.random.default_rng(seed)
    found, truth = {}, {}
    for scan, own in _scans(seed).items():
        listed = [*own.values(), *(_target(at) for at in rng.uniform([-6, -6, -1], [6, 6, 2], (false, 3)))]
        truth |= {id(one): name for name, one in own.items()}
        found[scan] = [listed[k] for k in rng.permutation(len(listed))]
    return found, truth


@pytest.mark.parametrize("seed", range(6))
def test_found_targets_are_named_by_each_other(seed):
    found, truth = _unnamed(seed)
    named = lr.name_targets(found)
    by_name: dict[str, set[str]] = {}
    for own in named.values():
        for name, one in own.items():
            by_name.setdefault(name, set()).add(truth.get(id(one), "none"))
    assert all(len(which) == 1 and which != {"none"} for which in by_name.values())
    assert len(by_name) == 8
    assert _distance(lr.register_targets(named), _POSES["hall"].inverse) < 2


def test_coordinates_name_what_they_are_of():
    found, truth = _unnamed(2)
    named = lr.name_targets(found, _coordinates(0, 1, 2, 3, 8))
    for own in named.values():
        assert all(truth[id(one)] == name for name, one in own.items() if name.startswith("S"))
    assert "S8" in named["yard"]
    with pytest.raises(DegenerateGeometryError, match="of 2 targets are given, and at least 3"):
        lr.name_targets(found, _coordinates(0, 1))


def test_a_scan_with_picks_names_the_others():
    found, truth = _unnamed(3)
    named = lr.name_targets({**found, "attic": _scans(3)["attic"]})
    for scan in ("hall", "yard"):
        assert all(truth[id(one)] == name for name, one in named[scan].items() if name.startswith("S"))
    assert _distance(lr.register_targets(named), _POSES["hall"].inverse) < 2


def test_a_look_alike_layout_is_refused():
    grid = np.array([[2.0 * i, 3.0 * j, 0.0] for i in range(4) for j in range(2)])
    found = {
        "hall": [_target(at) for at in grid[:6]],
        "attic": [_target(_POSES["attic"].inverse @ at) for at in grid[2:]],
    }
    with pytest.raises(DegenerateGeometryError, match="would fit in another way"):
        lr.name_targets(found)


def test_spheres_are_not_taken_for_flat_targets():
    found = {
        "hall": [_target(_PLACES[k]) for k in range(5)],
        "attic": [_target(_POSES["attic"].inverse @ _PLACES[k], side_m=0.15) for k in range(5)],
    }
    with pytest.raises(DegenerateGeometryError, match="scan attic"):
        lr.name_targets(found)


def test_a_target_that_was_moved_is_named_and_then_left_out():
    found = {scan: list(own.values()) for scan, own in _moved(_scans(), "attic", "S4", [0, 0.03, 0]).items()}
    registered = lr.register_targets(lr.name_targets(found))
    assert [scan for scan, _ in registered.left_out] == ["attic"]
    assert _distance(registered, _POSES["hall"].inverse) < 2
