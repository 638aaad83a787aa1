"""E57: what was in the source's file is unchanged, colours and images are true; read with libe57's raw nodes."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import Cancelled, ExportError, LadarregError
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.pipeline import export_files, export_to
from ladarreg_core.formats import extract_images, read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.e57_images import embedded_images
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from testing.attacks.bombs import e57_with_xml
from testing.attacks.full_disk import largest_file
from testing.scenes.color_room import POSE, paint, photo_of, registered, scan_of, seen_along
from tests.unit.export import e57_samples
from tests.unit.export.e57_samples import COLORS, KINDS, differences, libe57, raw_values

PINHOLE = Camera(160, 120, 130.0, 131.0, 77.0, 61.0)
WORLD = Rigid.from_rotvec([0, 0, 0.9], (456_789.25, 5_432_100.5, 321.75))


_OPEN: list[Any] = []


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    while _OPEN:
        _OPEN.pop().close()


def opened(path: Path) -> Any:
    """An open file; its nodes are of no use once it is closed."""
    _OPEN.append(libe57.ImageFile(str(path), "r"))
    return _OPEN[-1]


def exported(handed: RegisteredScan, folder: Path) -> Path:
    export_to(folder, handed, ["e57"])
    (path,) = (folder / "e57").iterdir()
    return path


def handed_over(path: Path, index: int, *photos: RegisteredPhoto) -> RegisteredScan:
    return RegisteredScan(read_scan(path, scan_index=index), photos, path, {"scan_index": index})


def position(values: dict[str, np.ndarray], prototype: Any) -> np.ndarray:
    """The points (N, 3) of raw values, by the standard."""

    def number(name: str) -> np.ndarray:
        node = prototype[name]
        is_scaled = isinstance(node, libe57.ScaledIntegerNode)
        return values[name] * node.scale() + node.offset() if is_scaled else values[name].astype("f8")

    if "cartesianX" in values:
        return np.stack([number(f"cartesian{axis}") for axis in "XYZ"], axis=-1)
    r, azimuth, elevation = (number(f"spherical{name}") for name in ("Range", "Azimuth", "Elevation"))
    level = r * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)], axis=-1)


@pytest.mark.parametrize("kind", KINDS)
def test_everything_but_the_colors_is_as_it_was_and_these_are_true(kind: str, tmp_path: Path) -> None:
    source = tmp_path / "Büro 1.e57"
    index = KINDS[kind](source, scan_of())
    photo = photo_of(PINHOLE, name="IMG größer 1.png")
    path = exported(handed_over(source, index, registered(photo)), tmp_path / "out")
    old_file, file = map(opened, (source, path))
    old, new = old_file.root(), file.root()
    changed = set(differences(old, new))
    points = f"/data3D/{index}/points"
    of_colors = {f"{points}/{name}: values" for name in (*COLORS, "isColorInvalid")}
    of_colors |= {f"{points}/{name}: maximum" for name in COLORS}  # of the constant ones
    assert changed <= {"/guid: value", "/e57LibraryVersion: value", *of_colors}
    assert {"/guid: value", "/e57LibraryVersion: value"} <= changed
    assert new["images2D"].childCount() == old["images2D"].childCount() + 1

    scan, old_scan = new["data3D"][index], old["data3D"][index]
    values, before = raw_values(scan["points"]), raw_values(old_scan["points"])
    where = position(values, libe57.StructureNode(scan["points"].prototype()))
    state = next((values[name] for name in values if name.endswith("InvalidState")), np.zeros(len(where)))
    uv = PINHOLE.project(POSE @ where)
    inside = PINHOLE.contains(uv, border=1) & (state == 0)
    beyond = ~PINHOLE.contains(uv, border=-1) | (state != 0)
    limits = [float(scan[f"colorLimits/{name}Maximum"].value()) for name in COLORS]
    found = np.stack([values[name] / limit * 255 for name, limit in zip(COLORS, limits, strict=True)], axis=-1)
    assert inside.sum() > 300
    away = np.abs(found - paint(where))[inside]
    assert np.median(away) < 1
    assert np.mean(away < 6) > 0.97, "at corners of the room a coarse grid sees edges"
    mirrored = np.abs(found - paint(where * [1, -1, 1]))[inside]
    assert np.median(mirrored) > 20, "the control: the room mirrored"
    if "isColorInvalid" in values:
        assert np.mean(values["isColorInvalid"][inside]) < 0.03
    if kind in ("scaled", "spherical"):
        assert all((values[name] == before[name])[beyond].all() for name in COLORS), "unseen points keep their colour"
        if kind == "spherical":
            assert (values["isColorInvalid"] == before["isColorInvalid"])[beyond].all()
    else:
        gray = found[beyond & (state == 0)]
        assert (gray == gray[:, :1]).all()
        assert np.corrcoef(gray[:, 0], before["intensity"][beyond & (state == 0)])[0, 1] > 0.9
        assert values["isColorInvalid"][beyond].all()


def test_a_scan_of_another_format_becomes_a_file_of_its_returns(tmp_path: Path) -> None:
    scan = scan_of(world_from_scanner=WORLD)
    path = exported(RegisteredScan(scan, (registered(photo_of(PINHOLE)),)), tmp_path / "out")
    file = opened(path)
    node = file.root()["data3D"][0]
    values = raw_values(node["points"])
    row, column = values["rowIndex"], values["columnIndex"]
    assert len(row) == scan.valid.sum()
    for k, axis in enumerate("XYZ"):
        assert (values[f"cartesian{axis}"] == scan.points[row, column, k]).all()
    assert (values["intensity"] == scan.intensity[row, column]).all()
    assert [node["pose/translation"][axis].value() for axis in "xyz"] == WORLD.translation.tolist()
    again = read_scan(path)
    assert again.world_from_scanner is not None
    np.testing.assert_allclose(again.world_from_scanner.rotation, WORLD.rotation, atol=1e-12)
    seen = values["isColorInvalid"] == 0
    truth = paint(scan.points[row, column])
    assert np.median(np.abs(values["colorGreen"] - truth[:, 1])[seen]) < 1
    colored = replace(scan, color=np.full((*scan.shape, 3), 77, np.uint8))
    assert (values["ladarreg:photo_id"] == seen).all()
    assert np.isfinite(values["ladarreg:sigma_px"][seen]).all()
    assert np.isnan(values["ladarreg:sigma_px"][~seen]).all()
    assert set(values["ladarreg:label"][seen].tolist()) < set(range(8))
    assert "0: none" in node["ladarreg:layers"]["ladarreg:photo_id"].value()
    second = exported(RegisteredScan(colored, (registered(photo_of(PINHOLE)),)), tmp_path / "second")
    of_scanner = raw_values(opened(second).root()["data3D"][0]["points"])
    assert (of_scanner["colorRed"][~seen] == 77).all(), "the scanner's own colours stay where no photograph sees"
    assert (of_scanner["colorRed"] == values["colorRed"])[seen].all()


LENSES: dict[str, tuple[CameraModel, int]] = {
    "pinhole": (PINHOLE, 1),
    "5 terms": (Camera(160, 120, 130.0, 131.0, 77.0, 61.0, (-0.21, 0.06, 0.002, -0.001, 0.01)), 2),
    "8 terms": (Camera(160, 120, 130.0, 131.0, 77.0, 61.0, (0.3, -0.2, 1e-3, 2e-3, 0.02, 0.25, -0.1, 0.01)), 2),
    "12 terms": (
        Camera(160, 120, 130.0, 131.0, 77.0, 61.0, (-0.2, 0.05, 1e-3, 0, 0, 0, 0, 0, 2e-3, 0, -1e-3, 0)),
        2,
    ),
    "fisheye": (FisheyeCamera(240, 200, 75.0, 75.0, 120.5, 98.0, (0.03, -0.01, 0.002, 0.0)), 6),
    "panorama": (EquirectangularCamera(360, 180), 1),
    "turned panorama": (EquirectangularCamera(360, 180, (-100.0, 90.0, 260.0, -90.0)), 1),
    "panorama without its top": (EquirectangularCamera(360, 150, (-180.0, 60.0, 180.0, -90.0)), 2),
    "part of one": (EquirectangularCamera(200, 110, (-30.0, 50.0, 70.0, -5.0)), 2),
}


def rays_by_the_standard(image: Any, control: str = "") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The centre (3,) and the rays (h, w, 3) of an image's pixels in the coordinates of the file, and its pixels."""
    kind = next(name for name in ("pinhole", "spherical") if image.isDefined(f"{name}Representation"))
    shape = image[f"{kind}Representation"]
    blob = shape["jpegImage"].read_buffer().tobytes()
    pixels = np.asarray(Image.open(io.BytesIO(blob))).astype(float)
    height, width = (shape[name].value() for name in ("imageHeight", "imageWidth"))
    assert pixels.shape == (height, width, 3)
    shift = 0.0 if control == "half a pixel off" else 0.5
    across, down = np.meshgrid(np.arange(width) + shift, np.arange(height) + shift)
    step_x, step_y = (shape[name].value() for name in ("pixelWidth", "pixelHeight"))
    if kind == "pinhole":
        focal = shape["focalLength"].value()
        x = (across - shape["principalPointX"].value()) * step_x
        y = -(down - shape["principalPointY"].value()) * step_y
        rays = np.stack([x, y, np.full_like(x, -focal)], axis=-1)
    else:
        azimuth, elevation = (width / 2 - across) * step_x, (height / 2 - down) * step_y
        level = np.cos(elevation)
        rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    if control == "y flipped":
        rays = rays[::-1]
    w, x, y, z = (image["pose/rotation"][name].value() for name in "wxyz")
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    turn = turn.T if control == "pose transposed" else turn
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = np.array([image["pose/translation"][name].value() for name in "xyz"])
    return centre, rays @ turn.T, pixels


