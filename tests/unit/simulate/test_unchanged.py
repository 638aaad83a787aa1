"""Existing rooms and cases stay as they are: results that were published with them must remain reproducible.

The last bits of sines, products and blurs differ between processors, so arrays are compared by the means and spreads of
their slices, to within what a few values on the limit of a level can change.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.simulate.case import case_world, simulate_case
from ladarreg_core.simulate.panorama import PanoramaOptions, simulate_panorama
from ladarreg_core.simulate.worlds.world import World

_FILE = Path(__file__).with_name("prints.json")
_SLICES = 8
_ALLOWED = 1e-3  # of the spread of the whole array
ROOMS = (
    ("boxes", "standard"),
    ("desk", "standard"),
    ("office", "standard"),
    ("people", "standard"),
    ("office", "thermal"),
)

Print = list[list[float]]
"""Number of values and of finite ones; then the mean and the spread of each slice."""


def print_of(array: NDArray[np.generic]) -> Print:
    """Return the print of an array; 32-bit texels count as their bytes."""
    values = array.view(np.uint8) if array.dtype == np.uint32 else array
    flat = values.reshape(-1).astype(np.float64)
    rows = [[float(flat.size), float(np.isfinite(flat).sum())]]
    for part in np.array_split(flat, _SLICES):
        finite = part[np.isfinite(part)]
        rows.append([float(f"{value:.7g}") for value in (finite.mean(), finite.std())] if finite.size else [0.0, 0.0])
    return rows


def agrees(found: Print, known: Print) -> bool:
    """Return whether two prints are of the same array, whatever processor computed it."""
    (size, finite), *found_rows = found
    (known_size, known_finite), *known_rows = known
    if size != known_size or abs(finite - known_finite) > _ALLOWED * size:
        return False
    ours, theirs = np.array(found_rows), np.array(known_rows)
    spread = max(float(np.abs(theirs).max()) * 1e-3, float(theirs[:, 1].max()))
    return bool(np.abs(ours - theirs).max() <= _ALLOWED * spread)


def prints_of_world(world: World) -> dict[str, Print]:
    """Return the prints of all arrays of a world."""
    return {f.name: print_of(np.asarray(getattr(world, f.name))) for f in fields(world) if f.name != "focus_m"}


def prints_of_case(seed: int = 2) -> dict[str, Print]:
    """Return the prints of a scan and its photograph."""
    case = simulate_case("boxes", seed=seed)
    return {
        "counts": print_of(case.counts),
        "intensity": print_of(case.intensity),
        "photo": print_of(case.photo.pixels),
    }


def prints_of_dome(seed: int = 1) -> dict[str, Print]:
    """Return the prints of a scan all around and its photograph."""
    case = simulate_panorama("office", seed=seed, options=PanoramaOptions(width=256, step_deg=1.0))
    return {
        "ranges": print_of(case.scan.ranges),
        "intensity": print_of(np.asarray(case.scan.intensity)),
        "photo": print_of(case.photo.pixels),
    }


def assert_stays(name: str, found: Mapping[str, Print]) -> None:
    """Fail with the names of the arrays that have changed."""
    known = json.loads(_FILE.read_text(encoding="utf-8"))[name]
    assert list(found) == list(known)
    assert not [array for array, kept in found.items() if not agrees(kept, known[array])]


@pytest.mark.parametrize(("scene", "set_name"), ROOMS)
@pytest.mark.slow
def test_rooms_stay(scene: str, set_name: str) -> None:
    assert_stays(f"{scene}, {set_name}", prints_of_world(case_world(scene, set_name=set_name, seed=3)))


@pytest.mark.slow
def test_cases_stay() -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    assert_stays("case", prints_of_case())


def test_dome_scans_stay() -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    assert_stays("dome", prints_of_dome())


@pytest.mark.slow
def test_another_seed_is_another_room() -> None:
    """The comparison sees what it is for: rooms of other seeds differ in their faces and inks."""
    one, two = (prints_of_world(case_world("desk", set_name="standard", seed=seed)) for seed in (3, 4))
    differing = [name for name in one if not agrees(one[name], two[name])]
    assert {"triangles", "texels"} <= set(differing)


def test_slightly_changed_arrays_are_told_from_rounded_ones() -> None:
    values = np.random.default_rng(1).normal(size=100_000)
    assert agrees(print_of(values + 1e-9), print_of(values))
    assert not agrees(print_of(values * 1.01), print_of(values))
    assert not agrees(print_of(values + 0.01), print_of(values))
