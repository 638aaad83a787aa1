"""Camera files of other programs: golden files, projections computed by hand, and independent readers."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, FormatError, LadarregError, OptionError, UnderspecifiedError
from ladarreg_core.formats import describe, read_photo, recognise
from ladarreg_core.formats.cameras.agisoft import _project
from ladarreg_core.formats.cameras.camera_file import read_camera, read_cameras, read_noted_camera
from ladarreg_core.formats.documents.pose_file import read_initial
from ladarreg_core.formats.survey import survey_file
from ladarreg_core.frames import Rigid

GOLDEN = Path(__file__).with_name("golden_cameras")
PINHOLES = (
    "opencv.yml", "opencv.xml", "ros.yaml", "ros_rational.yaml", "kalibr.yaml", "colmap/cameras.txt",
    "colmap/cameras.bin", "nerfstudio.json", "agisoft_calibration.xml", "agisoft_document.xml",
)  # fmt: skip

# All these files state one lens in the terms of their program: f = 1000 px, the principal point (640.25, 470.5) counted
# from the centre of the first pixel, k1 = -.1, k2 = .02, p1 = .001, p2 = -.002 (OpenCV's p1 and p2).
#
# (0, 0, 1) is the principal point.
# (.5, 0, 1): s = .25, radial = 1 - .025 + .00125 = .97625; x = .5 * .97625 + p2 (s + 2 * .25) = .488125 - .0015
#   = .486625, y = p1 s = .00025; u = 640.25 + 486.625, v = 470.5 + .25.
# (0, -.4, 1): s = .16, radial = 1 - .016 + .000512 = .984512; x = p2 s = -.00032,
#   y = -.4 * .984512 + p1 (s + 2 * .16) = -.3938048 + .00048 = -.3933248; u = 640.25 - .32, v = 470.5 - 393.3248.
POINTS = np.array([[0, 0, 1], [0.5, 0, 1], [0, -0.4, 1]])
PIXELS = np.array([[640.25, 470.5], [1126.875, 470.75], [639.93, 77.1752]])


# A fisheye: f = 400 px, the principal point (800.25, 799.5), k1 = -.02, k2 = .004.
#
# .5 rad off the axis to the right: s = .25, theta_d = .5 (1 - .005 + .00025) = .497625; u = 800.25 + 199.05.
# 2 rad downwards, behind the camera: s = 4, theta_d = 2 (1 - .08 + .064) = 1.968; v = 799.5 + 787.2.
FISHEYES = ("opencv_fisheye.yml", "ros_equidistant.yaml", "kalibr_equidistant.yaml", "agisoft_fisheye.xml",
            "colmap_fisheye/cameras.txt", "nerfstudio_fisheye.json")  # fmt: skip
FISHEYE_POINTS = np.array([[0, 0, 1], [np.sin(0.5), 0, np.cos(0.5)], [0, np.sin(2), np.cos(2)]])
FISHEYE_PIXELS = np.array([[800.25, 799.5], [999.3, 799.5], [800.25, 1586.7]])
PANORAMAS = ("colmap_panorama/cameras.txt", "nerfstudio_panorama.json", "agisoft_panorama.xml")


def seed_files(folder: Path) -> list[Path]:
    """Write one file of each format, for the tests of damaged files."""
    shutil.copytree(GOLDEN, folder, dirs_exist_ok=True)
    for name in ("kalibr.yaml", "nerfstudio.json"):  # with several cameras
        (folder / name).unlink()
    return [path for path in folder.rglob("*") if path.is_file() and path.name not in ("images.txt", "images.bin")]


def of_golden(name: str) -> Camera:
    """Read the camera that took the photograph `frame_00001.jpg`, `a 1.jpg`, ... of a golden file."""
    for picture in ("frame_00001.jpg", "a 1.jpg", "DSC_0001.JPG", "cam0_17.png"):
        try:
            return read_camera(GOLDEN / name, picture=picture)
        except UnderspecifiedError:
            continue
    return read_camera(GOLDEN / name, name="1")


@pytest.mark.parametrize("name", PINHOLES)
def test_every_format_projects_as_computed_by_hand(name: str) -> None:
    camera = of_golden(name)
    assert camera.size == (1280, 960)
    np.testing.assert_allclose(camera.project(POINTS), PIXELS, atol=1e-9)
    half_off = camera.project(POINTS) + 0.5  # the error of a wrong origin of pixels
    assert not np.allclose(half_off, PIXELS, atol=0.1)


@pytest.mark.parametrize("name", FISHEYES)
def test_fisheyes_project_as_computed_by_hand_also_behind_the_camera(name: str) -> None:
    camera = read_camera(GOLDEN / name)
    assert (camera.model, camera.size) == ("fisheye", (1600, 1600))
    np.testing.assert_allclose(camera.project(FISHEYE_POINTS), FISHEYE_PIXELS, atol=1e-9)
    pinhole = Camera(1600, 1600, 400, 400, 800.25, 799.5, (-0.02, 0.004, 0, 0))  # as a fisheye must not be read
    assert not np.allclose(pinhole.project(FISHEYE_POINTS[1]), FISHEYE_PIXELS[1], atol=1)


@pytest.mark.parametrize("name", PANORAMAS)
def test_panoramas_project_as_computed_by_hand(name: str) -> None:
    # 400 x 200 pixels of .9 deg: ahead is the middle, (399 / 2, 199 / 2); 90 deg to the right is 100 pixels further,
    # 45 deg down is 50 pixels below.
    camera = read_camera(GOLDEN / name)
    assert (camera.model, camera.size) == ("equirectangular", (400, 200))
    found = camera.project(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 1]]))
    np.testing.assert_allclose(found, [[199.5, 99.5], [299.5, 99.5], [199.5, 149.5]], atol=1e-9)


@pytest.mark.parametrize("name", PINHOLES)
def test_every_format_is_recognised_by_content_and_described(tmp_path: Path, name: str) -> None:
    copy = shutil.copyfile(GOLDEN / name, tmp_path / "file.dat")
    assert recognise(copy).kind == "camera"
    found = describe(copy)
    assert found.camera or found.cameras
    assert survey_file(copy).width == 1280


@pytest.mark.parametrize("name", ["opencv.yml", "opencv.xml"])
def test_opencv_reads_its_storage_as_we_do(name: str) -> None:
    storage = cv2.FileStorage(str(GOLDEN / name), cv2.FileStorage_READ)
    K, k = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    theirs, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, k)
    np.testing.assert_allclose(read_camera(GOLDEN / name).project(POINTS), theirs[:, 0], atol=1e-9)


COLMAP_MODELS = {
    "SIMPLE_PINHOLE": [700, 320.5, 240.25],
    "PINHOLE": [700, 710, 320.5, 240.25],
    "SIMPLE_RADIAL": [700, 320.5, 240.25, -0.05],
    "RADIAL": [700, 320.5, 240.25, -0.05, 0.01],
    "OPENCV": [700, 710, 320.5, 240.25, -0.05, 0.01, 0.001, -0.002],
    "FULL_OPENCV": [700, 710, 320.5, 240.25, -0.05, 0.01, 0.001, -0.002, 0.003, 0.01, -0.02, 0.001],
    "OPENCV_FISHEYE": [300, 310, 320.5, 240.25, -0.05, 0.01, 0.001, -0.002],
    "SIMPLE_RADIAL_FISHEYE": [300, 320.5, 240.25, -0.05],
    "RADIAL_FISHEYE": [300, 320.5, 240.25, -0.05, 0.01],
}


@pytest.mark.parametrize("model", COLMAP_MODELS)
@pytest.mark.parametrize("ending", ["txt", "bin"])
def test_colmaps_own_files_project_as_colmap_does(tmp_path: Path, model: str, ending: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=COLMAP_MODELS[model], camera_id=3)
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(theirs)
    (reconstruction.write_text if ending == "txt" else reconstruction.write_binary)(str(tmp_path))
    (ours,) = read_cameras(tmp_path / f"cameras.{ending}")
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.5], (50, 3))
    expected = np.array([theirs.img_from_cam(point) for point in points]) - 0.5
    np.testing.assert_allclose(ours.camera.project(points), expected, atol=1e-9)
    assert ours.name == "3"


def test_colmaps_images_say_which_photograph_a_camera_took() -> None:
    text, binary = (read_cameras(GOLDEN / "colmap" / f"cameras.{ending}") for ending in ("txt", "bin"))
    assert [each.pictures for each in text] == [each.pictures for each in binary] == [("left/a 1.jpg",), ("b.jpg",)]
    poses = text[1].poses
    assert poses is not None  # a quarter turn about z: x -> y
    np.testing.assert_allclose(poses["b.jpg"].rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_camchain_names_its_cameras_and_chains_their_transforms() -> None:
    cameras = {each.name: each for each in read_cameras(GOLDEN / "kalibr.yaml")}
    assert list(cameras) == ["cam0", "cam1", "cam2"]
    places = {name: each.camera_from_first for name, each in cameras.items()}
    assert places["cam1"] is not None
    assert places["cam2"] is not None
    np.testing.assert_allclose(places["cam1"].centre, [0.11, 0, 0], atol=1e-12)
    # cam2 from cam1 turns (x, y) into (-y, x + .25): the origin of cam0, (-.11, 0) in cam1, becomes (0, .14)
    np.testing.assert_allclose(places["cam2"].translation, [0, 0.14, 0], atol=1e-12)


def test_applied_transform_and_the_axes_of_opengl_are_undone() -> None:
    first, second = read_cameras(GOLDEN / "nerfstudio.json")
    assert first.poses is not None
    assert second.poses is not None
    pose = first.poses["images/frame_00001.jpg"]
    # The file's world is (x, z, -y) of the original: its centre (2, -3, 1) was (2, -1, -3). The camera looks along its
    # own -z, which is -z of the file's world, and that is +y of the original.
    np.testing.assert_allclose(pose.centre, [2, -1, -3], atol=1e-12)
    np.testing.assert_allclose(pose.rotation[2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(second.poses["images/frame_00002.jpg"].centre, [0, -4, 0], atol=1e-12)


def changed(tmp_path: Path, name: str, *changes: tuple[str, str]) -> Path:
    """Return a copy of a golden file with replacements."""
    text = (GOLDEN / name).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / Path(name).name).write_text(text)
    return tmp_path / Path(name).name


def test_a_term_of_r8_is_refitted_within_a_hundredth_of_a_pixel(tmp_path: Path) -> None:
    path = changed(tmp_path, "agisoft_calibration.xml", ("<p1>", "<k3>-0.01</k3><k4>0.02</k4><p1>"))
    camera, notes = read_noted_camera(path)
    values = dict.fromkeys(("p3", "p4", "b1", "b2"), 0.0) | {
        "f": 1000, "cx": 0.75, "cy": -9, "k1": -0.1, "k2": 0.02, "k3": -0.01, "k4": 0.02, "p1": -0.002, "p2": 0.001,
    }  # fmt: skip
    across, down = np.meshgrid(np.linspace(-0.64, 0.64, 40), np.linspace(-0.48, 0.48, 30))
    points = np.stack([across, down, np.ones_like(across)], axis=-1).reshape(-1, 3)
    theirs = _project("frame", values, 1280, 960, points)
    inside = camera.contains(theirs)
    assert inside.sum() > 900
    assert np.hypot(*(camera.project(points) - theirs)[inside].T).max() < 0.01
    assert isinstance(camera, Camera)
    without = dataclasses.replace(camera, distortion=(-0.1, 0.02, 0.001, -0.002, -0.01))
    assert np.hypot(*(without.project(points) - theirs)[inside].T).max() > 0.1  # k4 is not nothing
    assert "K4" in notes[0]


def test_nerfstudios_fourth_term_is_polynomial(tmp_path: Path) -> None:
    fields = json.loads((GOLDEN / "nerfstudio.json").read_text())
    fields = {name: fields[name] for name in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1")} | {"k3": 0.01, "k4": 0.05}
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    camera = read_camera(tmp_path / "transforms.json")
    # (.5, 0, 1): radial = 1 - .025 + .01 / 64 + .05 / 256 = .9753515625, u = 640.25 + 487.67578125
    np.testing.assert_allclose(camera.project([0.5, 0, 1]), [1127.92578125, 470.5], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "kind", "words"),
    [
        ("agisoft_calibration.xml", [("<k1>", "<b2>2.5</b2><k1>")], CameraError, ("B2", "off by")),
        ("agisoft_calibration.xml", [("frame", "cylindrical")], CameraError, ("cylindrical", "pinhole")),
        ("agisoft_calibration.xml", [("<f>1000</f>", "<fx>1000</fx><fy>1000</fy>")], CameraError, ("PhotoScan",)),
        ("agisoft_calibration.xml", [("<f>1000</f>", "<f>wide</f>")], FormatError, ("<f>", "wide")),
        (
            "agisoft_calibration.xml",
            [("<calibration>", "<!DOCTYPE a><calibration>")],
            FormatError,
            (),
        ),
        ("colmap/cameras.txt", [("7 SIMPLE_PINHOLE", "7 FOV")], CameraError, ("camera 7", "FOV")),
        ("colmap/cameras.txt", [("500 320 240", "500 320")], FormatError, ("SIMPLE_PINHOLE", "2 parameters", "3")),
        ("kalibr.yaml", [("camera_model: pinhole", "camera_model: omni")], CameraError, ("cam0", "omni")),
        ("kalibr.yaml", [("distortion_model: radtan", "distortion_model: fov")], CameraError, ("cam0", "fov")),
        ("nerfstudio.json", [("OPENCV", "FISHEYE624")], CameraError, ("FISHEYE624",)),
        ("nerfstudio.json", [('"w": 1280,', "")], FormatError, ("'w'",)),
        ("opencv.yml", [("flags: 0", "xi: 1.2")], CameraError, ("omnidirectional",)),
        ("opencv.yml", [("flags: 0", "camera_model: MEI")], CameraError, ("MEI",)),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(
    tmp_path: Path, name: str, changes: list[tuple[str, str]], kind: type[LadarregError], words: tuple[str, ...]
) -> None:
    with pytest.raises(kind) as caught:
        read_cameras(changed(tmp_path, name, *changes))
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert len(str(caught.value)) <= 300


def test_the_photograph_decides_on_the_camera_or_its_name_is_asked_for(tmp_path: Path) -> None:
    path = GOLDEN / "kalibr.yaml"
    assert read_camera(path, name="CAM1").size == (640, 480)
    with pytest.raises(UnderspecifiedError, match=r"cam0 \(1280 x 960\), cam1 .*cam2 .*`camera_name`"):
        read_camera(path, picture="photo.jpg")
    with pytest.raises(OptionError, match=r"'cam7'.*cam0"):
        read_camera(path, name="cam7")
    for size, found in (((1280, 960), "cam0"), ((640, 480), None)):
        Image.new("RGB", size).save(tmp_path / "photo.png")
        if found is None:  # two cameras have this size
            with pytest.raises(UnderspecifiedError, match=r"2 cameras .*cam1.*cam2"):
                read_photo(tmp_path / "photo.png", camera=path)
        else:
            photo = read_photo(tmp_path / "photo.png", camera=path)
            assert photo.camera.fx == 1000
            assert "cam0, chosen by the photograph's size" in photo.notes[0]
    assert read_photo(tmp_path / "photo.png", camera=path, camera_name="cam1").camera.distortion == ()
    shutil.copyfile(tmp_path / "photo.png", tmp_path / "frame_00002.png")
    found = read_photo(tmp_path / "frame_00002.png", camera=GOLDEN / "nerfstudio.json")
    assert (found.camera.fx, found.camera.cx) == (500, 319.5)


def test_a_stereo_pair_has_two_cameras(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "stereo.yml"), cv2.FileStorage_WRITE)
    storage.write("image_size", np.array([[640, 480]]))
    for side, focal in (("1", 500.0), ("2", 510.0)):
        storage.write(f"M{side}", np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]]))
        storage.write(f"D{side}", np.zeros((5, 1)))
    storage.release()
    assert [(each.name, each.camera.fx) for each in read_cameras(tmp_path / "stereo.yml")] == [("1", 500), ("2", 510)]


def test_a_reconstructions_pose_of_the_photograph_is_a_first_guess_where_the_worlds_agree() -> None:
    world_from_scanner = Rigid.from_rotvec([0, 0, 0.3], (2, 5, 1))
    guess = read_initial(GOLDEN / "nerfstudio.json", world_from_scanner, picture="frame_00001.jpg")
    np.testing.assert_allclose((world_from_scanner @ guess.inverse).translation, [2, -1, -3], atol=1e-12)
    with pytest.raises(FormatError, match="where the scanner stands in it"):
        read_initial(GOLDEN / "nerfstudio.json", None, picture="frame_00001.jpg")
    with pytest.raises(FormatError, match=r"no pose of the photograph 'other\.jpg'"):
        read_initial(GOLDEN / "colmap" / "cameras.txt", world_from_scanner, picture="other.jpg")
    assert "initial pose" in read_noted_camera(GOLDEN / "nerfstudio.json", picture="frame_00001.jpg")[1][-1]


def test_a_photograph_takes_the_fisheye_of_its_file(tmp_path: Path) -> None:
    Image.new("RGB", (1600, 1600)).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png", camera=GOLDEN / "opencv_fisheye.yml")
    np.testing.assert_allclose(photo.camera.project(FISHEYE_POINTS), FISHEYE_PIXELS, atol=1e-9)