def misplaced_px(image: Any, control: str = "") -> tuple[float, float]:
    """By how many pixels the image is displaced from what its camera would see in the room, and by how many levels."""
    centre, rays, pixels = rays_by_the_standard(image, control)
    in_room = WORLD.inverse
    expected = seen_along(in_room @ centre, rays @ in_room.rotation.T)
    known = np.zeros(pixels.shape[:2], bool)
    known[3:-3, 3:-3] = True
    drawn = pixels.sum(axis=-1) > 30
    for axis in (0, 1):
        for step in (-3, 3):
            known &= np.roll(drawn, step, axis)
    gradient = np.stack([np.gradient(expected, axis=1), np.gradient(expected, axis=0)], axis=-1)
    flat = (np.abs(gradient).max(axis=(2, 3)) < 15) & known  # no corners of the room
    away = (pixels - expected)[flat].reshape(-1)
    shift, *_ = np.linalg.lstsq(gradient[flat].reshape(-1, 2), -away, rcond=None)
    return float(np.abs(shift).max()), float(np.median(np.abs(away)))


@pytest.mark.parametrize("lens", LENSES)
def test_images_show_what_their_cameras_see_by_the_arithmetic_of_the_standard(lens: str, tmp_path: Path) -> None:
    camera, count = LENSES[lens]
    scan = scan_of(world_from_scanner=WORLD)
    path = exported(RegisteredScan(scan, (registered(photo_of(camera)),)), tmp_path / "out")
    file = opened(path)
    images = file.root()["images2D"]
    guid = file.root()["data3D"][0]["guid"].value()
    drawn = [images[k] for k in range(images.childCount()) if not images[k].isDefined("visualReferenceRepresentation")]
    assert images.childCount() >= count
    assert all(images[k]["associatedData3DGuid"].value() == guid for k in range(images.childCount()))
    for image in drawn:
        shift, levels = misplaced_px(image)
        assert shift < 0.05
        assert levels < 2
    shift, _ = misplaced_px(drawn[0], "half a pixel off")
    assert shift > 0.4
    for control in ("y flipped", "pose transposed"):
        assert misplaced_px(drawn[0], control)[1] > 10, control
    if len(drawn) < images.childCount():
        blob = images[images.childCount() - 1]["visualReferenceRepresentation/jpegImage"].read_buffer().tobytes()
        original = np.asarray(Image.open(io.BytesIO(blob)))
        assert np.abs(original.astype(float) - photo_of(camera).pixels).mean() < 2


