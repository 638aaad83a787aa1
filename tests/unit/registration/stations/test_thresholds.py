"""Every threshold of the verdict on two stations decides, and names its reason."""

from __future__ import annotations

from typing import Any

import pytest

from ladarreg_core.registration.stations.pair import PairOptions, Prepared, check_pair, prepare, register_pair
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose
from testing.scenes.kept import kept

pytest.importorskip("embreex")
pytestmark = pytest.mark.slow
FIRST = upright_pose([-1.3, -0.5, 0.0], 0.7, (0.01, -0.008))
SECOND = upright_pose([1.4, 0.8, 0.15], -2.1, (-0.012, 0.004))


@kept
def _prepared() -> list[Prepared]:
    scans = scan_stations(station_room("office", 3), [FIRST, SECOND], seed=1, step_deg=0.9)
    return [prepare(scan) for scan in scans]


@pytest.fixture(scope="module")
def stations() -> list[Prepared]:
    return _prepared()


@pytest.mark.parametrize(
    ("threshold", "verdict", "reason"),
    [
        ({}, "verified", "surfaces agree"),
        ({"least_overlap": 0.99}, "refused", "measured from both stations"),
        ({"most_contradicted": 0.0}, "refused", "saw through"),
        ({"least_held_out": 10_000}, "ambiguous", "left to check the alignment by"),
        ({"most_held_out_ratio": 0.5}, "refused", "as far apart as their noise"),
        ({"print_margin": 2.0}, "refused", "do not show the same print"),
    ],
    ids=lambda value: next(iter(value), "none") if isinstance(value, dict) else "",
)
def test_scans_at_a_stated_pose(stations: list[Prepared], threshold: dict[str, Any], verdict: str, reason: str) -> None:
    pair = check_pair(*stations, FIRST.inverse @ SECOND, options=PairOptions(**threshold))
    assert pair.verdict == verdict
    assert reason in " ".join(pair.reasons)


@pytest.mark.parametrize(
    ("threshold", "verdict", "reason"),
    [
        ({"alternative_contradicted": 1.0}, "ambiguous", "Another placement"),
        ({"alternative_contradicted": 1.0, "alternative_overlap": 0.9}, "verified", "surfaces agree"),
        ({"most_sigma_mm": 1e-4}, "ambiguous", "do not determine a shift along"),
        ({"most_sigma_deg": 1e-6}, "ambiguous", "do not determine a turn about"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_scans_that_were_searched(
    stations: list[Prepared], threshold: dict[str, Any], verdict: str, reason: str
) -> None:
    pair = register_pair(*stations, options=PairOptions(**threshold))
    assert pair.verdict == verdict
    assert reason in " ".join(pair.reasons)
