"""Camera files of three makes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, FormatError, LadarregError
from ladarreg_core.formats import describe
from ladarreg_core.formats.cameras.camera_file import read_camera, write_camera
from ladarreg_core.formats.parsing.yaml_file import parse_yaml
from testing.files.seed_files import ROS

K1, K2 = 0.1, -0.03
focal = st.floats(10, 5000)
terms = st.sampled_from([0, 4, 5, 8]).flatmap(lambda n: st.lists(st.floats(-1, 1), min_size=n, max_size=n))
cameras = st.builds(
    lambda w, h, fx, fy, cx, cy, k: Camera(w, h, fx, fy, cx, cy, tuple(k)),
    st.integers(1, 9000), st.integers(1, 9000), focal, focal, st.floats(-10, 5000), st.floats(-10, 5000), terms,
)  # fmt: skip


@given(cameras)
def test_json_gives_back_the_camera_to_the_bit(tmp_path_factory: pytest.TempPathFactory, camera: Camera) -> None:
    path = tmp_path_factory.mktemp("camera") / "camera.json"
    write_camera(path, camera)
    assert read_camera(path) == camera


@given(camera=cameras, suffix=st.sampled_from([".yml", ".json"]), size_as_list=st.booleans())
def test_opencv_storage_gives_back_the_camera(
    tmp_path_factory: pytest.TempPathFactory, camera: Camera, suffix: str, size_as_list: bool
) -> None:
    path = tmp_path_factory.mktemp("camera") / f"camera{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("calibration_time", "Tue 14:05: noon #1")
    if size_as_list:
        storage.write("image_size", np.array([[camera.width, camera.height]]))
    else:
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.matrix)
    storage.write("distortion_coefficients", np.array(camera.distortion or (0.0,) * 5).reshape(-1, 1))
    storage.write("extrinsics", np.arange(24.0).reshape(4, 6))
    storage.release()
    assert read_camera(path) == camera


ROS_MESSAGE = """\
---
header:
  stamp: {sec: 1, nanosec: 2}
  frame_id: camera
height: 720
width: 1280
distortion_model: 'rational_polynomial'
d:
- 0.1
- -0.2
- 1.0e-03
- 0.002
- 0.05
- 0.0
- 0.0
- 0.0
k: [611.8, 0.0, 639.3, 0.0, 611.9, 365.9, 0.0, 0.0, 1.0]
binning_x: 0
---
height: 1
"""


@pytest.mark.parametrize("text", [ROS, ROS.replace("\n", "\r\n"), "\ufeff" + ROS, "%YAML:1.0\n---\n" + ROS])
def test_ros_calibration(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yaml").write_bytes(text.encode())
    expected = Camera(1280, 720, 611.8, 611.9, 639.3, 365.9, (0.1, -0.2, 0.001, 0.002, 0.05))
    assert read_camera(tmp_path / "c.yaml") == expected
    assert describe(tmp_path / "c.yaml").kind == "camera"


def test_ros_message(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(ROS_MESSAGE)
    expected = Camera(1280, 720, 611.8, 611.9, 639.3, 365.9, (0.1, -0.2, 0.001, 0.002, 0.05, 0, 0, 0))
    assert read_camera(tmp_path / "c.yaml") == expected


@pytest.mark.parametrize(
    ("text", "kind", "word"),
    [
        (ROS.replace("plumb_bob", "double_sphere"), CameraError, "double_sphere"),
        (ROS.replace("plumb_bob", "equidistant"), CameraError, "0 or 4"),
        (ROS.replace("611.8, 0.0", "611.8, 3.0"), CameraError, "skew"),
        (ROS.replace("611.8", "0.0"), CameraError, "fx is 0"),
        (ROS.replace("611.9", "-1"), CameraError, "fy is -1"),
        (ROS.replace("611.9", ".nan"), FormatError, "finite"),
        (ROS.replace("611.9", "nan"), FormatError, "finite"),
        (ROS.replace("image_width: 1280\n", ""), FormatError, "size"),
        (ROS.replace("image_width: 1280", "image_width: wide"), FormatError, "image_width"),
        (ROS.replace("camera_matrix", "camera_madrix"), FormatError, "camera_matrix"),
        (ROS.replace("0.0, 0.0, 1.0]", "0.0, 0.0]", 1), FormatError, "8 numbers"),
        (ROS.replace("cols: 5", "cols: 7"), FormatError, "1 x 7"),
        (ROS[: ROS.index("365.9")], FormatError, "never closed"),
        (ROS.replace("rows: 3", "\trows: 3"), FormatError, "tabs"),
        ("a: [" * 500, FormatError, ""),
        ("a: " + "[" * 500 + "]" * 500, FormatError, "nested"),
        ("\n".join(" " * k + "a:" for k in range(300)), FormatError, "nested"),
        ("just words", FormatError, "name: value"),
        ("# nothing", FormatError, "is empty"),
        ("<?xml version='1.0'?>", FormatError, "XML"),
        (json.dumps({"width": 4}), FormatError, "fx"),
        (json.dumps({"width": 4, "height": 3, "fx": 0, "fy": 1, "cx": 1, "cy": 1}), CameraError, "fx is 0"),
        (json.dumps({"width": 4, "height": 3, "fx": 1, "fy": -2, "cx": 1, "cy": 1}), CameraError, "fy is -2"),
        (json.dumps({"width": 0, "height": 3, "fx": 1, "fy": 1, "cx": 1, "cy": 1}), CameraError, "width is 0"),
        (json.dumps({"width": 4, "height": 3, "fx": "1", "fy": 1, "cx": 1, "cy": 1}), FormatError, "'fx'"),
        ('{"width": 4, "height": 3, "fx": NaN, "fy": 1, "cx": 1, "cy": 1}', FormatError, "NaN"),
        ('{"width": 4, "height": 3, "fx": 1e999, "fy": 1, "cx": 1, "cy": 1}', FormatError, "finite"),
        ('{"width": 4, "height": 3, "fx": ' + "9" * 6000 + "}", FormatError, ""),
        ('{"a":' * 100_000, FormatError, "nested"),
        ("[1, 2]", FormatError, ""),
        ('{"width": 4,', FormatError, "not valid JSON"),
    ],
)
def test_a_bad_camera_is_one_clear_error(tmp_path: Path, text: str, kind: type[LadarregError], word: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(kind) as caught:
        read_camera(tmp_path / "c.yaml")
    assert word in str(caught.value), str(caught.value)
    assert len(str(caught.value)) <= 300


@given(st.text(alphabet=" \n:-[]{},#'\"!ab1.%", max_size=60))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    try:
        value: Any = parse_yaml(text)
    except FormatError:
        return
    assert isinstance(value, dict)
