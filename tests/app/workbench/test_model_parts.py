"""The parts of the 3-D model that the page fetches."""

from __future__ import annotations

import gzip
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from ladarreg.workbench.state import model_parts
from ladarreg.workbench.state.model_parts import LEVELS, MAX_VERTICES
from PIL import Image, ImageOps

from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.palette import VISIBILITY
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, kept_bench, registered


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """The sample, registered."""
    found = kept_bench("registered", tmp_path_factory.mktemp("model") / "project", registered)
    yield found
    found.workbench.close()


def part(bench: WorkbenchDriver, name: str, **query: str) -> tuple[bytes, dict[str, str]]:
    picture = bench.workbench.picture(f"model/{name}", query)
    return picture.data, dict(picture.headers)


def vertices_of(packed: bytes) -> int:
    return int(np.frombuffer(gzip.decompress(packed), "<u4", 1, 4)[0])


def texture(bench: WorkbenchDriver, kind: str, **query: str) -> tuple[np.ndarray, dict[str, object]]:
    data, headers = part(bench, "texture", kind=kind, **query)
    image = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    return image, json.loads(unquote(headers["x-legend"]))


@pytest.mark.long
def test_a_second_photograph_does_not_wipe_the_first(tmp_path: Path) -> None:
    """The colours of all accepted photographs are shown, whichever is looked at, and whether that one is accepted."""
    bench = kept_bench("registered", tmp_path / "project", registered)
    alone, _ = texture(bench, "colour", photo="p1")
    folder = sample_folder()
    with Image.open(next(folder.glob("photo.*"))) as image:
        ImageOps.invert(image.convert("RGB")).save(tmp_path / "second.png")
    waiting = bench.workbench.take_upload(
        shutil.copy(tmp_path / "second.png", bench.workbench.upload_folder() / "u.png"), "second.png", "any", None, None
    )
    assert bench.do("open_files", files=[waiting])["opened"]
    bench.do("set_camera", photo="p2", focal_px=json.loads((folder / "camera.json").read_text())["fx"])
    bench.do("show_photo", photo="p2")
    model = bench.slice("model")
    assert not model["accepted"]
    assert next(choice for choice in model["choices"] if choice["value"] == "colour")["usable"]
    shown, _ = texture(bench, "colour", photo="p2")
    np.testing.assert_array_equal(shown, alone)
    before = model["rev"]
    bench.do("remove_photo", photo="p1")
    assert bench.slice("model")["rev"] != before
    assert not bench.slice("model")["choices"][0]["usable"]
    bench.workbench.close()


@pytest.mark.slow
def test_the_model_comes_coarse_first_and_small(bench: WorkbenchDriver) -> None:
    sizes = {}
    for detail in ("coarse", "standard", "dense"):
        mesh, _ = part(bench, "mesh", detail=detail)
        colors, _ = part(bench, "texture", detail=detail, kind="colour", photo="p1")
        sizes[detail] = len(mesh) + len(colors)
    assert sizes["coarse"] < sizes["standard"] < sizes["dense"]
    assert sizes["coarse"] < 450_000
    assert sizes["standard"] < 1_000_000