@pytest.mark.parametrize("lens", ["pinhole", "5 terms", "panorama"])
def test_points_of_the_cloud_land_on_the_photographs_pixels(lens: str, tmp_path: Path) -> None:
    """Through pose and intrinsics of the image alone, and our own reader gives camera and pose back."""
    camera = LENSES[lens][0]
    source = tmp_path / "a.e57"
    index = e57_samples.write_cartesian(source, scan_of())
    handed = handed_over(source, index, registered(photo_of(camera)))
    path = exported(handed, tmp_path / "out")
    (image,) = [one for one in embedded_images(path, index) if one.camera is not None]
    (files,) = [one for one in extract_images(path, tmp_path / "images", scan_index=index) if one.camera is not None]
    assert files.pose is not None
    assert files.camera is not None
    np.testing.assert_allclose(read_pose(files.pose).matrix, POSE.matrix, atol=1e-8)
    assert image.camera is not None
    ideal = camera.without_distortion() if isinstance(camera, Camera) else camera
    points = POSE @ handed.scan.points[handed.scan.valid][::7].astype(float)
    inside = ideal.contains(ideal.project(points))
    again = read_camera(files.camera)
    away = again.project(points) - ideal.project(points)
    assert np.abs(away[inside]).max() < 1e-6
    assert inside.sum() > 50

    node = opened(path).root()
    image_node = node["images2D"][1]
    centre, rays, _ = rays_by_the_standard(image_node)
    pose = handed.scan.world_from_scanner
    assert pose is not None
    u, v = 40, 30  # the ray of a pixel, and the photograph's pixel of a point along it
    along = POSE @ (pose.inverse @ (centre + 2.5 * rays[v, u]))
    np.testing.assert_allclose(ideal.project(along), [u, v], atol=0.05)
    _, wrong, _ = rays_by_the_standard(image_node, "half a pixel off")
    assert np.abs(ideal.project(POSE @ (pose.inverse @ (centre + 2.5 * wrong[v, u]))) - [u, v]).max() > 0.4


