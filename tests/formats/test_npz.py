"""NPZ scans: files are read back as written, and hostile ones are refused."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import FormatError, LadarregError, ShapeError
from ladarreg_core.formats.scans.npz import read_npz, write_npz_counts, write_npz_xyz
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

SCALARS = {"r0_m": 1.0, "dr_m": 0.0022, "d_azimuth_rad": 0.01, "d_elevation_rad": 0.012}


def save(path: Path, **arrays: Any) -> Path:
    np.savez_compressed(path, **arrays)
    return path


def good_counts(shape: tuple[int, int] = (6, 8)) -> dict[str, Any]:
    counts = np.arange(shape[0] * shape[1], dtype=np.uint16).reshape(shape) * 30
    return {"counts": counts, "intensity": counts + 1, **SCALARS}


@given(
    counts=st.lists(st.integers(0, 4095), min_size=12, max_size=12).filter(any),
    offset=st.floats(-0.2, 0.2),
    dtype=st.sampled_from(["<u2", ">u2", "<i4", ">u4"]),
    order=st.sampled_from("CF"),
)
def test_counts_follow_the_range_equation(
    tmp_path_factory: pytest.TempPathFactory, counts: list[int], offset: float, dtype: str, order: Any
) -> None:
    path = tmp_path_factory.mktemp("npz") / "scan.npz"
    grid = np.array(counts).reshape(3, 4)
    scalars = SCALARS | {"azimuth_offset_rad": offset}
    save(path, counts=np.asarray(grid.astype(dtype), order=order), intensity=grid.astype("f4"), **scalars)
    scan = read_npz(path)
    np.testing.assert_array_equal(scan.valid, grid > 0)
    np.testing.assert_allclose(scan.ranges[scan.valid], (1.0 + grid * 0.0022)[grid > 0], rtol=1e-7)
    assert scan.geometry == AzimuthElevation(3, 4, 0.01, 0.012, offset, 0.0)


def test_written_counts_are_read_back(tmp_path: Path, wall: Scan) -> None:
    assert isinstance(wall.geometry, AzimuthElevation)
    counts = np.where(wall.valid, np.rint((np.nan_to_num(wall.ranges) - 1) / 0.002), 0).astype(np.uint16)
    write_npz_counts(
        tmp_path / "a.npz", counts=counts, intensity=wall.intensity, geometry=wall.geometry, r0_m=1.0, dr_m=0.002,
        intensity_is="range_normalised",
    )  # fmt: skip
    scan = read_npz(tmp_path / "a.npz")
    np.testing.assert_allclose(scan.ranges, wall.ranges, rtol=1e-6)
    np.testing.assert_array_equal(scan.intensity, wall.intensity)
    assert (scan.geometry, scan.intensity_is, scan.name) == (wall.geometry, "range_normalised", "a")


def test_written_points_are_read_back_to_the_bit(tmp_path: Path, wall: Scan) -> None:
    color = np.random.default_rng(0).integers(0, 256, (*wall.shape, 3), dtype=np.uint8)
    write_npz_xyz(tmp_path / "a.npz", Scan(wall.geometry, wall.ranges, wall.intensity, color=color))
    scan = read_npz(tmp_path / "a.npz")
    np.testing.assert_allclose(scan.points, wall.points, atol=1e-6)
    np.testing.assert_array_equal(scan.color, color)
    # Cells without a return have a ray too, close to the scanner's direction.
    assert np.abs(scan.rays - wall.rays).max() < 0.25 * 0.01


def test_zero_nan_and_infinite_points_are_no_returns(tmp_path: Path, wall: Scan) -> None:
    xyz = np.array(wall.points, dtype=np.float64)
    xyz[0, 0], xyz[1, 1], xyz[2, 2], xyz[3, 3] = 0, np.inf, [np.nan, 1, 1], 1e200
    scan = read_npz(save(tmp_path / "a.npz", xyz=xyz, intensity=wall.intensity))
    expected = np.array(wall.valid)
    expected[[0, 1, 2, 3], [0, 1, 2, 3]] = False
    np.testing.assert_array_equal(scan.valid, expected)


def test_cells_without_finite_intensity_are_no_returns(tmp_path: Path) -> None:
    fields = good_counts()
    fields["intensity"] = fields["intensity"].astype(np.float64)
    fields["intensity"][2, 3:6] = [np.nan, np.inf, 1e300]
    scan = read_npz(save(tmp_path / "a.npz", **fields))
    assert not scan.valid[2, 3:6].any()
    assert scan.valid.sum() == 6 * 8 - 1 - 3


def test_millimetres_are_suspected_and_not_converted(tmp_path: Path, wall: Scan) -> None:
    scan = read_npz(save(tmp_path / "a.npz", xyz=wall.points * 1000, intensity=wall.intensity))
    assert any("millimetres" in note and f"{np.nanmedian(scan.ranges):,.0f}" in note for note in scan.notes)
    assert np.nanmedian(scan.ranges) > 2000
    assert read_npz(save(tmp_path / "b.npz", xyz=wall.points, intensity=wall.intensity)).notes == ()


def test_a_mirrored_grid_is_noted_and_kept(tmp_path: Path, wall: Scan) -> None:
    scan = read_npz(save(tmp_path / "a.npz", xyz=wall.points[:, ::-1], intensity=wall.intensity))
    assert "mirrored" in scan.notes[0]
    np.testing.assert_allclose(scan.points, wall.points[:, ::-1], atol=1e-6)


class Explosive:
    def __reduce__(self) -> Any:
        return (pytest.fail, ("it was unpickled",))


def bad_files(folder: Path) -> dict[str, Path]:
    """Invalid files, by a phrase that the error must contain."""
    objects = np.empty((6, 8), dtype=object)
    objects[:] = Explosive()
    good = good_counts()
    files = {
        "pickled": save(folder / "pickle.npz", **good | {"intensity": objects}),
        "no 'intensity'": save(folder / "none.npz", xyz=np.ones((6, 8, 3))),
        "either 'xyz'": save(folder / "neither.npz", intensity=good["intensity"]),
        "both 'xyz' and 'counts'": save(folder / "both.npz", **good, xyz=np.ones((6, 8, 3))),
        "must agree": save(folder / "shape.npz", **good | {"intensity": np.ones((6, 9))}),
        "(H, W)": save(folder / "flat.npz", **good | {"intensity": np.ones(48)}),
        "'r0_m' is missing": save(folder / "scalar.npz", counts=good["counts"], intensity=good["intensity"]),
        "'dr_m' is nan": save(folder / "nan.npz", **good | {"dr_m": np.nan}),
        "'dr_m' is 0": save(folder / "zero.npz", **good | {"dr_m": 0.0}),
        "d_azimuth_rad": save(folder / "degrees.npz", **good | {"d_azimuth_rad": 5.0}),
        "one number": save(folder / "vector.npz", **good | {"dr_m": [0.1, 0.2]}),
        "must contain integers": save(folder / "float.npz", **good | {"counts": good["counts"] * 1.0}),
        "must not be negative": save(folder / "negative.npz", **good | {"counts": -good["counts"].astype(int)}),
        "numbers": save(folder / "text.npz", **good | {"intensity": np.full((6, 8), "a")}),
        "'intensity_is'": save(folder / "word.npz", **good, intensity_is="cooked"),
        "no returns": save(folder / "blind.npz", **good | {"counts": good["counts"] * 0}),
        "2 x 2": save(folder / "one.npz", **{k: v[:1, 1:2] if np.ndim(v) else v for k, v in good.items()}),
        "must be positive": save(folder / "empty.npz", **{k: v[:0] if np.ndim(v) else v for k, v in good.items()}),
        "no returns: every": save(folder / "xyz0.npz", xyz=np.zeros((6, 8, 3)), intensity=np.ones((6, 8))),
    }
    with zipfile.ZipFile(folder / "odd.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    return files | {"readme.txt": folder / "odd.zip"}


def test_every_bad_file_is_one_clear_error(tmp_path: Path) -> None:
    for word, path in bad_files(tmp_path).items():
        with pytest.raises(LadarregError) as caught:
            read_npz(path)
        assert isinstance(caught.value, FormatError | ShapeError)
        assert word in str(caught.value), f"{path.name}: {caught.value}"
        assert str(caught.value).startswith(f"{path.name}: ")


def npy_claiming(shape: tuple[int, ...], body: bytes) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + body


def test_claims_without_data_are_refused_before_allocation(tmp_path: Path) -> None:
    for shape in ((20_000, 10_000), (2**40, 2**22), (6, 8)):
        path = tmp_path / "claim.npz"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("intensity.npy", npy_claiming(shape, b"\0" * 100))
            archive.writestr("counts.npy", npy_claiming(shape, b"\0" * 100))
        with pytest.raises(FormatError, match=r"claims .* but 100 bytes are present"):
            read_npz(path)


def test_a_bomb_is_not_inflated(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("intensity.npy", "w") as stream,
    ):
        stream.write(npy_claiming((1000, 40_000), b""))
        for _ in range(257):
            stream.write(b"\0" * (1 << 20))
    assert path.stat().st_size < 1 << 21
    with pytest.raises(FormatError, match="claims 1000 x 40000 values"):
        read_npz(path)


def test_arrays_of_other_names_are_never_touched(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", **good_counts())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.npy", b"\x93NUMPY" + pickle.dumps(Explosive()))
    assert read_npz(path).valid.sum() == 47