@pytest.mark.slow
def test_surface_and_photograph_together_stay_within_what_a_page_shows(
    bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    def layer_vertices() -> int:
        bench.workbench.loader._cache["model"].clear()
        return vertices_of(part(bench, "layer", detail="standard", photo="p1")[0])

    # The sample's photograph is hardly finer than its scan.
    monkeypatch.setattr("ladarreg_core.surface.texture.photo_layer.shows_more_detail", lambda *_, **__: True)
    standard = LEVELS["standard"].vertices
    assert vertices_of(part(bench, "mesh", detail="standard")[0]) <= standard
    freely = layer_vertices()
    assert freely <= MAX_VERTICES - standard
    left = freely // 2
    monkeypatch.setattr("ladarreg.workbench.state.model_parts.MAX_VERTICES", standard + left)
    assert 0 < layer_vertices() <= left, "the photograph is drawn on a coarser surface"


@pytest.mark.slow
def test_textures_have_legends_and_their_own_colors(bench: WorkbenchDriver) -> None:
    gray, legend = texture(bench, "intensity")
    assert np.ptp(gray.astype(int), axis=-1).max() <= 6
    assert legend["title"] == "Laser intensity"
    for detail in ("coarse", "dense"):
        classes, legend = texture(bench, "label", photo="p1", detail=detail)
        shown = {tuple(color) for color in classes.reshape(-1, 3).tolist()}
        assert shown <= set(VISIBILITY), "codes are not blurred"
        assert len(legend["entries"]) >= 3  # type: ignore[arg-type]
    with_z, _ = texture(bench, "colour", photo="p1")
    without, _ = texture(bench, "colour", photo="p1", z_buffer="0")
    assert np.abs(with_z.astype(int) - without).mean() > 0.5


@pytest.mark.slow
def test_all_photographs_are_fused_to_layers(bench: WorkbenchDriver) -> None:
    choices = {choice["value"]: choice for choice in bench.slice("model")["choices"]}
    assert choices["fused"]["usable"]
    assert not choices["temperature_k"]["usable"]
    assert "thermal" in choices["temperature_k"]["said"]
    colors, _ = texture(bench, "colour", photo="p1")
    fused, legend = texture(bench, "fused", photo="p1")
    assert legend["title"] == "Fused colour"
    _, legend = texture(bench, "seen_by", photo="p1")
    assert legend["most"] == "1"
    ids, legend = texture(bench, "photo_id", photo="p1")
    assert [entry["label"] for entry in legend["entries"]] == ["1: photo.png", "none"]  # type: ignore[attr-defined]
    codes = np.unique(ids.reshape(-1, 3), axis=0)
    assert len(codes) == 2, "codes are not blurred"
    used = (ids == ids[ids.shape[0] // 2, ids.shape[1] // 2]).all(axis=-1)
    assert 0.2 < used.mean() < 0.95
    off = np.abs(fused.astype(int) - colors).max(axis=-1)
    assert np.median(off[used]) <= 4, "one photograph alone keeps its colours"
    bench.do("set_model", texture="fused")
    assert bench.slice("model")["texture"] == "fused"
    with pytest.raises(LadarregError, match="thermal"):
        bench.workbench.picture("model/texture", {"kind": "temperature_k", "photo": "p1"})


def test_photographs_that_do_not_fit_in_memory_are_fused_reduced(
    bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, _ = texture(bench, "fused", photo="p1")
    monkeypatch.setattr(model_parts, "_MAX_PHOTO_BYTES", 150_000)
    reduced, _ = texture(bench, "fused", photo="p1")
    off = np.abs(whole.astype(int) - reduced)
    assert np.median(off) <= 4
    assert off.mean() < 12
    assert off.any(), "it was made again"


@pytest.mark.slow
def test_what_is_not_there_is_refused(bench: WorkbenchDriver) -> None:
    for name, query in (
        ("smell", {}),
        ("mesh", {"detail": "huge"}),
        ("texture", {"kind": "colour"}),
        ("texture", {"kind": "colour", "photo": "p9"}),
        ("texture", {"kind": "glitter"}),
    ):
        with pytest.raises(LadarregError):
            bench.workbench.picture(f"model/{name}", query)


def test_the_slice_changes_with_the_pose_and_for_one_person_only(bench: WorkbenchDriver) -> None:
    before = bench.slice("model")
    assert before["accepted"]
    assert not before["rays"]
    bench.do("set_model", texture="range", rays=True)
    after = bench.slice("model")
    assert (after["texture"], after["rays"], after["rev"]) == ("range", True, before["rev"])
    bench.do("undo")
    undone = bench.slice("model")
    assert undone["rev"] != before["rev"]
    assert not undone["accepted"]
    bench.do("redo")
    assert bench.slice("model")["rev"] == before["rev"], "the browser's copies are valid again"
    assert "must be 'start', 'overview'" in bench.refused("look", viewpoint="moon")
    bench.do("look", viewpoint="overview")


def test_an_empty_project_has_no_model(tmp_path: Path) -> None:
    from testing.workbench.workbench_driver import open_bench

    empty = open_bench(tmp_path / "project")
    try:
        with pytest.raises(LadarregError, match="no scan"):
            part(empty, "mesh")
    finally:
        empty.workbench.close()
