"""Which blocks of the surface the 3-D view asks for, and what of the whole surface they replace."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.page.two_panes import run

if TYPE_CHECKING:
    from playwright.sync_api import Page

SHAPE = [4000, 7000]


def blocks(
    page: Page, cells: Any, shape: Any = SHAPE, *, vertices: int = 60_000, turns: bool = True
) -> list[list[int]]:
    found = run(
        page, "panels/model/model_view", "return m.blocksAt(...a)", [np.asarray(cells).tolist(), shape, vertices, turns]
    )
    return [[int(number) for number in name.split(".")] for name in found]


def test_the_finest_blocks_that_show_all_in_view_are_chosen(blank: Page) -> None:
    rng = np.random.default_rng(3)
    for _ in range(60):
        size = rng.uniform(20, 1500, 2)
        corner = rng.uniform(0, np.array(SHAPE) - size * [1, 0])
        cells = np.floor(corner + size * rng.uniform(size=(25, 2))).astype(int)
        cells[:, 1] %= SHAPE[1]  # also across the seam
        found = blocks(blank, cells)
        assert 1 <= len(found) <= 4
        (level,) = {each[0] for each in found}
        count = 2**level
        inside = [[r, c] in [each[1:] for each in found] for r, c in (cells * count // np.array(SHAPE)).tolist()]
        assert np.mean(inside) == 1 or level <= 2, (level, found)
        assert level >= 3 or size.max() > 400


def test_where_the_whole_surface_is_fine_enough_there_are_none(blank: Page) -> None:
    cells = [[500, 500], [510, 520], [505, 490]]
    assert blocks(blank, cells, [1000, 1000], vertices=900_000) == []
    assert blocks(blank, cells[:2]) == []  # too little is in view
    assert blocks(blank, []) == []
    assert len(blocks(blank, cells, [1000, 1000], turns=False)) in (1, 2, 4)


def test_a_scan_that_does_not_turn_has_no_blocks_beyond_its_border(blank: Page) -> None:
    cells = [[0, 0], [3, 2], [1, 5]]
    for level, row, column in blocks(blank, cells, turns=False):
        assert 0 <= row < 2**level
        assert 0 <= column < 2**level


@pytest.mark.parametrize("names", [[], ["2.1.2"], ["3.2.3", "3.2.4", "3.3.3", "3.3.4"]])
def test_blocks_replace_the_faces_within_them_and_those_across_their_borders_stay(
    blank: Page, names: list[str]
) -> None:
    rows, columns = 41, 83
    r, c = np.divmod(np.arange(rows * columns), columns)
    corner = np.arange(rows * columns).reshape(rows, columns)[:-1, :-1].reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, columns, 1], corner[:, None] + [1, columns, columns + 1]])
    body = """const arrays = { faces: new Uint32Array(a.faces), rows: new Int32Array(a.rows),
        columns: new Int32Array(a.columns), shape: a.shape };
        return [...m.facesBeside(arrays, a.names)]"""
    given = {
        "faces": faces.reshape(-1).tolist(),
        "rows": r.tolist(),
        "columns": c.tolist(),
        "shape": [rows, columns],
        "names": names,
    }
    kept = np.array(run(blank, "panels/model/model_view", body, given)).reshape(-1, 3)
    owner = np.full(rows * columns, -1)
    for number, name in enumerate(names):
        level, row, column = map(int, name.split("."))
        n = 2**level
        inside = (
            (r >= row * rows // n)
            & (r < (row + 1) * rows // n)
            & (c >= column * columns // n)
            & (c < (column + 1) * columns // n)
        )
        owner[inside] = number
    of = owner[faces]
    replaced = (of[:, 0] >= 0) & (of[:, 0] == of[:, 1]) & (of[:, 1] == of[:, 2])
    np.testing.assert_array_equal(kept, faces[~replaced])
    assert bool(names) == replaced.any()


UNDER = """const surfaces = [{ positions: new Float32Array(a.positions), faces: new Uint32Array(a.faces) }];
return m.placeUnder(surfaces, a.look, a.ndc, a.step)"""


def test_a_click_is_worth_what_is_beside_it(blank: Page) -> None:
    # a wall 4 m before the scanner, seen from the side by a camera at (2, 0, 1) that looks along z as the scanner does
    positions = [-3, -3, 4, 3, -3, 4, 3, 3, 4, -3, 3, 4]
    world = np.eye(4)
    world[:3, 3] = [2, 0, 1]
    reach = 0.5  # of the picture, at distance 1
    unproject = np.array([[reach, 0, 0, 0], [0, reach, 0, 0], [0, 0, 0, 1], [0, 0, -0.9, 1.1]], float)
    look = {
        "world": world.T.reshape(-1).tolist(),
        "projectionInverse": unproject.T.reshape(-1).tolist(),
        "meshInverse": np.eye(4).reshape(-1).tolist(),
    }

    def under(ndc: list[float], step: float) -> Any:
        given = {"positions": positions, "faces": [0, 1, 2, 0, 2, 3], "look": look, "ndc": ndc, "step": [step, step]}
        return run(blank, "panels/model/model_view", UNDER, given)

    found = under([0.2, -0.4], 0.01)
    np.testing.assert_allclose(found["place"], [2 + 3 * 0.2 * reach, -3 * 0.4 * reach, 4], atol=1e-5)
    at = np.array(found["place"])
    beside = [at + np.array([sign * 3 * 0.01 * reach, 0, 0]) for sign in (-1, 1)]
    beside += [at + np.array([0, sign * 3 * 0.01 * reach, 0]) for sign in (-1, 1)]
    angles = [np.arccos(at @ one / np.linalg.norm(at) / np.linalg.norm(one)) for one in beside]
    assert found["sigma"] == pytest.approx(max(angles), rel=1e-3)
    assert under([0.2, -0.4], 0.04)["sigma"] == pytest.approx(4 * found["sigma"], rel=0.02)
    assert under([0.9, 0.0], 0.01) is None
