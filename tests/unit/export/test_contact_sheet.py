"""The contact sheet: its content, that nothing is clipped or overstated, for any size of scan and photo."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import ShapeError
from ladarreg_core.export.comparison.contact_sheet import SHEET_WIDTH, contact_sheet, write_contact_sheet
from ladarreg_core.export.pictures.detail import detail_window, edge_lines, seen_window, whole_window
from ladarreg_core.export.pictures.layout import legible, shortened, text_block, text_width, wrapped
from ladarreg_core.export.pictures.match_panels import best_enlargement, match_panel
from ladarreg_core.foundations import palette
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.registration.comparison import Comparison
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.registered_texture import Label, RegisteredTexture, texture_scan
from testing.scenes.small_registration import POSE
from tests.unit.export.comparisons import STAGES, comparison_of, stage_result

# --- text ------------------------------------------------------------------------------------------------------------

WORDS = st.text(st.characters(exclude_categories=("C",)), max_size=80)


@given(WORDS, st.integers(40, 400), st.integers(1, 4))
def test_text_never_leaves_its_field(text: str, width: int, lines: int) -> None:
    rows = wrapped(text, size=19, width=width, lines=lines)
    assert len(rows) <= lines
    assert all(text_width(row, size=19) <= width for row in rows)
    whole = legible(text)
    if text_width(whole, size=19) <= width:
        assert rows == [whole] * bool(whole)
    kept = "".join(rows).replace(" ", "")
    assert kept == whole.replace(" ", "") or "…" in kept


@given(WORDS)
def test_every_letter_is_one_that_the_font_has(text: str) -> None:
    shown = legible(text)
    assert re.fullmatch(r"[ -~°·±…]*", shown)
    assert legible(shown) == shown


def test_foreign_letters_stay_readable() -> None:
    assert legible("Größe 5 × 3 – naïve\nscan\t日") == "Grosse 5 x 3 - naive scan ?"
    assert shortened("a word too long", size=19, width=80).endswith("…")


def test_the_ink_of_a_text_stays_inside_its_block() -> None:
    for text in ("jgÅy|Q_", "f"):
        for align in ("left", "centre", "right"):
            block = text_block(text, size=40, width=400, align=align, weight=0.8)
            inked = (block != palette.BACKGROUND).any(axis=-1)
            assert inked.any()
            assert not inked[0].any()
            assert not inked[-1].any()


# --- the sheet -------------------------------------------------------------------------------------------------------


def flat_case(rows: int, columns: int, step_deg: tuple[float, float], size: tuple[int, int]) -> tuple[Scan, Photo]:
    """Return a wall with a block in front of it, and a photo of noise."""
    geometry = AzimuthElevation(rows, columns, *np.deg2rad(step_deg))
    ranges = 4.0 / geometry.rays[..., 0]
    ranges[rows // 3 : rows // 2, columns // 3 : columns // 2] *= 0.7
    rng = np.random.default_rng(0)
    scan = Scan(geometry, ranges, rng.random(geometry.shape))
    camera = Camera.from_focal(*size, 0.8 * max(size))
    return scan, Photo(rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8), camera)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "stages", "no_pose"),
    [
        ((30, 44, (2, 2), (120, 90)), STAGES, ()),
        ((30, 44, (2, 2), (120, 90)), STAGES, STAGES),
        ((40, 300, (0.5, 0.5), (90, 70)), STAGES, ("linear", "default")),
        ((400, 20, (0.2, 0.3), (60, 200)), STAGES, ("simplex",)),
        ((20, 160, (0.5, 4), (300, 100)), STAGES, ("simplex",)),
        ((3, 4, (9, 9), (50, 2)), STAGES, ()),
        ((30, 44, (2, 2), (4000, 3000)), ("default",), ()),
        ((30, 44, (2, 2), (50, 50)), ("linear", "simplex"), ("linear",)),
    ],
    ids=["plain", "no pose at all", "wide", "tall", "cells not square", "tiny", "large photo", "no default"],
)
def test_any_case_fits_the_sheet(case, stages, no_pose) -> None:
    scan, photo = flat_case(*case)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.05, -0.3, 0.02))
    comparison = comparison_of(
        scan, photo, pose, stages=stages, no_pose=no_pose, cautions=("Too little baseline. " * 30, "x" * 900)
    )
    sheet = contact_sheet(comparison, scan, photo)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1:] == (SHEET_WIDTH, 3)
    assert 600 < sheet.shape[0] < 4000
    for margin in (sheet[:, :40], sheet[:, -40:], sheet[:30], sheet[-30:]):
        assert (margin == palette.BACKGROUND).all(), "something runs out of the sheet"


def hostile(comparison: Comparison) -> Comparison:
    """Return the comparison with extreme results and file names."""
    first, second, *rest = comparison.columns
    result = first.stage.result
    count = len(result.matches)
    wild = replace(
        result,
        residuals_px=np.full((count, 2), np.nan),
        stereo_depth_error_m=np.full(count, np.inf),
        camera_from_scanner=Rigid.from_centre(-CAMERA_AXES_FROM_SCANNER @ np.diag([-1, 1, 1.0]), (1e7, -1e7, 0)),
        matches=Matches(result.matches.rays, result.matches.ranges, np.resize([np.nan, 1e12, -1e300], (count, 2))),
        reasons=("Unreadable 日本語 | <b>" * 20, "a\nb"),
    )
    none = second.stage.result
    empty = replace(
        none,
        matches=none.matches.subset([]),
        inliers=np.zeros(0, bool),
        residuals_px=np.zeros((0, 2)),
        residuals_m=np.zeros(0),
        stereo_depth_error_m=np.zeros(0),
    )
    return replace(
        comparison,
        columns=(
            replace(first, stage=replace(first.stage, result=wild, note="n" * 500), seconds=1e9),
            replace(second, stage=replace(second.stage, result=empty), texture=None),
            *rest,
        ),
    )


@pytest.mark.slow
def test_extreme_results_are_drawn(scan, photo) -> None:
    comparison = hostile(comparison_of(scan, photo, POSE))
    sheet = contact_sheet(comparison, scan, photo)
    np.testing.assert_array_equal(sheet, contact_sheet(comparison, scan, photo))


@pytest.mark.slow
def test_accepted_and_not_accepted_differ_in_color(scan, photo) -> None:
    sheets = [
        contact_sheet(comparison_of(scan, photo, POSE, stages=("simplex", "default"), accepted=names), scan, photo)
        for names in ((), ("default",), ("simplex", "default"))
    ]
    accepted, refused = (
        [int((sheet == color).all(axis=-1).sum()) for sheet in sheets]
        for color in (palette.OK_GROUND, palette.WARN_GROUND)
    )
    assert accepted[0] < 50
    assert accepted[1] > 1000
    assert accepted[2] == pytest.approx(2 * accepted[1], rel=0.05)
    assert refused[0] > refused[1] + 1000
    assert refused[1] > refused[2] + 1000
    assert refused[2] < 50


def test_an_empty_comparison_is_refused(scan, photo, tmp_path) -> None:
    with pytest.raises(ShapeError, match="no columns"):
        contact_sheet(Comparison(columns=()), scan, photo)
    other = comparison_of(scan, photo, POSE, stages=("default",))
    small = RegisteredTexture(np.zeros((3, 3, 3), np.uint8), np.ones((3, 3), np.uint8))
    with pytest.raises(ShapeError, match="agree"):
        contact_sheet(replace(other, columns=(replace(other.columns[0], texture=small),)), scan, photo)
    write_contact_sheet(tmp_path / "sheet.png", other, scan, photo)
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")


# --- the detail ------------------------------------------------------------------------------------------------------


def test_the_detail_shows_the_depth_edge_that_is_seen() -> None:
    geometry = AzimuthElevation(150, 200, 0.005, 0.005)
    ranges = 4.0 / geometry.rays[..., 0]
    ranges[60:90, 100:] *= 0.6  # the edge that can be judged
    ranges[110:140, :60] *= 0.6  # another, which the photograph does not colour
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    image = np.full((150, 200, 3), 90, np.uint8)
    image[60:90, 100:] = 220
    image[110:140, :60] = 220
    labels = np.full((150, 200), Label.SEEN, np.uint8)
    labels[105:] = Label.OUT_OF_FRAME
    texture = RegisteredTexture(image, labels)
    window = detail_window(scan, texture, [texture])
    assert window is not None
    rows, columns = window.cells
    inside = np.zeros(scan.shape, bool)
    inside[rows, columns] = True
    edge = np.zeros(scan.shape, bool)
    edge[59:61, 100:] = edge[89:91, 100:] = True
    edge[60:90, 99:101] = True
    assert (inside & edge).sum() > 0.5 * max(window.height, window.width)
    assert (labels[rows, columns] == Label.SEEN).mean() > 0.85
    unseen = RegisteredTexture(image, np.full((150, 200), Label.OCCLUDED, np.uint8))
    assert detail_window(scan, unseen, [unseen]) is None


@given(st.integers(0, 2**31), st.floats(0, 1))
def test_windows_contain_the_colored_cells_and_stay_on_the_grid(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(2, 60, 2).tolist())
    geometry = AzimuthElevation(*shape, 0.01, 0.01)
    scan = Scan(geometry, 4 + rng.random(shape), rng.random(shape))
    labels = np.full(shape, Label.OCCLUDED, np.uint8)
    top, left = rng.integers(0, shape[0]), rng.integers(0, shape[1])
    labels[top : top + 9, left : left + 9] = np.where(
        rng.random(labels[top : top + 9, left : left + 9].shape) < share, 1, 2
    )
    texture = RegisteredTexture(rng.integers(0, 256, (*shape, 3)).astype(np.uint8), labels)
    around = seen_window(scan, [texture])
    assert texture.colored[around.cells].sum() == texture.colored.sum()
    window = detail_window(scan, texture, [texture])
    assert (window is None) == (not texture.colored.any())
    for w in filter(None, (around, window)):
        assert scan.ranges[w.cells].shape == (w.height, w.width)
        assert min(w.height, w.width) >= 2


@pytest.mark.parametrize("enlarged", [1, 4, 15])
def test_an_edge_of_the_scan_is_a_thin_line_in_its_place(enlarged: int) -> None:
    geometry = AzimuthElevation(40, 60, 0.01, 0.01)
    intensity = np.random.default_rng(0).normal(100, 2, (40, 60))
    intensity[:, 35:] += 100
    scan = Scan(geometry, np.full((40, 60), 3.0), intensity)
    lines = edge_lines(scan, whole_window(scan), (60 * enlarged, 40 * enlarged))
    at = np.nonzero(lines)[1] / enlarged
    assert lines.any(axis=1).mean() > 0.9
    assert np.abs(at + 0.5 / enlarged - 35).max() < 1.5
    assert lines.sum(axis=1).max() <= 3
    plain = Scan(geometry, np.full((40, 60), 3.0), np.full((40, 60), 7.0))
    assert not edge_lines(plain, whole_window(plain), (120, 80)).any()


# --- the matches -----------------------------------------------------------------------------------------------------


def test_a_match_is_a_dot_with_a_line_to_where_the_pose_puts_it(scan, photo) -> None:
    result = comparison_of(scan, photo, POSE, stages=("default",)).columns[0].stage.result
    uv = np.array([[20.0, 20.0], [80.0, 40.0], [20.0, 70.0]])
    result = replace(
        result,
        matches=Matches(np.eye(3), np.ones(3), uv),
        inliers=np.array([True, False, True]),
        residuals_px=np.array([[-1.0, 0.0], [0.0, 0.0], [np.nan, np.nan]]),
    )
    panel = match_panel(photo, result, (480, 360), enlargement=5).astype(int)

    def color(u: float, v: float) -> tuple[int, ...]:
        return tuple(panel[round((v + 0.5) * 4 - 0.5), round((u + 0.5) * 4 - 0.5)])

    assert [color(*at) for at in uv] == [palette.OK, palette.BAD, palette.OK]
    assert color(24.0, 20.0) == palette.OK  # observed minus predicted is -1 px, five times as long
    assert color(16.0, 20.0) != palette.OK
    bare = match_panel(photo, None, (480, 360))
    assert not (bare == palette.OK).all(axis=-1).any()


@cache
def result_on_400_px() -> PoseResult:
    photo = Photo(np.zeros((300, 400, 3), np.uint8), Camera.from_focal(400, 300, 300.0))
    scan = flat_case(20, 20, (2, 2), (50, 50))[0]
    pose = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))
    return stage_result(scan, photo, pose, off=0.0, accepted=True)


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=4))
def test_the_enlargement_makes_the_typical_residual_show(lengths: list[float]) -> None:
    result = result_on_400_px()
    results = [replace(result, residuals_px=np.full_like(result.residuals_px, n / np.sqrt(2))) for n in lengths]
    times = best_enlargement([*results, None], 400)
    typical = np.exp(np.mean(np.log(lengths)))
    assert times == 1 or times * typical <= 14.1
    assert times == 50 or times * typical > 14 / 2.6 or typical > 14
    assert best_enlargement([None], 400) >= 1


def test_a_texture_made_by_the_default_is_what_the_tile_shows(scan, photo) -> None:
    """Two sheets differ where their textures do: the tile is the column's own texture."""
    one = comparison_of(scan, photo, POSE, stages=("linear", "default"))
    column = one.columns[0]
    black = texture_scan(scan, Photo(np.zeros_like(photo.pixels), photo.camera), POSE)
    other = replace(one, columns=(replace(column, texture=black), one.columns[1]))
    apart = (contact_sheet(one, scan, photo) != contact_sheet(other, scan, photo)).any(axis=(0, 2))
    assert apart[: SHEET_WIDTH // 3].any()
    assert not apart[SHEET_WIDTH // 3 :].any()
