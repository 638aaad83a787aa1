"""Cameras whose numbers stand as fields of their own, in the spellings of several programs; no field is lost."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import Camera, FisheyeCamera
from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats import describe, read_photo
from ladarreg_core.formats.cameras.agisoft import _project
from ladarreg_core.formats.cameras.camera_file import read_camera, read_cameras, read_noted_camera
from ladarreg_core.formats.cameras.refit import refitted

_PLAIN = {"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0}
_K = [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
_LENS = (0.1, -0.2, 0.001, 0.002)


def _written(tmp_path, **more):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(_PLAIN | more))
    return file


def _yaml(tmp_path: Path, text: str) -> Path:
    (tmp_path / "camera.yaml").write_text(text)
    return tmp_path / "camera.yaml"


@pytest.mark.parametrize(
    ("flat", "terms"),
    [
        ({"k1": 0.1, "k2": -0.2, "p1": 0.001, "p2": 0.002}, (0.1, -0.2, 0.001, 0.002)),
        ({"k1": 0.1}, (0.1, 0.0, 0.0, 0.0)),
        ({"k1": 0.1, "k2": -0.2, "k3": 0.03}, (0.1, -0.2, 0.0, 0.0, 0.03)),
        ({"k1": 0.1, "k4": 0.04}, (0.1, 0.0, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0)),
        ({"k1": 0.1, "s4": 0.04}, (0.1, *[0.0] * 10, 0.04)),
        ({"distortion": [0.0] * 6}, ()),
        ({"distortion": [0.1, 0, 0, 0, 0, 0]}, (0.1, 0, 0, 0)),
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


_SIZE = "image_width: 640\nimage_height: 480\n"
_FLAT = "fx: 500.\nfy: 501.\ncx: 320.\ncy: 240.\n"
_TERMS = "k1: 0.1\nk2: -0.2\np1: 1e-3\np2: .002\n"


def _indented(text: str, prefix: str = "  ") -> str:
    return "".join(f"{prefix}{line}\n" for line in text.splitlines())


_SPELLINGS = {
    "flat": _SIZE + _FLAT + _TERMS,
    "camodocal": f"model_type: PINHOLE\ncamera_name: c\n{_SIZE}distortion_parameters:\n{_indented(_TERMS)}"
    f"projection_parameters:\n{_indented(_FLAT)}",
    "ORB-SLAM": 'Camera.type: "PinHole"\n' + _indented(_FLAT + _TERMS + "width: 640\nheight: 480\n", "Camera."),
    "ORB-SLAM3": "Camera.width: 640\nCamera.height: 480\n" + _indented(_FLAT + _TERMS, "Camera1."),
    "matrix and single terms": _SIZE + f"camera_matrix: {_K}\n" + _TERMS,
    "four numbers": _SIZE + f"intrinsics: [500, 501, 320, 240]\ndistortion_coeffs: {list(_LENS)}\n",
    "matrix by columns": _SIZE + f"intrinsic_matrix: {[_K[k] for k in (0, 3, 6, 1, 4, 7, 2, 5, 8)]}\n" + _TERMS,
    "block lists": _SIZE + "K:\n" + "".join(
        f"- - {_K[k]}\n  - {_K[k + 1]}\n  - {_K[k + 2]}\n" for k in (0, 3, 6)
    ) + "D:\n" + "".join(f"- {term}\n" for term in _LENS),
}  # fmt: skip


@pytest.mark.parametrize("spelling", _SPELLINGS)
@pytest.mark.parametrize("head", ["", "%YAML:1.0\n---\n", "%YAML:1.0\n", "# of a program\n"])
def test_every_spelling_is_the_same_camera(tmp_path: Path, spelling: str, head: str) -> None:
    path = _yaml(tmp_path, head + _SPELLINGS[spelling])
    assert read_camera(path) == Camera(640, 480, 500, 501, 320, 240, _LENS)
    assert describe(path).kind == "camera"


def test_a_camchain_in_block_style_is_read(tmp_path: Path) -> None:
    rows = "".join("  - - {}\n    - {}\n    - {}\n    - {}\n".format(*row) for row in np.eye(4).tolist())
    path = _yaml(
        tmp_path,
        f"cam0:\n  T_cam_imu:\n{rows}  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: {list(_LENS)}\n"
        "  distortion_model: radtan\n  intrinsics: [500, 501, 320, 240]\n  resolution: [640, 480]\n"
        "  rostopic: /cam0/image_raw\n  timeshift_cam_imu: 0.01\n",
    )
    (found,) = read_cameras(path)
    assert found.camera == Camera(640, 480, 500, 501, 320, 240, _LENS)
    assert found.notes == ("fields of the camera file that were not used: T_cam_imu, timeshift_cam_imu",)


def test_fisheyes_of_orb_slam_and_camodocal_have_their_own_names(tmp_path: Path) -> None:
    expected = FisheyeCamera(640, 480, 500, 501, 320, 240, (0.1, -0.2, 0.03, 0.04))
    of_slam = "k1: .1\nk2: -.2\nk3: .03\nk4: .04\nwidth: 640\nheight: 480\n"
    path = _yaml(tmp_path, "Camera.type: KannalaBrandt8\n" + _indented(_FLAT + of_slam, "Camera."))
    assert read_camera(path) == expected
    numbers = "k2: .1\nk3: -.2\nk4: .03\nk5: .04\nmu: 500\nmv: 501\nu0: 320\nv0: 240\n"
    path = _yaml(tmp_path, f"model_type: KANNALA_BRANDT\n{_SIZE}projection_parameters:\n{_indented(numbers)}")
    assert read_camera(path) == expected


def test_the_calibration_of_koide_takes_the_size_of_the_photograph(tmp_path: Path) -> None:
    fields = {
        "meta": {"data_path": "x"},
        "camera": {"camera_model": "plumb_bob", "intrinsics": [500, 501, 320, 240], "distortion_coeffs": [*_LENS, 0.0]},
        "results": {"T_lidar_camera": [0.1, 0, 0, 0, 0, 0, 1]},
    }
    (tmp_path / "calib.json").write_text(json.dumps(fields))
    Image.new("RGB", (640, 480)).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png", camera=tmp_path / "calib.json")
    assert photo.camera == Camera(640, 480, 500, 501, 320, 240, (*_LENS, 0.0))
    assert "the photograph's was taken, 640 x 480 px" in photo.notes[0]
    assert "not used: results" in photo.notes[1]
    with pytest.raises(FormatError, match="image size is missing"):
        read_camera(tmp_path / "calib.json")


def test_fields_that_are_not_understood_are_named_and_terms_of_lenses_refused(tmp_path: Path) -> None:
    _, notes = read_noted_camera(_written(tmp_path, shutter="rolling", readout=0.01, k3=0.0, unset=0, roi={"x": 0}))
    assert notes == ("fields of the camera file that were not used: shutter, readout",)
    for name in ("k7", "skew", "tauX", "b2"):
        with pytest.raises(CameraError, match=f"{name!r}.*term of the lens"):
            read_camera(_written(tmp_path, **{name: 0.5}))


@pytest.mark.parametrize("text", ["a: &x 1\nb: *x\n", "fx: 1\nfx: 2\n", "? [a]\n: 1\n"])
def test_yaml_that_is_more_than_a_mapping_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(FormatError):
        read_camera(_yaml(tmp_path, text))


def test_twelve_terms_express_what_eight_cannot() -> None:
    values = dict.fromkeys(("cx", "cy", "b1", "b2", "p1", "p2", "p3", "p4"), 0.0) | {
        "f": 1000.0, "k1": -0.1, "k2": 0.02, "k3": 0.0, "k4": 0.0,
    }  # fmt: skip

    def prism(points):
        uv = _project("frame", values, 1280, 960, points)
        s = (points[:, 0] ** 2 + points[:, 1] ** 2) / points[:, 2] ** 2
        return uv + np.stack([2 * s, 3 * s * s], axis=-1)

    camera, note = refitted(prism, "pinhole", 1280, 960, (1000, 1000, 639.5, 479.5), "a prism")
    assert len(camera.distortion) == 12
    assert "largest error" in note