def test_a_photograph_without_distortion_stays_the_file_that_it_is(tmp_path: Path) -> None:
    for name, options in (("a.jpg", {"quality": 83}), ("b.png", {})):
        photo = photo_of(PINHOLE, name=name)
        Image.fromarray(np.asarray(photo.pixels)).save(tmp_path / name, **options)
        decoded = replace(photo, pixels=np.asarray(Image.open(tmp_path / name)))
        handed = RegisteredScan(scan_of(), (registered(decoded, file=tmp_path / name),))
        path = exported(handed, tmp_path / f"out {name}")
        shape = opened(path).root()["images2D"][0]["pinholeRepresentation"]
        blob = shape["jpegImage" if name == "a.jpg" else "pngImage"]
        assert blob.read_buffer().tobytes() == (tmp_path / name).read_bytes()
    other = RegisteredScan(scan_of(), (registered(photo_of(PINHOLE, name="a.jpg"), file=tmp_path / "a.jpg"),))
    path = exported(other, tmp_path / "changed")
    shape = opened(path).root()["images2D"][0]["pinholeRepresentation"]
    assert shape["jpegImage"].read_buffer().tobytes() != (tmp_path / "a.jpg").read_bytes(), "it has other pixels"


def test_several_photographs_and_a_given_pose_are_said(tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_cartesian(source, scan_of())
    wide = Rigid.from_rotvec([0.0, 1.2, 0.0]) @ POSE
    small = photo_of(Camera(90, 140, 80.0, 80.0, 44.5, 69.5), wide, "Tür & <innen>.jpg")
    photos = (registered(photo_of(PINHOLE)), registered(small, wide, name="two", given=True))
    path = exported(handed_over(source, index, *photos), tmp_path / "out")
    root = opened(path).root()
    names = [root["images2D"][k]["name"].value() for k in range(root["images2D"].childCount())]
    assert names == ["Übersicht", "photo.png", "Tür & <innen>.jpg (given, not verified)"]
    assert "Given, not verified" in root["images2D"][2]["description"].value()
    assert "given" not in root["images2D"][1]["description"].value()
    assert "Tür & <innen>.jpg: given, not verified" in root["ladarreg:note"].value()
    assert root["e57LibraryVersion"].value().startswith("ladarreg-")
    again = exported(handed_over(path, index, *photos[:1]), tmp_path / "again")
    note = opened(again).root()["ladarreg:note"].value()
    assert "given" not in note, "an export of an export says what it is itself"
    values = raw_values(root["data3D"][index]["points"])
    where = position(values, libe57.StructureNode(root["data3D"][index]["points"].prototype()))
    in_second = small.camera.contains(small.camera.project(wide @ where), border=1)
    in_second &= values["cartesianInvalidState"] == 0
    assert np.median(np.abs(values["colorRed"] - paint(where)[:, 0])[in_second]) < 2


@pytest.mark.slow
def test_lists_of_equal_children_take_an_image_of_another_kind(tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_cartesian(source, scan_of())
    mixed = b' allowHeterogeneousChildren="1"'
    e57_with_xml(source, lambda xml: xml.replace(b'<images2D type="Vector"' + mixed, b'<images2D type="Vector"'))
    path = exported(handed_over(source, index, registered(photo_of(PINHOLE))), tmp_path / "out")
    assert not opened(source).root()["images2D"].allowHeteroChildren()
    assert opened(path).root()["images2D"].childCount() == 2


def test_the_scanner_of_a_cloud_may_stand_anywhere_in_its_coordinates(tmp_path: Path) -> None:
    room, moved = scan_of(), np.array([12.0, -7.0, 3.0])
    w = e57_samples.Writer(tmp_path / "a.e57")
    points = room.points[room.valid].astype(float) + moved
    fields = {f"cartesian{axis}": (w.real(), points[:, k]) for k, axis in enumerate("XYZ")}
    w.scan({**fields, "intensity": (w.real(), np.linspace(0, 1, len(points)))}, guid="{a}", name="a", pose=w.pose())
    w.close()
    scan = read_scan(tmp_path / "a.e57", origin=tuple(moved.tolist()))
    options = {"origin": tuple(moved.tolist())}
    handed = RegisteredScan(scan, (registered(photo_of(PINHOLE)),), tmp_path / "a.e57", options)
    path = exported(handed, tmp_path / "out")
    root = opened(path).root()
    values = raw_values(root["data3D"][0]["points"])
    assert (np.stack([values[f"cartesian{axis}"] for axis in "XYZ"], axis=-1) == points).all()
    inside = PINHOLE.contains(PINHOLE.project(POSE @ (points - moved)), border=1)
    assert np.median(np.abs(values["colorBlue"] - paint(points - moved)[:, 2])[inside]) < 2
    centre, _, _ = rays_by_the_standard(root["images2D"][0])
    turn = Rigid.from_matrix(
        np.block(
            [
                [np.array([[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1]]), np.array(e57_samples.POSE["t"])[:, None]],
                [np.zeros((1, 3)), 1],
            ]
        )
    )
    np.testing.assert_allclose(centre, turn @ (moved + POSE.centre), atol=1e-6)


def test_a_cancelled_export_leaves_nothing(tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_scaled(source, scan_of())
    for scan_file in (source, None):
        handed = replace(handed_over(source, index, registered(photo_of(PINHOLE))), scan_file=scan_file)
        assert handed.colors  # they are kept, and reported once only
        calls: list[Progress] = []
        ((_, write),) = [job for job in export_files(handed, ["e57"], report=calls.append) if job[0] != "export.json"]
        write(tmp_path / "whole.e57")
        assert calls[-1].done == calls[-1].total > 0
        (tmp_path / "whole.e57").unlink()
        for stop in range(1, len(calls) + 1):

            def report(_: Progress, left: list[int] = [stop]) -> None:  # noqa: B006
                left[0] -= 1
                if not left[0]:
                    raise Cancelled("stopped")

            ((_, write),) = [job for job in export_files(handed, ["e57"], report=report) if job[0] != "export.json"]
            with pytest.raises(Cancelled):
                write(tmp_path / "part.e57")
            assert not (tmp_path / "part.e57").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="the size of files is not limited there")
@pytest.mark.parametrize("is_copy", [True, False])
def test_a_full_disk_leaves_nothing_and_is_said(is_copy: bool, tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_scaled(source, scan_of())
    handed = handed_over(source, index, registered(photo_of(PINHOLE)))
    handed = handed if is_copy else replace(handed, scan_file=None)
    assert handed.colors
    for size in (2_000, 60_000, 145_000):
        with largest_file(size), pytest.raises(ExportError, match=r"cannot be written.*; give a writable folder"):
            export_to(tmp_path / "out", handed, ["e57"])
        assert [path.name for path in tmp_path.iterdir()] == ["a.e57"]


def test_damage_that_shows_only_in_the_points_is_said(tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_scaled(source, scan_of())
    handed = handed_over(source, index, registered(photo_of(PINHOLE)))
    data = bytearray(source.read_bytes())
    data[60_000] ^= 1
    source.write_bytes(data)
    with pytest.raises(ExportError, match=r"^the E57 cannot be copied: .*checksum.*; export the scan again"):
        export_to(tmp_path / "out", handed, ["e57"])
    assert [path.name for path in tmp_path.iterdir()] == ["a.e57"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            b'jpegImage type="Blob" fileOffset="48" length="',
            b'imageMask type="Blob" fileOffset="48" length="99999',
            "claim more",
        ),
        (b'recordCount="5"', b'recordCount="99999999999"', "more than the file has bits"),
        (b'groupingByLine type="Structure"', b'groupingByLine type="String"', "cannot be copied|damaged"),
    ],
)
def test_what_claims_more_than_the_file_holds_is_refused(old: bytes, new: bytes, said: str, tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_cartesian(source, scan_of())
    handed = handed_over(source, index, registered(photo_of(PINHOLE)))

    def change(xml: bytes) -> bytes:
        xml = re.sub(rb'jpegImage type="Blob" fileOffset="\d+"', b'jpegImage type="Blob" fileOffset="48"', xml)
        assert old in xml
        return xml.replace(old, new)

    e57_with_xml(source, change)
    with pytest.raises(LadarregError, match=said):
        export_to(tmp_path / "out", handed, ["e57"])
    assert [path.name for path in tmp_path.iterdir()] == ["a.e57"]


def test_what_cannot_be_copied_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    source = tmp_path / "a.e57"
    index = e57_samples.write_scaled(source, scan_of())
    handed = handed_over(source, index, registered(photo_of(PINHOLE)))
    with pytest.raises(ExportError, match=r"e57 cannot be written: a\.e57 has no scan 7 any more; read the scan again"):
        export_to(tmp_path / "out", replace(handed, scan_options={"scan_index": 7}), ["e57"])
    source.write_bytes(source.read_bytes()[:-1024])
    with pytest.raises(ExportError, match=r"e57 cannot be written: a\.e57.*truncated"):
        export_to(tmp_path / "out", handed, ["e57"])
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_real_files_of_other_writers_are_copied_unchanged(real_data: Path, tmp_path: Path) -> None:
    """The pump of a terrestrial scanner, with groups of lines and colours of its own."""
    source = real_data / "pump" / "pumpAVisualReferenceImage.e57"
    pose = Rigid.from_centre(POSE.rotation @ Rigid.from_rotvec([0, 0, 1.9]).rotation, (0.3, 0.2, 0.1))
    handed = handed_over(source, 0, registered(photo_of(PINHOLE, POSE), pose))
    path = exported(handed, tmp_path / "out")
    old_file, file = map(opened, (source, path))
    changed = set(differences(old_file.root(), file.root()))
    colors = {f"/data3D/0/points/{name}: values" for name in COLORS}
    assert changed == {"/guid: value", "/e57LibraryVersion: value", "/creationDateTime/dateTimeValue: value", *colors}
    before, after = (raw_values(each.root()["data3D"][0]["points"]) for each in (old_file, file))
    scan: Scan = read_scan(path)
    assert scan.color is not None
    unseen = scan.valid & (handed.colors.photo == 65535)
    assert (scan.color[unseen] == handed.scan.color[unseen]).all()  # type: ignore[index]
    assert 0.05 < np.mean(before["colorRed"] != after["colorRed"]) < 0.95
