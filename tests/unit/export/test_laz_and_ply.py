"""The targets `laz` and `ply`, read back by laspy and by hand; the true pose of the simulated camera is known."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import trimesh

from ladarreg_core.camera import Camera, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import Cancelled
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.formats import read_scan
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.surface.texture.registered_texture import Label
from testing.scenes.simulated_clouds import dome, in_room
from testing.scenes.small_registration import sample_photo, sample_registration, sample_scan

UTM = np.array([691_234.5, 5_334_321.25, 519.0])
SCANNER = UTM + np.array([0.4, -0.6, 1.5])
SIZE = (126, 120)
CAMERA = Camera(*SIZE, 60.0, 61.0, 63.0, 59.0, (0.05, -0.01, 0.001, 0.0))
POSE = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.2, 0.3, -0.1))


def photo() -> Photo:
    """A picture whose red is twice the column and whose green is twice the row of a pixel."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    return Photo(np.stack([2 * u, 2 * v, np.full_like(u, 77)], axis=-1).astype(np.uint8), CAMERA, name="Straße 1")


def registered(scan: Any, file: Path | None, photos: int = 1, **fields: Any) -> RegisteredScan:
    result = replace(sample_registration(), camera_from_scanner=POSE, camera=CAMERA, **fields)
    ones = tuple(RegisteredPhoto(f"p{k}", photo(), result) for k in range(photos))
    return RegisteredScan(scan, ones, file, frame=OutputFrame())


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LAS of a room with every kind of field, made by laspy."""
    points = in_room(dome(1.2)) + UTM
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.0005, 0.00025, 0.001], np.floor(UTM)
    header.add_extra_dim(laspy.ExtraBytesParams("reflectance", "float32"))
    header.add_extra_dim(
        laspy.ExtraBytesParams("deviation", "uint16", scales=np.array([0.01]), offsets=np.array([5.0]))
    )
    header.add_extra_dim(laspy.ExtraBytesParams("label", "int8", description="somebody's own"))
    wkt = 'PROJCS["ETRS89 / UTM zone 32N"]'
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    header.vlrs.append(laspy.VLR("somebody", 7, "theirs", b"kept"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    rng = np.random.default_rng(5)
    count = len(points)
    data.intensity = rng.integers(0, 60000, count)
    data.gps_time, data.classification = rng.random(count) * 1e9, rng.integers(0, 255, count)
    data.scan_angle, data.user_data = rng.integers(-3000, 3000, count), rng.integers(0, 255, count)
    data.return_number, data.number_of_returns = rng.integers(1, 3, count), np.full(count, 3)
    data.point_source_id = rng.integers(0, 65535, count)
    data["reflectance"], data["label"] = rng.random(count), rng.integers(-5, 5, count)
    data.points.array["deviation"] = rng.integers(0, 65535, count)
    path = tmp_path_factory.mktemp("las") / "hall 3.las"
    data.write(path)
    return path


def test_a_las_keeps_every_field_and_gains_colors(cloud: Path, tmp_path: Path) -> None:
    scan = read_scan(cloud, origin=tuple(SCANNER.tolist()))
    export_to(tmp_path / "out", registered(scan, cloud), ["laz"])
    before, after = laspy.read(cloud), laspy.read(tmp_path / "out" / "laz" / "hall 3.laz")
    assert (after.header.version.minor, after.header.point_format.id) == (4, 7)
    np.testing.assert_array_equal(after.header.scales, before.header.scales)
    np.testing.assert_array_equal(after.header.offsets, before.header.offsets)
    for name in before.points.array.dtype.names:
        np.testing.assert_array_equal(after.points.array[name], before.points.array[name], err_msg=name)
    assert after.header.global_encoding.wkt
    kept = {(vlr.user_id, vlr.record_id) for vlr in before.header.vlrs} - {("LASF_Spec", 4)}
    assert kept <= {(vlr.user_id, vlr.record_id) for vlr in after.header.vlrs}
    assert (
        after.header.vlrs.get("WktCoordinateSystemVlr")[0].string
        == before.header.vlrs.get("WktCoordinateSystemVlr")[0].string
    )
    extra = {one.name: one for one in after.point_format.extra_dimensions}
    assert extra["deviation"].scales.tolist() == [0.01]
    assert {"photo_id", "ladarreg_label", "sigma_px"} <= set(extra)

    # Where the laser's points lie in the photograph follows from the truth, and their colours say it, too.
    shown = np.asarray(after["photo_id"]) == 1
    xyz = after.xyz[shown] - SCANNER
    uv = CAMERA.project(POSE @ xyz)
    rgb = np.stack([after.red, after.green, after.blue], axis=-1)[shown] // 257
    assert shown.sum() > 2000
    assert set(np.unique(rgb[:, 2])) == {77}
    off = rgb[:, :2] / 2 - uv
    inner = (uv > 1).all(axis=1) & (uv < np.array(SIZE) - 2).all(axis=1)
    assert np.abs(off[inner]).max() < 0.51, "rounding, and means of two pixels"
    assert np.abs(off[inner].mean(axis=0)).max() < 0.05
    for wrong in (CAMERA.project(POSE @ (xyz * [1, -1, 1])), uv + 0.5):
        assert np.nanmax(np.abs(np.nanmean(rgb[:, :2] / 2 - wrong, axis=0))) > 0.3, "the controls"
    labels = np.asarray(after["ladarreg_label"])
    assert set(np.unique(labels[shown])) <= {Label.SEEN, Label.GRAZING, Label.UNCERTAIN}
    assert np.isfinite(np.asarray(after["sigma_px"])[shown]).all()
    hidden = ~shown
    gray = np.stack([after.red, after.green, after.blue], axis=-1)[hidden]
    assert (np.ptp(gray.astype(int), axis=1) == 0).all()


def test_a_second_export_of_the_export_keeps_the_first_and_its_colors_where_no_photograph_sees(
    cloud: Path, tmp_path: Path
) -> None:
    scan = read_scan(cloud, origin=tuple(SCANNER.tolist()))
    export_to(tmp_path / "first", registered(scan, cloud), ["laz"])
    first = tmp_path / "first" / "laz" / "hall 3.laz"
    again = registered(read_scan(first, origin=tuple(SCANNER.tolist())), first)
    export_to(tmp_path / "second", again, ["laz"])
    a, b = laspy.read(first), laspy.read(tmp_path / "second" / "laz" / "hall 3.laz")
    np.testing.assert_array_equal(a["photo_id"], b["photo_id"])
    assert "ladarreg_photo_id" in b.point_format.extra_dimension_names
    unseen = np.asarray(b["ladarreg_photo_id"]) == 0
    np.testing.assert_array_equal(np.asarray(a.red)[unseen], np.asarray(b.red)[unseen])


@pytest.mark.parametrize(("old", "new", "version"), [(0, 2, "1.2"), (1, 3, "1.2"), (3, 3, "1.2"), (6, 7, "1.4")])
def test_geotiff_keys_alone_keep_a_file_in_its_version(tmp_path: Path, old: int, new: int, version: str) -> None:
    header = laspy.LasHeader(point_format=old, version="1.2" if old < 6 else "1.4")
    header.scales = [0.001] * 3
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "GeoTIFF", b"\1\0\1\0\0\0\0\0"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = (in_room(dome(3.0)) - [0.4, -0.6, 1.5]).T
    data.intensity = np.arange(len(data.x)) % 5000
    file = tmp_path / "old.las"
    data.write(file)
    export_to(tmp_path / "out", registered(read_scan(file, origin=(0, 0, 0)), file), ["laz"])
    found = laspy.read(tmp_path / "out" / "laz" / "old.laz")
    assert (str(found.header.version), found.header.point_format.id) == (version, new)
    np.testing.assert_array_equal(found.X, data.X)
    assert any(vlr.record_id == 34735 for vlr in found.header.vlrs)
    assert not found.header.global_encoding.wkt, "readers would look for WKT and find no reference system"
    assert "GeoTIFF" in json.loads((tmp_path / "out" / "laz" / "legend.json").read_text())["notes"][0]


def written_again(tmp_path: Path, name: str, *, point_format: int = 6, evlrs: Any = None, **fields: Any) -> Any:
    """Return a cloud written by laspy, its copy, and the paths of both."""
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales = [0.001] * 3
    header.vlrs.extend(fields.pop("vlrs", []))
    for key, values in fields.items():
        if key not in header.point_format.dimension_names:
            header.add_extra_dim(laspy.ExtraBytesParams(key, values.dtype))
    data = laspy.LasData(header)
    data.x, data.y, data.z = (in_room(dome(3.0)) - [0.4, -0.6, 1.5]).T
    data.intensity = np.arange(len(data.x)) % 5000
    for key, values in fields.items():
        data[key] = values
    if evlrs is not None:
        data.evlrs = laspy.vlrs.vlrlist.VLRList(evlrs)
    file = tmp_path / name
    data.write(file)
    if "hidden" in fields:  # the record that describes the extra bytes
        file.write_bytes(file.read_bytes().replace(b"LASF_Spec", b"SomeoneXX"))
    export_to(tmp_path / "out", registered(read_scan(file, origin=(0, 0, 0)), file), ["laz"])
    (copy,) = (tmp_path / "out" / "laz").glob("*.laz")
    return laspy.read(file), laspy.read(copy), file, copy


COUNT = len(in_room(dome(3.0)))


def stored_records(data: bytes) -> dict[tuple[bytes, int], bytes]:
    """Return the variable length records by user and number, parsed by hand."""
    at, _, count = struct.unpack_from("<HII", data, 94)
    found = {}
    for _ in range(count):
        user, number, size = struct.unpack_from("<2x16sHH", data, at)
        found[user.rstrip(b"\0"), number] = data[at : at + 54 + size]
        at += 54 + size
    return found


def test_records_of_others_are_copied_byte_by_byte_but_not_those_of_copc(tmp_path: Path) -> None:
    wkt = laspy.vlrs.known.WktCoordinateSystemVlr('PROJCS["ETRS89"]')
    theirs = [laspy.VLR("LASF_Spec", 3, "text", b"a\0b"), laspy.VLR("copc", 1, "COPC info", bytes(160))]
    _, after, file, copy = written_again(tmp_path, "x.copc.las", vlrs=theirs, evlrs=[wkt])
    assert copy.name == "x.laz"
    before, now = (stored_records(path.read_bytes()) for path in (file, copy))
    assert now[b"LASF_Spec", 3] == before[b"LASF_Spec", 3]
    assert (b"copc", 1) not in now
    assert [(one.user_id, one.record_id, one.string) for one in after.evlrs] == [
        ("LASF_Projection", 2112, 'PROJCS["ETRS89"]')
    ]
    assert after.header.global_encoding.wkt


def test_header_states_bounds_and_returns(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    numbers = rng.integers(1, 6, COUNT)
    before, after, _, _ = written_again(tmp_path, "r.las", return_number=numbers, number_of_returns=numbers * 0 + 5)
    np.testing.assert_allclose(after.header.mins, before.xyz.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(after.header.maxs, before.xyz.max(axis=0), atol=1e-9)
    assert after.header.number_of_points_by_return[:5].tolist() == np.bincount(numbers)[1:].tolist()
    assert after.header.point_count == COUNT


def test_colors_of_eight_bits_become_sixteen_beside_the_photographs(tmp_path: Path) -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (3, COUNT)).astype(np.uint16)
    fields = dict(zip(("red", "green", "blue"), rgb, strict=True))
    before, after, _, _ = written_again(tmp_path, "c.las", point_format=8, nir=rgb[0] * 3, **fields)
    assert after.header.point_format.id == 8
    np.testing.assert_array_equal(after.nir, before.nir)
    unseen = np.asarray(after.photo_id) == 0
    assert 100 < unseen.sum() < COUNT - 100
    np.testing.assert_array_equal(after.green[unseen], before.green[unseen] * 257)


def test_extra_bytes_without_a_description_stay(tmp_path: Path) -> None:
    hidden = np.random.default_rng(4).integers(0, 2**32, COUNT).astype(np.uint32)
    _, after, _, _ = written_again(tmp_path, "h.las", hidden=hidden)
    (name, *ours) = after.point_format.extra_dimension_names
    assert ours == ["photo_id", "label", "sigma_px"]
    np.testing.assert_array_equal(np.ascontiguousarray(after[name]).view(np.uint32).ravel(), hidden)


def test_points_of_old_formats_keep_their_flags_and_angles(tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = [0.001] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = (in_room(dome(3.0)) - [0.4, -0.6, 1.5]).T
    data.intensity = np.arange(len(data.x)) % 5000
    count = len(data.x)
    data.scan_angle_rank = np.arange(count) % 181 - 90
    rng = np.random.default_rng(1)
    flags = {"return_number": 8, "number_of_returns": 8, "classification": 32, "scan_direction_flag": 2,
             "edge_of_flight_line": 2, "synthetic": 2, "key_point": 2, "withheld": 2, "user_data": 256,
             "point_source_id": 65536}  # fmt: skip
    for name, most in flags.items():
        data[name] = rng.integers(0, most, count)
    data.gps_time = rng.random(count) * 1e9
    file = tmp_path / "old.las"
    data.write(file)
    export_to(tmp_path / "out", registered(read_scan(file, origin=(0, 0, 0)), file), ["laz"])
    found = laspy.read(tmp_path / "out" / "laz" / "old.laz")
    assert found.header.point_format.id == 7
    for name in (*flags, "gps_time", "intensity", "X", "Y", "Z"):
        np.testing.assert_array_equal(found[name], data[name], err_msg=name)
    np.testing.assert_allclose(np.asarray(found.scan_angle) * 0.006, data.scan_angle_rank, atol=0.003)


@pytest.mark.parametrize("in_world", [False, True])
def test_another_scan_is_written_in_the_world(tmp_path: Path, in_world: bool) -> None:
    world = Rigid.from_rotvec((0.01, -0.02, 1.1), UTM) if in_world else None
    scan = replace(sample_scan(), world_from_scanner=world)
    handed = RegisteredScan(scan, (RegisteredPhoto("p1", sample_photo(), sample_registration()),))
    export_to(tmp_path / "out", handed, ["laz", "ply"])
    found = laspy.read(tmp_path / "out" / "laz" / "cloud.laz")
    expected = scan.points[scan.valid].astype(np.float64)
    expected = expected if world is None else world @ expected
    np.testing.assert_allclose(found.xyz, expected, atol=0.6e-4, rtol=0)
    np.testing.assert_allclose(found.intensity, scan.intensity[scan.valid] * 65535 / scan.intensity.max(), atol=1)
    legend = json.loads((tmp_path / "out" / "laz" / "legend.json").read_text())
    assert legend["coordinates"].startswith("world" if in_world else "scanner")
    assert legend["photo_id"] == {"0": None, "1": "photo"}
    labels = handed.colors.labels[scan.valid]
    np.testing.assert_array_equal(found["label"], labels)
    seen = labels == Label.SEEN
    rgb = np.stack([found.red, found.green, found.blue], axis=-1) // 257
    np.testing.assert_array_equal(rgb[seen], handed.colors.image[scan.valid][seen])

    header, _, body = (tmp_path / "out" / "ply" / "cloud.ply").read_bytes().partition(b"end_header\n")
    assert b"comment photo_id 1: photo (accepted (image))" in header
    assert header.count(b"property") == 10
    layout = "<f4,<f4,<f4,u1,u1,u1,<f4,u1,<u2,<f4"
    vertices = np.frombuffer(body, np.dtype(layout))
    np.testing.assert_array_equal(vertices["f7"], labels)
    np.testing.assert_array_equal(vertices["f8"], np.asarray(found["photo_id"]))
    np.testing.assert_array_equal(vertices["f9"], np.asarray(found["sigma_px"]))


def test_a_given_pose_is_marked_and_a_cancelled_export_leaves_nothing(cloud: Path, tmp_path: Path) -> None:
    scan = read_scan(cloud, origin=tuple(SCANNER.tolist()))
    handed = registered(scan, cloud, accepted=False, evidence="given")
    export_to(tmp_path / "out", handed, ["laz", "ply"])
    found = laspy.read(tmp_path / "out" / "laz" / "hall 3.laz")
    (legend,) = [vlr for vlr in found.header.vlrs if vlr.user_id == "ladarreg"]
    assert json.loads(legend.record_data)["poses"] == {"1": "given, not verified"}
    assert b"given, not verified" in (tmp_path / "out" / "ply" / "cloud.ply").read_bytes()[:2000]

    def cancel(progress: Progress) -> None:
        if progress.label.startswith("writing hall"):
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        export_to(tmp_path / "new", handed, ["laz"], report=cancel)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_several_photographs_in_the_world_by_laspy_and_trimesh(tmp_path: Path) -> None:
    world = Rigid.from_rotvec((0.02, -0.01, 2.0), UTM)
    scan = replace(sample_scan(), world_from_scanner=world)
    cameras = (
        Camera(110, 84, 80.0, 82.0, 53.0, 43.0),
        FisheyeCamera(160, 100, 60.0, 61.0, 80.0, 49.0, (0.02, -0.01, 0.003, -0.0004)),
        EquirectangularCamera(240, 120),
    )
    poses = [
        Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, centre) for centre in ((0.1, 1.0, 0), (0, -1, 0.1), (1.45, 0, 0))
    ]
    ones = []
    for k, (camera, pose) in enumerate(zip(cameras, poses, strict=True)):
        v, u = np.mgrid[: camera.height, : camera.width]
        levels = 250 / max(camera.size)
        pixels = np.rint(np.stack([levels * u, levels * v, 50 * k + 0 * u], axis=-1)).astype(np.uint8)
        if k == 1:
            pixels = np.repeat(pixels[..., :1], 3, axis=-1)  # gray, as a thermal or 16-bit picture is shown
        result = replace(sample_registration(), camera=camera, camera_from_scanner=pose)
        ones.append(RegisteredPhoto(f"p{k}", Photo(pixels, camera, name=f"Größe {k}, 図.jpg"), result))
    (tmp_path / "gone.ptx").write_text("the file that it was read from")
    handed = RegisteredScan(scan, tuple(ones), tmp_path / "gone.ptx", frame=OutputFrame.of(scan, "world"))
    export_to(tmp_path / "out", handed, ["laz", "ply"])
    found = laspy.read(tmp_path / "out" / "laz" / "gone.laz")
    ply = trimesh.load(tmp_path / "out" / "ply" / "cloud.ply")
    raw = ply.metadata["_ply_raw"]["vertex"]["data"]
    offset = json.loads((tmp_path / "out" / "ply" / "offset.json").read_text())["offset_m"]

    np.testing.assert_allclose(found.xyz - offset, np.asarray(ply.vertices), atol=0.6e-4)
    ids, rgb = np.asarray(found["photo_id"]), np.stack([found.red, found.green, found.blue], axis=-1) // 257
    np.testing.assert_array_equal(raw["photo_id"].ravel(), ids)
    np.testing.assert_array_equal(ply.colors[ids > 0, :3], rgb[ids > 0])
    legend = json.loads((tmp_path / "out" / "laz" / "legend.json").read_text())
    assert legend["photo_id"]["3"] == "Größe 2, 図.jpg"

    points = (found.xyz - UTM) @ world.rotation
    others = [1, 2, 0]
    for k, (camera, pose) in enumerate(zip(cameras, poses, strict=True)):
        mine = ids == k + 1
        assert mine.sum() > 20
        channels = 1 if k == 1 else 2
        seen = rgb[mine][:, :channels] * max(camera.size) / 250

        def mean_error(at: np.ndarray, k: int = k, seen: np.ndarray = seen, shift: float = 0.0) -> float:
            uv = cameras[k].project(at) + shift
            return float(np.abs(np.nanmean(seen - uv[:, : seen.shape[1]], axis=0)).max())

        at = pose @ points[mine]
        assert mean_error(at) < 0.15
        assert mean_error(at, shift=0.5) > 0.3, "half a pixel off"
        assert mean_error(pose @ (points[mine] * [1, -1, 1])) > 1, "an axis flipped"
        assert mean_error(poses[others[k]] @ points[mine]) > 1, "the pose of another photograph"
    first = points[ids == 1] - poses[0].centre  # by hand: x right is -Y, y down is -Z, z forward is X
    by_hand = np.stack([53 - 80 * first[:, 1] / first[:, 0], 43 - 82 * first[:, 2] / first[:, 0]], axis=-1)
    assert np.abs((rgb[ids == 1][:, :2] * 110 / 250 - by_hand).mean(axis=0)).max() < 0.15
