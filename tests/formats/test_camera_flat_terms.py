"""Distortion terms that stand as fields of their own beside fx, fy, cx, cy."""

import json

import pytest

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.camera_file import read_camera

_PLAIN = {"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0}


def _written(tmp_path, **more):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(_PLAIN | more))
    return file


@pytest.mark.parametrize(
    ("flat", "terms"),
    [
        ({"k1": 0.1, "k2": -0.2, "p1": 0.001, "p2": 0.002}, (0.1, -0.2, 0.001, 0.002)),
        ({"k1": 0.1}, (0.1, 0.0, 0.0, 0.0)),
        ({"k1": 0.1, "k2": -0.2, "k3": 0.03}, (0.1, -0.2, 0.0, 0.0, 0.03)),
        ({"k1": 0.1, "k4": 0.04}, (0.1, 0.0, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0)),
    ],
)
def test_flat_terms_are_read_in_opencv_order(tmp_path, flat, terms):
    assert read_camera(_written(tmp_path, **flat)).distortion == terms


@pytest.mark.parametrize(
    ("more", "reason"), [({"distortion": [0.1, 0, 0, 0]}, "twice"), ({"model": "fisheye"}, "pinhole")]
)
def test_flat_terms_that_could_mean_two_things_are_refused(tmp_path, more, reason):
    with pytest.raises(FormatError, match=reason):
        read_camera(_written(tmp_path, k1=0.1, **more))
