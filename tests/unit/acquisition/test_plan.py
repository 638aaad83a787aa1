"""Plans: read and written, every fault listed; stops and forecasts."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.acquisition.interfaces import PanTilt, UnitIdentity
from ladarreg_core.acquisition.mount_fields import base_from_value, lean_covariance
from ladarreg_core.acquisition.plan import write_plan
from ladarreg_core.acquisition.plan_reading import plan_from_fields, read_plan
from ladarreg_core.acquisition.runs.stops import forecast, require_possible, stops_of
from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.frames import rotvec_from_rotation

SWEEP: dict[str, Any] = {
    "version": 1,
    "unit": {"kind": "flir-ptu", "port": "/dev/ttyUSB0", "baud": 9600, "signs": [1, -1]},
    "scanner": {"kind": "scip2", "port": "/dev/ttyACM0"},
    "camera": None,
    "mode": "sweep",
    "pan_deg": [-90, 90, 0.5],
    "tilt_deg": [-20, 20, 20],
    "settle_s": 0.3,
    "mount": {"xyz_m": [0.1, 0.0, 0.05], "rpy_deg": [90, 0, 0]},
}
UNIT = UnitIdentity("unit", PanTilt(2e-4, 2e-4), PanTilt(-2.8, -0.8), PanTilt(2.8, 0.5), PanTilt(0.5, 0.5))


def with_change(**changes: Any) -> dict[str, Any]:
    fields = copy.deepcopy(SWEEP)
    for path, value in changes.items():
        *parents, name = path.split("__")
        target = fields
        for parent in parents:
            target = target[parent]
        target[name] = value
    return fields


def test_a_plan_survives_the_file(tmp_path: Path) -> None:
    plan = plan_from_fields(SWEEP)
    write_plan(tmp_path / "plan.json", plan)
    again = read_plan(tmp_path / "plan.json")
    assert again.as_fields() == plan.as_fields()
    np.testing.assert_allclose(again.mount.matrix, plan.mount.matrix, atol=1e-12)
    np.testing.assert_allclose(plan.mount.rotation @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # its left side is up


def test_a_unit_that_hangs_or_leans_is_stated_with_the_mount(tmp_path: Path) -> None:
    upright = plan_from_fields(SWEEP)
    assert "base" not in upright.as_fields()["mount"]
    assert plan_from_fields(with_change(mount__base="upright")).as_fields() == upright.as_fields()
    hanging = plan_from_fields(with_change(mount__base="hanging"))
    np.testing.assert_array_equal(hanging.base.rotation, np.diag([1.0, -1.0, -1.0]))
    assert hanging.as_fields()["mount"]["base"] == "hanging"
    leaning = plan_from_fields(with_change(mount__base=[2.5, -1, 30]))
    write_plan(tmp_path / "plan.json", leaning)
    np.testing.assert_allclose(read_plan(tmp_path / "plan.json").base.matrix, leaning.base.matrix, atol=1e-12)
    assert leaning.base_sigma_deg is None
    for stated, read in ((0.05, (0.05, 0.05)), ([0.02, 0.1], (0.02, 0.1))):
        write_plan(tmp_path / "plan.json", plan_from_fields(with_change(mount__base_sigma_deg=stated)))
        assert read_plan(tmp_path / "plan.json").base_sigma_deg == read


@pytest.mark.parametrize("base", [[0, 0, 0], [180, 0, 0], [2.5, -1, 30], [175, 20, -100], [40, -60, 10]])
def test_the_covariance_of_a_level_is_the_scatter_of_what_an_inclinometer_reads(base: list[float]) -> None:
    sigma_deg, rng = (0.05, 0.12), np.random.default_rng(4)
    stated = base_from_value(base)
    readings = [base_from_value([base[0] + r, base[1] + p, base[2]]) for r, p in rng.normal(0, sigma_deg, (4000, 2))]
    w = np.array([rotvec_from_rotation(true.rotation @ stated.rotation.T) for true in readings])
    covariance = lean_covariance(stated, sigma_deg)
    np.testing.assert_allclose(w.T @ w / len(w), covariance, atol=0.08 * np.trace(covariance))
    assert np.linalg.matrix_rank(covariance, tol=1e-12) == 2, "which way is ahead was not measured"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"mount__base": "upside down"},
            "'base' of 'mount': the base is 'upside down'; it must be",
        ),
        ({"mount__base": [0, 0]}, "roll, pitch and yaw in degrees"),
        ({"mount__base_sigma_deg": -0.1}, "'base_sigma_deg' of 'mount': the sigma of the base is -0.1"),
        ({"mount__base_sigma_deg": [0.1, "x"]}, "the standard deviation of roll and pitch in degrees"),
        ({"mount__base_sigma_deg": [0.1, 0.1, 0.1]}, "or one of each"),
        ({"mount__base": [0, 400, 0]}, "within 360"),
        ({"mount__base": [0, True, 0]}, "roll, pitch and yaw in degrees"),
        ({"version": 2}, "'version' is 2"),
        ({"speed": 1}, "unknown key 'speed'"),
        ({"pan_degs": 1}, "did you mean 'pan_deg'"),
        ({"mode": "spin"}, "must be 'sweep' or 'mosaic'"),
        ({"mode": "mosaic"}, "needs a scanner of kind 'folder'"),
        ({"pan_deg": [0, 90, -1]}, "lead away"),
        ({"pan_deg": [0, 90, 0]}, "steps of 0"),
        ({"pan_deg": [0, 1, 5]}, "beyond its end"),
        ({"pan_deg": [0, math.nan, 5]}, "three angles"),
        ({"pan_deg": [0, 900, 5]}, "angles lie within 360"),
        ({"pan_deg": [-180, 180, 1e-4]}, "stops; at most"),
        ({"tilt_deg": [True, 1, 1]}, "three angles"),
        ({"settle_s": -1}, "'settle_s'"),
        ({"settle_s": 10**400}, "'settle_s'"),
        ({"passes": 1.5}, "'passes'"),
        ({"continuous": 1}, "true or false"),
        ({"unit__port": ""}, "give a serial port"),
        ({"unit__signs": [1, 0]}, "two of 1 and -1"),
        ({"unit__baud": "9600"}, "'baud'"),
        ({"scanner__port": "/dev/ttyUSB0"}, "same port"),
        ({"scanner": "scip2"}, "must be an object"),
        ({"scanner": {"kind": "folder", "folder": "/absent/folder"}}, "does not exist"),
        ({"mode": "mosaic", "scanner": {"kind": "packets"}}, "'udp_port' of 'scanner' is 0"),
        ({"scanner": {"kind": "packets", "udp_port": 2368}}, "use 'mosaic' for others"),
        ({"scanner": {"kind": "packets", "udp_port": 1, "sensor_file": "/absent.json"}}, "does not exist; correct it"),
        ({"scanner": {"kind": "packets", "udp_port": 1, "host": 5}}, "'host' of 'scanner' is 5; give a text"),
        ({"scanner": {"kind": "packets", "host": "twin:velodyne?sed=1"}}, "an argument 'sed'"),
        ({"scanner": {"kind": "packets", "udp_port": 1, "folder": "x"}}, "unknown key 'folder'"),
        ({"mount__xyz_m": [0, 0]}, "three lengths"),
        ({"mount__rpy_deg": [0, 0, "a"]}, "roll, pitch and yaw"),
        ({"camera": {}}, "either 'folder' or 'device'"),
    ],
)
def test_faults_are_named(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(OptionError, match=said):
        plan_from_fields(with_change(**changes))


def test_all_faults_are_listed_at_once(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(with_change(mode="spin", unit__baud=1, pan_deg=[0, 90, 0])))
    with pytest.raises(FormatError, match=r"plan\.json: the plan has 3 faults: \(1\) .*\(2\) .*\(3\)"):
        read_plan(path)


def test_pieces_that_do_not_overlap_are_refused(tmp_path: Path) -> None:
    scanner = {"kind": "folder", "folder": str(tmp_path), "fov_deg": [50, 40]}
    with pytest.raises(OptionError, match=r"do not overlap; take steps of 42\.5 deg or less"):
        plan_from_fields(with_change(mode="mosaic", scanner=scanner, pan_deg=[0, 150, 50]))
    plan = plan_from_fields(with_change(mode="mosaic", scanner=scanner, pan_deg=[0, 120, 40]))
    assert forecast(plan).overlap == pytest.approx((0.2, 0.5))


def test_a_lidar_that_sends_packets_is_planned(tmp_path: Path) -> None:
    sensor = tmp_path / "sensor.json"
    sensor.write_text("{}")
    scanner = {"kind": "packets", "udp_port": 7502, "host": "192.168.1.20", "sensor_file": str(sensor)}
    plan = plan_from_fields(with_change(mode="mosaic", scanner=scanner, pan_deg=[0, 40, 40]))
    assert (plan.scanner.udp_port, plan.scanner.host, plan.scanner.timeout_s) == (7502, "192.168.1.20", 10.0)
    assert plan_from_fields(plan.as_fields()).scanner == plan.scanner
    twin = {"kind": "packets", "host": "twin:velodyne?seed=2", "fov_deg": [360, 30]}
    plan = plan_from_fields(with_change(mode="mosaic", scanner=twin, pan_deg=[0, 40, 40]))
    assert plan_from_fields(plan.as_fields()).scanner == plan.scanner


def test_what_the_unit_cannot_do_is_refused() -> None:
    require_possible(plan_from_fields(SWEEP), UNIT)
    wide = plan_from_fields(with_change(tilt_deg=[-60, 20, 20], pan_deg=[0, 1, 0.005]))
    with pytest.raises(OptionError, match=r"2 faults: .*finer than the unit's 0.0115.*'tilt_deg' goes from -60"):
        require_possible(wide, UNIT)


def test_stops_go_back_and_forth() -> None:
    plan = plan_from_fields(with_change(pan_deg=[0, 2, 1], tilt_deg=[0, 10, 10]))
    pans = [round(math.degrees(stop.at.pan_rad)) for stop in stops_of(plan)]
    assert pans == [0, 1, 2, 2, 1, 0]
    assert [stop.index for stop in stops_of(plan)] == list(range(6))
    passes = stops_of(plan_from_fields(with_change(continuous=True, tilt_deg=[0, 0, 0], camera=None)))
    assert [(round(math.degrees(s.at.pan_rad)), round(math.degrees(s.to.pan_rad))) for s in passes if s.to] == [
        (-90, 90), (90, -90),
    ]  # fmt: skip


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=6,
)


@pytest.mark.slow
@given(st.sampled_from([*SWEEP, "unit__signs", "unit__port", "scanner__kind", "mount__xyz_m"]), JSON)
def test_any_value_anywhere_is_a_plan_or_a_sentence(key: str, value: Any) -> None:
    try:
        plan_from_fields(with_change(**{key: value}))
    except LadarregError as error:
        text = str(error)
    else:
        text = "a plan"
    assert text
    assert "\n" not in text
