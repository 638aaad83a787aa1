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
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.progress import Progress
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


@pytest.mark.slow
def test_scans_without_intensity_are_registered_by_their_ranges(office: list[Scan]) -> None:
    dark = [replace(scan, intensity=np.zeros(scan.shape, np.float32)) for scan in office]
    network = lr.register_scans(dark)
    assert network.accepted, network.pairs[0].reasons
    assert np.isnan(network.pairs[0].evidence.print_correlation)
    assert off(network, 1, FIRST.inverse @ SECOND)[0] < 1.0


@pytest.mark.slow
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


@pytest.mark.slow
def test_poses_in_the_files_are_where_it_begins_and_wrong_ones_are_overcome(office: list[Scan]) -> None:
    world = Rigid.from_rotvec([0, 0, 1.0], [4000.0, -300.0, 20.0])
    rough = Rigid.from_rotvec([0, 0, 0.03], [0.15, -0.1, 0.02])
    placed = [
        replace(office[0], world_from_scanner=world),
        replace(office[1], world_from_scanner=world @ FIRST.inverse @ SECOND @ rough),
    ]
    network = lr.register_scans(placed)
    assert network.pairs[0].start == "poses in the files"
    assert off(network, 1, world @ FIRST.inverse @ SECOND)[0] < 1.0
    wrong = [placed[0], replace(office[1], world_from_scanner=world @ Rigid.from_rotvec([0, 0, 2.0], [3.0, 9.0, 0.0]))]
    network = lr.register_scans(wrong)
    assert network.pairs[0].start == "search"
    assert off(network, 1, world @ FIRST.inverse @ SECOND)[0] < 1.0


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
    ],
)
def test_wrong_arguments_are_refused(office: list[Scan], wrong: Callable[[list[Scan]], object]) -> None:
    with pytest.raises(OptionError):
        wrong(office)
