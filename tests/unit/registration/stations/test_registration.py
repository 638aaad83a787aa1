"""Stations registered to each other by their ranges, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import Cancelled, OptionError
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose
from testing.scenes.kept import kept

pytest.importorskip("embreex")
FIRST = upright_pose([-1.3, -0.5, 0.0], 0.7, (0.01, -0.008))
SECOND = upright_pose([1.4, 0.8, 0.15], -2.1, (-0.012, 0.004))


@kept
def _office() -> list[Scan]:
    return scan_stations(station_room("office", 3), [FIRST, SECOND], seed=1, step_deg=0.9)


@pytest.fixture(scope="module")
def office() -> list[Scan]:
    return _office()


@pytest.fixture(scope="module")
def boxes() -> Scan:
    return scan_stations(station_room("boxes", 4), [SECOND], seed=2, step_deg=0.9)[0]


def off(network: lr.StationNetwork, index: int, truth: Rigid) -> tuple[float, float, float]:
    """Return the error of a station, mm and deg, and its distance by the stated covariance."""
    station = network.stations[index]
    assert station.world_from_scanner is not None
    error = np.concatenate(
        [
            rotvec_from_rotation(truth.rotation @ station.world_from_scanner.rotation.T),
            truth.translation - station.world_from_scanner.translation,
        ]
    )
    distance = float(np.sqrt(error @ np.linalg.solve(station.covariance, error) / 6))
    return 1000 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(error[:3]))), distance


@pytest.mark.slow
def test_two_stations_are_registered_from_nothing(office: list[Scan]) -> None:
    told: list[Progress] = []
    network = lr.register_scans(office, report=told.append)
    assert network.accepted, network.pairs[0].reasons
    mm, deg, distance = off(network, 1, FIRST.inverse @ SECOND)
    assert mm < 1.0
    assert deg < 0.02
    assert distance < 3
    assert network.pairs[0].evidence.contradicted < 0.01
    assert all(before.done <= after.done <= after.total for before, after in pairwise(told))
    stated = json.loads(network.to_json())
    assert stated["pairs"][0]["verdict"] == "verified"
    pose = np.array(stated["stations"][1]["world_from_scanner"])
    assert np.array_equal(pose, network.stations[1].world_from_scanner.matrix)  # type: ignore[union-attr]


@pytest.mark.long
def test_scans_without_intensity_are_registered_by_their_ranges(office: list[Scan]) -> None:
    dark = [replace(scan, intensity=np.zeros(scan.shape, np.float32)) for scan in office]
    network = lr.register_scans(dark)
    assert network.accepted, network.pairs[0].reasons
    assert np.isnan(network.pairs[0].evidence.print_correlation)
    assert off(network, 1, FIRST.inverse @ SECOND)[0] < 1.0


@pytest.mark.long
def test_another_room_stays_out(office: list[Scan], boxes: Scan) -> None:
    network = lr.register_scans([office[0], boxes])
    assert not network.accepted
    pair = network.pairs[0]
    assert pair.verdict == "refused"
    assert network.stations[1].world_from_scanner is None
    stated = pair.as_fields()
    assert stated["first_from_second"] is None
    assert stated["rejected_guess"]["first_from_second"] == pair.first_from_second.matrix.tolist()
    assert len(network.placed([office[0], boxes])) == 1


@pytest.mark.long
def test_poses_in_the_files_are_refined_and_wrong_ones_are_not_left_by_themselves(office: list[Scan]) -> None:
    world = Rigid.from_rotvec([0, 0, 1.0], [4000.0, -300.0, 20.0])
    rough = Rigid.from_rotvec([0, 0, 0.03], [0.15, -0.1, 0.02])
    placed = [
        replace(office[0], world_from_scanner=world),
        replace(office[1], world_from_scanner=world @ FIRST.inverse @ SECOND @ rough),
    ]
    network = lr.register_scans(placed)
    assert network.pairs[0].start == "poses in the files"
    assert off(network, 1, world @ FIRST.inverse @ SECOND)[0] < 1.0
    stated = network.pairs[0].as_fields()["stated"]
    assert 150 < stated["away_mm"] < 220
    assert stated["contradicted"] > 0.015
    wrong = [placed[0], replace(office[1], world_from_scanner=world @ Rigid.from_rotvec([0, 0, 2.0], [3.0, 9.0, 0.0]))]
    network = lr.register_scans(wrong)
    assert not network.accepted
    pair = network.pairs[0]
    guess, said = pair.first_from_second, wrong[0].world_from_scanner.inverse @ wrong[1].world_from_scanner  # type: ignore[union-attr, operator]
    assert np.linalg.norm(guess.translation - said.translation) <= 1.0
    assert "`poses='search'` looks everywhere" in pair.reasons[-1]
    network = lr.register_scans(wrong, poses="search")
    assert network.pairs[0].start == "search"
    assert off(network, 1, world @ FIRST.inverse @ SECOND)[0] < 1.0
    assert network.pairs[0].stated is not None
    assert network.pairs[0].as_fields()["stated"]["away_mm"] > 5000


@pytest.mark.long
def test_exact_poses_are_kept_and_what_they_show_is_stated(office: list[Scan], boxes: Scan) -> None:
    world = Rigid.from_rotvec([0, 0, 1.0], [4000.0, -300.0, 20.0])
    exact = world @ FIRST.inverse @ SECOND
    elsewhere = world @ Rigid.from_rotvec([0, 0, 0.3], [40.0, 0.0, 0.0])
    scans = [replace(scan, world_from_scanner=pose) for scan, pose in zip(office, (world, exact), strict=True)]
    network = lr.register_scans(scans, poses="keep")
    assert network.accepted, network.pairs[0].reasons
    assert [one.state for one in network.stations] == ["fixed", "kept"]
    assert network.stations[1].world_from_scanner is exact
    stated = network.pairs[0].as_fields()["stated"]
    assert stated["away_mm"] == 0
    assert stated["contradicted"] < 0.015
    assert stated["overlap"] > 0.25
    # A station that shares nothing keeps its place, too, which nothing verifies: to refine it is no reason to lose it.
    for use in ("keep", "refine"):
        network = lr.register_scans([*scans, replace(boxes, world_from_scanner=elsewhere)], poses=use)  # type: ignore[arg-type]
        assert not network.accepted
        assert network.stations[2].state == "stated"
        assert network.stations[2].world_from_scanner is elsewhere
        assert any("not verified" in reason for reason in network.reasons)
    # Neither keeps a wrong one as right.
    wrong = replace(office[1], world_from_scanner=exact @ Rigid.from_rotvec([0, 0, 0.05], [0.3, 0.0, 0.0]))
    network = lr.register_scans([scans[0], wrong], poses="keep")
    assert not network.accepted
    assert network.stations[1].state == "stated"
    assert "stands where the other one saw through" in " ".join(network.pairs[0].reasons)
    json.loads(network.to_json())


@pytest.mark.long
def test_a_second_component_is_kept(office: list[Scan], boxes: Scan) -> None:
    network = lr.register_scans([boxes, *office])
    assert [one.state for one in network.stations] == ["fixed", "out", "out"]
    assert [one.component for one in network.stations] == [0, 1, 1]
    within = [one.component_from_scanner for one in network.stations]
    assert within[0] is None
    assert within[1] is not None
    assert within[2] is not None
    between = within[1].inverse @ within[2]
    assert between.distance_to(FIRST.inverse @ SECOND) < 0.001
    # Where the files say how the components lie, the second one is adjusted, and stands there.
    world = Rigid.from_rotvec([0, 0, 1.0], [4000.0, -300.0, 20.0])
    far = world @ Rigid.from_rotvec([0, 0, 0.3], [40.0, 0.0, 0.0])
    rough = FIRST.inverse @ SECOND @ Rigid.from_rotvec([0, 0, 0.02], [0.1, 0.0, 0.0])
    placed = [
        replace(scan, world_from_scanner=pose)
        for scan, pose in zip([boxes, *office], (world, far, far @ rough), strict=True)
    ]
    network = lr.register_scans(placed)
    assert [one.state for one in network.stations] == ["fixed", "stated", "stated"]
    poses = [one.world_from_scanner for one in network.stations]
    assert poses[1] is not None
    assert poses[2] is not None
    assert poses[1].distance_to(far) < 1e-9
    assert (poses[1].inverse @ poses[2]).distance_to(FIRST.inverse @ SECOND) < 0.001
    assert len(network.placed(placed)) == 3


@pytest.mark.slow
def test_it_can_be_stopped(office: list[Scan]) -> None:
    def stop(progress: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        lr.register_scans(office, report=stop)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda scans: lr.register_scans(scans[:1]),
        lambda scans: lr.register_scans(scans, fixed=2),
        lambda scans: lr.register_scans([scans[0], "office.npz"]),
        lambda scans: lr.register_scans(scans, poses="exact"),
        lambda scans: lr.register_scans(scans, poses="keep"),  # they state none
    ],
)
def test_wrong_arguments_are_refused(office: list[Scan], wrong: Callable[[list[Scan]], object]) -> None:
    with pytest.raises(OptionError):
        wrong(office)
