"""PLY clouds, written by trimesh, by NumPy, by our own export and as other programs name their fields."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.errors import FormatError, LadarregError, ShapeError
from ladarreg_core.formats import describe, read_scan, recognise
from ladarreg_core.formats.scans.ply import read_ply
from ladarreg_core.scan import Scan
from testing.files.small_scans import make_scan

ORIGIN = (431_250.5, 5_412_000.25, 318.125)
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")


def cloud(scan: Scan) -> dict[str, np.ndarray]:
    """The returns of a scan as columns, shuffled."""
    order = np.random.default_rng(2).permutation(int(scan.valid.sum()))
    points = scan.points[scan.valid][order]
    row, column = (a[order] for a in np.nonzero(scan.valid))
    columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
    columns |= {"red": (row * 3).astype("u1"), "green": (column * 5).astype("u1"), "blue": np.full(len(row), 9, "u1")}
    return columns | {"intensity": scan.intensity[scan.valid][order]}


def ply_bytes(
    columns: dict[str, np.ndarray], encoding: str = "binary_little_endian", *, faces: int = 0, end: str = "\n"
) -> bytes:
    types = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
    count = len(next(iter(columns.values())))
    lines = ["ply", f"format {encoding} 1.0", "comment Created by a program", f"element vertex {count}"]
    lines += [f"property {types[c.dtype.str[1:]]} {name}" for name, c in columns.items()]
    if faces:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    head = end.join([*lines, "end_header", ""]).encode()
    if encoding == "ascii":
        text = io.StringIO()
        np.savetxt(text, np.stack([c.astype("f8") for c in columns.values()], axis=1), fmt="%.9g", newline=end)
        return head + (text.getvalue() + f"3 0 1 2{end}" * faces).encode()
    order = "<" if "little" in encoding else ">"
    table = np.zeros(count, [(name, c.dtype.newbyteorder(order)) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    face = np.array([(3, (0, 1, 2))] * faces, [("n", "u1"), ("v", order + "i4", 3)])
    return head + table.tobytes() + face.tobytes()


def seed_files(folder: Path) -> list[Path]:
    """Write valid files; `tests/abuse` reads damaged copies of them."""
    columns = cloud(make_scan(12, 15))
    files = [folder / f"{encoding}.ply" for encoding in ENCODINGS]
    for file, encoding in zip(files, ENCODINGS, strict=True):
        file.write_bytes(ply_bytes(columns, encoding, faces=2))
    return files


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def same_points(scan: Scan, wall: Scan, atol: float = 2e-6) -> None:
    found, wanted = (np.c_[s.points[s.valid], s.intensity[s.valid]] for s in (scan, wall))
    assert found.shape == wanted.shape
    np.testing.assert_allclose(_sorted(found, atol), _sorted(wanted, atol), atol=max(atol, 1e-5))


def _sorted(rows: np.ndarray, atol: float) -> np.ndarray:
    keys = np.round(rows[:, :3] / (20 * atol))
    return np.asarray(rows[np.lexsort(keys.T)])


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_every_encoding_gives_the_same_scan(tmp_path: Path, wall: Scan, encoding: str, end: str) -> None:
    path = write(tmp_path / "a.ply", ply_bytes(cloud(wall), encoding, end=end))
    assert recognise(path).name == "PLY"
    scan = read_scan(path)
    same_points(scan, wall)
    assert scan.color is not None
    assert set(scan.color[scan.valid][:, 2].tolist()) == {9}


@pytest.mark.parametrize(
    "name", ["scalar_Intensity", "intensity", "reflectance", "Reflectance", "scalar_Scan_intensity", "amplitude"]
)
def test_the_intensity_is_found_under_its_names(tmp_path: Path, wall: Scan, name: str) -> None:
    columns = cloud(wall)
    columns[name] = columns.pop("intensity")
    same_points(read_ply(write(tmp_path / "a.ply", ply_bytes(columns)), origin=(0, 0, 0)), wall)


def test_trimesh_writes_what_is_read(tmp_path: Path, wall: Scan) -> None:
    trimesh = pytest.importorskip("trimesh")
    columns = cloud(wall)
    points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    rgb = np.stack([columns[name] for name in ("red", "green", "blue")], axis=-1)
    path = tmp_path / "a.ply"
    trimesh.PointCloud(points, colors=rgb).export(path)
    with pytest.raises(FormatError, match="`intensity='luma'`"):
        read_scan(path)
    scan = read_scan(path, intensity="luma")
    assert scan.valid.sum() == wall.valid.sum()
    np.testing.assert_allclose(
        scan.intensity[scan.valid], scan.color[scan.valid] @ [0.2126, 0.7152, 0.0722], atol=1e-3  # type: ignore[index]
    )  # fmt: skip
    mesh = trimesh.Trimesh(points, [[0, 1, 2], [1, 2, 3]], process=False)
    mesh.export(path)
    with pytest.raises(FormatError, match="mesh of 2 faces whose vertices have 'x y z', neither intensity nor colours"):
        read_scan(path)


def test_the_vertices_of_a_mesh_are_read_and_its_faces_left_out(tmp_path: Path, wall: Scan) -> None:
    for encoding in ENCODINGS:
        scan = read_ply(write(tmp_path / "a.ply", ply_bytes(cloud(wall), encoding, faces=7)), origin=(0, 0, 0))
        same_points(scan, wall)
        assert any("its 7 faces are left out" in note for note in scan.notes)


def test_large_coordinates_keep_their_digits(tmp_path: Path, wall: Scan) -> None:
    columns = cloud(wall)
    for axis, offset in zip("xyz", ORIGIN, strict=True):
        columns[axis] = columns[axis].astype("f8") + offset
    scan = read_scan(write(tmp_path / "a.ply", ply_bytes(columns)), origin=ORIGIN)
    same_points(scan, wall)
    assert scan.world_from_scanner is not None
    np.testing.assert_array_equal(scan.world_from_scanner.translation, ORIGIN)
    rounded = {name: c.astype("f4") if name in "xyz" else c for name, c in columns.items()}
    with pytest.raises(ShapeError, match=r"single precision.* 0\.5 m apart"):  # in which they are lost
        read_scan(write(tmp_path / "b.ply", ply_bytes(rounded)), origin=ORIGIN)


def test_our_own_cloud_is_read_back(tmp_path: Path, wall: Scan) -> None:
    from ladarreg_core.camera import Camera
    from ladarreg_core.export.clouds.ply import write_ply
    from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
    from ladarreg_core.photo import Photo
    from ladarreg_core.surface.texture.registered_texture import texture_scan

    photo = Photo(np.full((40, 60, 3), 77, np.uint8), Camera.from_focal(60, 40, 60.0))
    pose = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))
    write_ply(tmp_path / "cloud.ply", wall, texture_scan(wall, photo, pose))
    same_points(read_scan(tmp_path / "cloud.ply"), wall)


@pytest.mark.parametrize(("dtype", "largest"), [("u1", 255), ("u2", 65535), ("f4", 1.0)])
def test_colors_of_any_depth(tmp_path: Path, wall: Scan, dtype: str, largest: float) -> None:
    columns = cloud(wall)
    share = np.linspace(0, 1, len(columns["x"]))
    for name in ("red", "green", "blue"):
        columns[name] = (share * largest).astype(dtype)
    color = read_ply(write(tmp_path / "a.ply", ply_bytes(columns)), origin=(0, 0, 0)).color
    assert color is not None
    assert color.max() == 255
    assert abs(float(np.median(color[color > 0])) - 128) < 4


def test_damage_is_said_in_a_sentence(tmp_path: Path, wall: Scan) -> None:
    good, text = ply_bytes(cloud(wall)), ply_bytes(cloud(wall), "ascii")
    broken = {
        "only .* bytes follow": good[:-40],
        "truncated": text[: len(text) * 3 // 4],
        "end_header": good[:90],
        "have lists, which are not read": good.replace(b"property float intensity", b"property list uchar int a"),
        "'x y w": good.replace(b"float z", b"float w"),
        "type 'colour'": good.replace(b"uchar red", b"colour red"),
        "'ebcdic'": good.replace(b"binary_little_endian", b"ebcdic"),
        "its 99,999,999,999 points would need": text.replace(
            f"vertex {wall.valid.sum()}".encode(), b"vertex 99999999999"
        ),
    }
    for words, data in broken.items():
        with pytest.raises(LadarregError, match=words):
            read_scan(write(tmp_path / "a.ply", data))


def test_info_describes_it(tmp_path: Path, wall: Scan) -> None:
    info = describe(write(tmp_path / "a.ply", ply_bytes(cloud(wall))))
    assert (info.format, info.returns, info.color) == ("PLY", int(wall.valid.sum()), True)
