"""Existing rooms and cases stay bit for bit: results that were published with them must remain reproducible."""

from __future__ import annotations

import hashlib
import platform
from dataclasses import fields

import numpy as np
import pytest

from ladarreg_core.simulate.case import case_world, simulate_case
from ladarreg_core.simulate.panorama import PanoramaOptions, simulate_panorama
from ladarreg_core.simulate.world import World

pytestmark = pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"),
    reason="the last bits of sines and square roots differ between platforms",
)
ROOMS = {
    ("boxes", "standard"): "f633d25659ed56ce",
    ("desk", "standard"): "ff97713759f2cebf",
    ("office", "standard"): "bd4a56a7aa22be8d",
    ("people", "standard"): "da2fa0942704d161",
    ("office", "thermal"): "4102bf06c4268747",
}


def digest(*arrays: object) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:16]


def digest_of_world(world: World) -> str:
    return digest(*(getattr(world, f.name) for f in fields(world) if f.name != "focus_m"))


@pytest.mark.parametrize(("scene", "set_name"), ROOMS)
def test_rooms_stay(scene: str, set_name: str) -> None:
    assert digest_of_world(case_world(scene, set_name=set_name, seed=3)) == ROOMS[scene, set_name]


def test_cases_stay() -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    case = simulate_case("boxes", seed=2)
    assert digest(case.counts, case.intensity, case.photo.pixels) == "db9dcace53c9ecca"


def test_dome_scans_stay() -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    case = simulate_panorama("office", seed=1, options=PanoramaOptions(width=256, step_deg=1.0))
    assert digest(case.scan.ranges, case.scan.intensity, case.photo.pixels) == "cda436ebc26c5f13"
