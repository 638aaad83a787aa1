"""`ladarreg model`: of photographs on one scan and on several, with values of sensors, and what it refuses."""

from __future__ import annotations

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pye57
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode
from scipy.spatial import cKDTree

from ladarreg_core.export.outputs.integrity import check_integrity
from ladarreg_core.formats import read_scan
from ladarreg_core.frames import Rigid
from ladarreg_core.storage.checksums import checksum_state
from testing.files.potree_reader import read_cloud
from testing.scenes.kept import kept_folder
from testing.scenes.photo_tour import photo_tour, scan_of_tour, write_tour
from tests.unit.export.e57_samples import libe57, raw_values

CELLS, SIZE = (120, 168), (200, 140)


def fill(folder: Path) -> None:
    """Six photographs on a scan, the last with a given pose, and an image of counts."""
    (folder / "one").mkdir(parents=True)
    tour = photo_tour(0, photos=6, cells=CELLS, size=SIZE)
    write_tour(folder / "one", tour, given=(5,))
    counts = np.zeros((SIZE[1] // 2, SIZE[0] // 2), np.uint16)
    counts[:, : SIZE[0] // 4] = 700
    cv2.imwrite(str(folder / "one" / "counts.tif"), counts)


@pytest.fixture(scope="module")
def job() -> Path:
    return kept_folder("model-job", fill)


@pytest.fixture(scope="module")
def model(job: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("model") / "out"
    results = [str(job / "one" / f"results-{k}") for k in range(6)]
    values = f"gamma:counts:IMG_0002:{job / 'one' / 'counts.tif'}"
    words = ["model", *results, "--values", values, "--to", "glb,laz,ply,e57,potree", "-o", str(out), "--quiet"]
    assert main(words) == ExitCode.ACCEPTED
    return out


def document(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "model.json").read_bytes())
    return found


def glb(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def array(found: dict[str, Any], content: bytes, accessor: int) -> np.ndarray:
    fields = found["accessors"][accessor]
    view = found["bufferViews"][fields["bufferView"]]
    kind = {5126: "<f4", 5125: "<u4"}[fields["componentType"]]
    data = content[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(data, kind).reshape(fields["count"], -1)


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["model", "--quiet", *words]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.slow
def test_the_document_says_what_colors_what(model: Path) -> None:
    found = document(model)
    assert checksum_state(found) == "intact"
    assert [one["id"] for one in found["photos"]] == [f"IMG_000{k}" for k in range(1, 6)]
    assert found["left_out"] == [{"name": "IMG_0006.png", "why": "given, not verified"}]
    assert sum(one["share"] for one in found["photos"]) == pytest.approx(found["colored"])
    assert found["colored"] > 0.9
    tour = photo_tour(0, photos=6, cells=CELLS, size=SIZE)
    expected = tour.gains[:5] / np.exp(np.log(tour.gains[:5]).mean(axis=0))
    np.testing.assert_allclose([one["gain"] for one in found["photos"]], expected, rtol=0.04)
    assert {one["name"] for one in found["layers"]} >= {
        "fused", "intensity", "seen_by", "sigma_px", "resolution_mm", "photo_id", "gamma_counts", "photo-IMG_0003",
    }  # fmt: skip
    assert all((model / name).is_file() for name in found["files"])
    assert check_integrity(model).damaged == ()


@pytest.mark.slow
def test_the_given_pose_is_in_no_file(model: Path) -> None:
    for path in model.rglob("*"):
        if path.is_file() and path.name != "model.json":
            assert "0006" not in path.name
            assert b"IMG_0006" not in path.read_bytes(), path.name


def test_clouds_have_the_layers_and_agree(model: Path, job: Path) -> None:
    cloud = laspy.read(model / "cloud.laz")
    scan = read_scan(job / "one" / "scan.npz")
    assert len(cloud.points) == int(scan.valid.sum())
    np.testing.assert_allclose(cloud.xyz, scan.points[scan.valid], atol=1e-4)
    names = {one.name for one in cloud.point_format.extra_dimensions}
    assert names == {"photo_id", "label", "sigma_px", "seen_by", "resolution_mm", "gamma_counts"}
    ids, gamma = np.asarray(cloud["photo_id"]), np.asarray(cloud["gamma_counts"])
    assert set(np.unique(ids)) <= set(range(6))
    known = gamma[np.isfinite(gamma)]
    assert (known.min(), known.max()) == (0, 700)
    assert ((known == 0) | (known == 700)).mean() > 0.9
    assert 0.3 < (known > 350).mean() < 0.7
    colored = ids > 0
    assert np.isfinite(np.asarray(cloud["resolution_mm"])[colored]).all()
    assert np.isnan(np.asarray(cloud["resolution_mm"])[~colored]).all()
    assert (np.asarray(cloud["seen_by"])[colored] > 0).mean() > 0.98
    shares = [one["share"] for one in document(model)["photos"]]
    np.testing.assert_allclose([(ids == k + 1).mean() for k in range(5)], shares, atol=1e-9)

    text = (model / "cloud.ply").read_bytes()
    header, _, body = text.partition(b"end_header\n")
    assert b"property ushort seen_by" in header
    types = {b"float": "<f4", b"uchar": "u1", b"ushort": "<u2"}
    fields = [line.split()[1:] for line in header.splitlines() if line.startswith(b"property")]
    points = np.frombuffer(body, [(name.decode(), types[kind]) for kind, name in fields])
    for name in ("photo_id", "seen_by", "label", "resolution_mm", "gamma_counts"):
        np.testing.assert_array_equal(points[name], np.asarray(cloud[name]), err_msg=name)
    np.testing.assert_array_equal(points["red"], np.asarray(cloud.red) // 257)

    octree = read_cloud(model / "potree" / "pointcloud")
    far, nearest = cKDTree(octree.points).query(np.asarray(cloud.xyz))
    assert far.max() < 2e-4
    found, expected = octree.records[nearest], cloud.points
    for name in ("photo_id", "seen_by", "label", "resolution_mm", "gamma_counts"):
        same = np.isclose(found[name], expected[name], equal_nan=True)
        assert same.mean() > 0.999, f"{name}, but for points at one place within .1 mm"
    listed = json.loads((model / "potree" / "photographs.json").read_bytes())["photographs"]
    assert [one["id"] for one in listed] == [f"IMG_000{k}" for k in range(1, 6)]


def test_the_layers_of_an_e57_are_read_by_another_reader_and_passed_over(model: Path, job: Path) -> None:
    cloud = laspy.read(model / "cloud.laz")
    file = libe57.ImageFile(str(model / "cloud.e57"), "r")
    try:
        (node,) = (file.root()["data3D"][k] for k in range(file.root()["data3D"].childCount()))
        values, said = raw_values(node["points"]), node["ladarreg:layers"]
        meanings = {said[k].elementName(): said[k].value() for k in range(said.childCount())}
        assert file.root()["images2D"].childCount() == 5
    finally:
        file.close()
    names = ["photo_id", "label", "sigma_px", "seen_by", "resolution_mm", "gamma_counts"]
    assert sorted(meanings) == sorted(f"ladarreg:{name}" for name in names)
    assert ", mm" in meanings["ladarreg:resolution_mm"]
    assert "counts" in meanings["ladarreg:gamma_counts"]
    for name in names:
        np.testing.assert_array_equal(values[f"ladarreg:{name}"], np.asarray(cloud[name]), err_msg=name)
    for name, plain in (("colorRed", cloud.red), ("colorGreen", cloud.green), ("colorBlue", cloud.blue)):
        colored = values["ladarreg:photo_id"] > 0
        np.testing.assert_array_equal(values[name][colored], np.asarray(plain)[colored] // 257)

    whole = pye57.E57(str(model / "cloud.e57"))
    points = whole.read_scan(0, ignore_missing_fields=True, intensity=True, colors=True)
    whole.close()
    scan = read_scan(job / "one" / "scan.npz")
    found = np.stack([points[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
    np.testing.assert_allclose(found, scan.points[scan.valid], atol=1e-4)
    again = read_scan(model / "cloud.e57")
    assert again.valid.sum() == scan.valid.sum()
    np.testing.assert_allclose(np.sort(again.ranges[again.valid]), np.sort(scan.ranges[scan.valid]), atol=1e-4)


def test_the_textured_model_has_the_layers_as_variants_on_the_grid(model: Path, job: Path) -> None:
    found, content = glb(model / "model.glb")
    variants = [one["name"] for one in found["extensions"]["KHR_materials_variants"]["variants"]]
    assert variants[0] == "Fused"
    assert "Gamma, counts" in variants
    assert "Photograph IMG_0003" in variants
    assert "KHR_materials_variants" in found["extensionsUsed"]
    scan = read_scan(job / "one" / "scan.npz")
    for primitive in found["meshes"][0]["primitives"]:
        mapped = primitive["extensions"]["KHR_materials_variants"]["mappings"]
        by_variant = {v: one["material"] for one in mapped for v in one["variants"]}
        assert sorted(by_variant) == list(range(len(variants)))
        assert by_variant[0] == primitive["material"]
        for variant, material in by_variant.items():
            texture = found["materials"][material]["pbrMetallicRoughness"]["baseColorTexture"]
            assert texture.get("texCoord", 0) == (variant > 0)
        # A texture of the grid lies where the vertices are on the grid.
        at, uv = (array(found, content, primitive["attributes"][name]) for name in ("POSITION", "TEXCOORD_1"))
        cells = scan.geometry.cell_of(at.astype(np.float64))
        expected = (cells[:, ::-1] + 0.5) / np.array(scan.shape[::-1])
        assert np.abs(uv - expected).max() * max(scan.shape) < 0.6, "cells"
    images = {one["name"]: one for one in found["images"]}
    view = found["bufferViews"][images["Gamma, counts"]["bufferView"]]
    png = np.frombuffer(content[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], np.uint8)
    drawn = cv2.imread(str(model / "layers" / "gamma_counts.png"))
    np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_COLOR), drawn[: scan.shape[0], : scan.shape[1]])


def check_tilesets(folder: Path, scans: list[np.ndarray]) -> None:
    """Follow the references of the whole tileset, and compare what a viewer draws with the scans in the world."""
    whole = json.loads((folder / "tileset.json").read_bytes())["root"]
    centre, *edges = np.array(whole["boundingVolume"]["box"]).reshape(4, 3)
    assert whole["refine"] == "ADD"
    assert len(whole["children"]) == len(scans)
    for child, points in zip(whole["children"], scans, strict=True):
        inner = json.loads((folder / child["content"]["uri"]).read_bytes())
        transform = np.array(inner["root"].get("transform", np.eye(4).ravel())).reshape(4, 4).T
        found, _ = glb((folder / child["content"]["uri"]).parent / inner["root"]["content"]["uri"])
        bounds = [
            found["accessors"][primitive["attributes"]["POSITION"]] for primitive in found["meshes"][0]["primitives"]
        ]
        # glTF is Y up; the node turns it, viewers turn it back: its own axes are those of the tile
        low, high = (fold([one[name] for one in bounds], axis=0) for name, fold in (("min", np.min), ("max", np.max)))
        corners = (
            np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ transform[:3, :3].T
            + transform[:3, 3]
        )
        here = points[np.isfinite(points).all(axis=-1)]
        assert (corners.min(axis=0) > here.min(axis=0) - 0.05).all(), "nothing beyond what that scan saw"
        assert (corners.max(axis=0) < here.max(axis=0) + 0.05).all()
        assert (corners.max(axis=0) - corners.min(axis=0) > 0.5).all()
        own, *halves = np.array(child["boundingVolume"]["box"]).reshape(4, 3)
        reach = np.abs(halves).sum(axis=0) + 1e-3
        assert (np.abs(corners - own) < reach).all(), "inside its box"
        assert (np.abs(own - centre) + np.abs(halves).sum(axis=0) < np.abs(edges).sum(axis=0) + 1e-6).all()


@pytest.mark.slow
def test_parts_of_several_scans_meet_without_doubled_walls(tmp_path: Path) -> None:
    tour = photo_tour(0, photos=6, cells=CELLS, size=SIZE)
    where = (0.6, 0.8, 0.1)
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    write_tour(tmp_path / "one", replace(tour, views=tour.views[:4]))
    other, _ = scan_of_tour(0, cells=CELLS, at_m=where)
    views = tuple(
        replace(view, camera_from_scanner=view.camera_from_scanner @ Rigid(np.eye(3), np.array(where)))
        for view in tour.views
    )
    write_tour(tmp_path / "two", replace(tour, scan=other, views=views), name="other", first=4)
    results = [str(one) for one in sorted(tmp_path.glob("*/results-*"))]
    out = tmp_path / "out"
    words = ["model", *results, "--to", "glb,laz,ply,e57,potree,tiles", "-o", str(out), "--quiet"]
    assert main(words) == ExitCode.ACCEPTED
    found = document(out)
    assert found["frame"]["frame"] == "world"
    seen = {"scan": read_scan(tmp_path / "one" / "scan.npz").points, "other": other.points + np.array(where)}
    check_tilesets(out / "tiles", [seen[one["name"]] for one in found["scans"]])
    file = libe57.ImageFile(str(out / "cloud.e57"), "r")
    counts = [file.root()[name].childCount() for name in ("data3D", "images2D")]
    records = [file.root()["data3D"][k]["points"].childCount() for k in range(counts[0])]
    file.close()
    assert counts == [2, 6], "each photograph is there once, though both scans see it"
    assert records == [one["returns"] - one["cut"] for one in found["scans"]]
    assert len(found["photos"]) == 6
    cut = [one["cut"] / one["returns"] for one in found["scans"]]
    assert 0.2 < sum(cut) < 1.2
    cloud = laspy.read(out / "cloud.laz")
    total = sum(one["returns"] - one["cut"] for one in found["scans"])
    assert len(cloud.points) == total
    assert len(read_cloud(out / "potree" / "pointcloud").points) == total
    # Of the wall behind all, at x = 4.5 m, hardly a place has points of both scans.
    wall = cloud.xyz[np.abs(cloud.x - 4.5) < 0.03]
    scan = read_scan(tmp_path / "one" / "scan.npz")
    both = np.concatenate([scan.points[scan.valid], other.points[other.valid] + np.array(where)])
    before = both[np.abs(both[:, 0] - 4.5) < 0.03]
    shared = np.abs(wall[:, 1]) < 1.0
    assert len(wall[shared]) < 0.7 * (np.abs(before[:, 1]) < 1.0).sum()

    def filled(points: np.ndarray) -> set[tuple[int, int]]:
        return {tuple(one) for one in np.floor(points[:, 1:] / 0.08).astype(int)}  # type: ignore[misc]

    assert len(filled(wall)) > 0.98 * len(filled(before)), "no gaps"
    names = {path.parent.name for path in (out / "layers").glob("*/fused.png")}
    assert names == {"scan", "other"}
    mesh, _ = glb(out / "model.glb")
    assert len({one["name"] for one in mesh["materials"]}) >= 8


def test_a_photograph_of_values_colors_nothing(tmp_path: Path) -> None:
    tour = photo_tour(0, photos=6, cells=CELLS, size=SIZE)
    rows = np.broadcast_to(np.arange(SIZE[1], dtype=np.uint8)[:, None], SIZE[::-1])
    counts = replace(tour.views[1].photo, pixels=np.repeat(rows[..., None], 3, axis=-1))
    views = (tour.views[0], replace(tour.views[1], photo=counts))
    results = [str(one) for one in write_tour(tmp_path, replace(tour, views=views))]
    out = tmp_path / "out"
    words = ["model", *results, "--values", "dose:uSv/h:IMG_0002", "--to", "ply", "-o", str(out), "--quiet"]
    assert main(words) == ExitCode.ACCEPTED
    found = document(out)
    assert [one["colors"] for one in found["photos"]] == [True, False]
    assert found["photos"][1]["share"] == 0
    (layer,) = (one for one in found["layers"] if one["name"] == "dose")
    assert (layer["title"], layer["unit"]) == ("Dose, uSv/h", "uSv/h")
    assert layer["legend"]["most"].endswith("uSv/h")
    assert b"property float dose" in (out / "cloud.ply").read_bytes()[:3000]


def test_a_model_is_replaced_only_by_force_and_only_if_unchanged(model: Path, job: Path, tmp_path: Path) -> None:
    out = shutil.copytree(model, tmp_path / "out")
    words = ["model", str(job / "one" / "results-0"), "--to", "ply", "-o", str(out), "--quiet"]
    assert main(words) == ExitCode.BAD_INPUT
    assert main([*words, "--force"]) == ExitCode.ACCEPTED
    assert not (out / "model.glb").exists()
    (out / "mine.txt").write_text("kept")
    assert main([*words, "--force"]) == ExitCode.BAD_INPUT
    assert (out / "mine.txt").read_text() == "kept"


def test_what_is_refused_is_said_in_one_line(job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, out = str(job / "one" / "results-0"), str(tmp_path / "out")
    given = str(job / "one" / "results-5")
    assert "no photo was accepted" in complaint(capsys, given, "-o", out)
    assert "IMG_0006.png: given, not verified" in complaint(capsys, given, "-o", out)
    assert "'stl' is no format of a model" in complaint(capsys, one, "--to", "stl", "-o", out)
    assert "has no registration.json" in complaint(capsys, str(job), "-o", out)
    assert "is not a folder" in complaint(capsys, str(job / "nothing"), "-o", out)
    for values, words in (
        ("gamma", "is not NAME:UNIT:PHOTO"), ("a b:K:IMG_0001", "the quantity is called 'a b'"),
        ("Größe:K:IMG_0001", "the quantity is called 'Größe'"),
        ("gamma:counts:IMG_9", "there is no photo 'IMG_9'"), ("g:c:IMG_0001:no.tif", "no.tif: file not found"),
        (f"g:c:IMG_0001:{job / 'one' / 'scan.npz'}", "scan.npz"), ("dose:uSv/h:IMG_0001", "it has colours"),
    ):  # fmt: skip
        assert words in complaint(capsys, one, "--values", values, "-o", out), values
    assert not Path(out).exists()


def test_dark_corners_are_stated_where_they_were_asked_for(
    job: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = [str(job / "one" / f"results-{k}") for k in range(6)]
    assert main(["model", *results, "--vignetting", "--to", "ply", "-o", str(tmp_path / "out")]) == ExitCode.ACCEPTED
    photos = document(tmp_path / "out")["photos"]
    assert all(abs(sum(one["vignetting"])) < 0.05 for one in photos if one["colors"])  # these lenses darken nothing
    assert capsys.readouterr().out.count(", corners at ") == sum(one["colors"] for one in photos)
    assert all(one["vignetting"] is None for one in document(model)["photos"])
