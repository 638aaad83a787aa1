"""A photograph that was registered at one station is verified at another, by the stations' poses alone."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.photo import Photo
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.stations import scan_stations, station_room, upright_pose

pytest.importorskip("embreex")


@pytest.mark.long
def test_a_photograph_of_one_station_is_verified_at_another() -> None:
    room = station_room("office", 3)
    poses = [upright_pose(np.array([-0.8, -0.4, 0.0]), 0.2), upright_pose(np.array([0.7, 0.6, 0.1]), -0.3)]
    scans = scan_stations(room, poses, seed=4, step_deg=0.4, width_deg=140)
    network = lr.register_scans(scans)
    assert network.accepted
    first, second = network.placed(scans)
    assert first.world_from_scanner is not None
    assert second.world_from_scanner is not None
    camera = Camera(640, 480, 480.0, 480.0, 319.5, 239.5)
    in_room = Rigid.from_centre(look_along([1.0, 0.15, -0.05]), np.array([-0.6, -0.1, 0.1]))
    pixels = take_photograph(*room, camera, in_room, lighting=Lighting(), rng=np.random.default_rng(3))
    photo = Photo(pixels=pixels, camera=camera, name="photo")
    at_first = in_room @ poses[0]
    # What is known at the first station is carried to the second by the world that they share.
    at_second = at_first @ first.world_from_scanner.inverse @ second.world_from_scanner
    assert at_second.distance_to(in_room @ poses[1]) < 0.002
    assert lr.verify_pose(second, photo, at_second).outcome == "verified"
