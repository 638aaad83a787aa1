"""Simulated cases, each simulated once in a run of the tests; the ray caster takes some seconds for every one."""

from __future__ import annotations

from ladarreg_core.simulate import SimulatedCase, simulate_case
from ladarreg_core.simulate.outdoor_case import OutdoorCase, simulate_outdoors
from ladarreg_core.simulate.panorama import PanoramaCase, PanoramaOptions, simulate_panorama
from ladarreg_core.simulate.robot_lidar import LidarName
from testing.scenes.kept import kept

COMMON_SEED = 101
"""The seed of tests that need some room and no particular one."""


@kept
def simulated(
    scene: str,
    *,
    set_name: str = "standard",
    seed: int = COMMON_SEED,
    k1: float = 0.0,
    k1_error: float = 0.0,
    focal_error: float = 0.0,
) -> SimulatedCase:
    """Return a room with its scan and its photograph."""
    return simulate_case(scene, set_name=set_name, seed=seed, k1=k1, k1_error=k1_error, focal_error=focal_error)


@kept
def outdoors(scene: str, *, lidar: LidarName, seed: int) -> OutdoorCase:
    """Return a place outdoors as the lidar of a robot and a camera see it."""
    return simulate_outdoors(scene, lidar=lidar, seed=seed)


@kept
def all_around(scene: str, *, seed: int, options: PanoramaOptions) -> PanoramaCase:
    """Return a room scanned all around, and its panorama."""
    return simulate_panorama(scene, seed=seed, options=options)
