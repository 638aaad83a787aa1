"""The tree of tiles, on triangles at random: what tests of whole exports do not reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.surface.mesh.model_part import ModelPart, model_part
from ladarreg_core.surface.mesh.model_tree import ModelTree


def soup(seed: int, count: int, *, spread_m: float, size_m: float) -> ModelPart:
    """Return separate triangles around the scanner, each with its own place in a picture."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-spread_m, spread_m, (count, 1, 3))
    vertices = (centre + rng.uniform(-size_m, size_m, (count, 3, 3))).reshape(-1, 3).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(vertices), 1))
    pixels = rng.uniform(0, 299, (len(vertices), 2))
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    picture = np.zeros((300, 300, 3), np.uint8)
    return model_part(vertices, normals, pixels, faces, picture=picture, photo=0)


def sheet(cells: int) -> ModelPart:
    """Return a connected, slightly wavy square of two triangles a cell."""
    v, u = np.mgrid[: cells + 1, : cells + 1]
    points = np.stack([u, v, np.sin(u / 7.0) * np.cos(v / 5.0)], axis=-1).reshape(-1, 3).astype(np.float32) * 0.1
    first = (v * (cells + 1) + u)[:-1, :-1].reshape(-1, 1)
    faces = np.concatenate([first + np.array(k) for k in ((0, 1, cells + 2), (0, cells + 2, cells + 1))]).astype(
        np.int32
    )
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    picture = np.zeros((cells + 1, cells + 1, 3), np.uint8)
    return model_part(points, normals, pixels, faces, picture=picture, photo=None)


@pytest.mark.parametrize(
    "parts",
    [
        [soup(1, 1, spread_m=3, size_m=1)],
        [soup(1, 900, spread_m=20, size_m=0.1), soup(2, 300, spread_m=1, size_m=0.01)],
        [soup(3, 200, spread_m=0, size_m=0.0)],
        [soup(4, 150, spread_m=0.1, size_m=9)],
        [sheet(60), soup(5, 50, spread_m=5, size_m=0.001)],
    ],
    ids=["one triangle", "two parts", "one point", "large triangles", "connected and specks"],
)
def test_tiles_partition_the_triangles_and_keep_within_their_boxes(parts: list[ModelPart]) -> None:
    tree = ModelTree(parts, leaf_faces=40)
    count = sum(len(part.faces) for part in parts)
    vertices = np.concatenate([part.vertices for part in parts])
    drawn = 0
    for tile in tree.root.tiles:
        content = tree.content(tile)
        assert content
        points = np.concatenate([each.part.vertices for each in content])
        assert (points >= tile.low).all()
        assert (points <= tile.high).all()
        assert (vertices == points[0]).all(axis=1).any()
        assert bool(tile.children) == (tile.error_m > 0)
        if tile.children:
            together = np.sort(np.concatenate([child.rows for child in tile.children]))
            np.testing.assert_array_equal(together, tile.rows)
            for child in tile.children:
                assert child.error_m <= tile.error_m / 2
                assert (child.low >= tile.low).all()
                assert (child.high <= tile.high).all()
        else:
            drawn += sum(len(each.part.faces) for each in content)
    assert drawn == count


@pytest.mark.slow
def test_a_coarse_level_of_a_connected_surface_has_no_cracks_between_tiles() -> None:
    cells = 700
    above = soup(1, 1, spread_m=1, size_m=1)  # so that the sheet is in the lower half of the cube
    above = replace(above, vertices=above.vertices + np.float32([0, 0, 20]))
    tree = ModelTree([sheet(cells), above], leaf_faces=20_000)
    tiles = [tile for tile in tree.root.tiles if tile.depth == 1 and len(tile.rows) > 1]
    assert len(tiles) == 4
    assert all(tile.children for tile in tiles)

    def borders(chosen: list[int]) -> np.ndarray:
        """Return the edges (E, 2, 3) that only one triangle of the chosen tiles has."""
        parts = [each.part for k in chosen for each in tree.content(tiles[k])]
        corners = np.concatenate([part.vertices[part.faces] for part in parts])
        edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        first = np.argmax(edges[:, 0] != edges[:, 1], axis=1)
        at = np.arange(len(edges))
        backward = edges[at, 0, first] > edges[at, 1, first]
        edges[backward] = edges[backward][:, ::-1]
        unique, count = np.unique(edges.reshape(-1, 6), axis=0, return_counts=True)
        return unique[count == 1].reshape(-1, 2, 3)

    half, step = cells * 0.1 / 2, tiles[0].error_m

    def inner(edges: np.ndarray) -> int:
        """Return how many edges lie in the middle of the sheet."""
        return int((np.abs(edges[..., :2] - half).max(axis=(1, 2)) < half - 3 * step).sum())

    assert inner(borders([0, 1, 2, 3])) == 0
    assert inner(borders([0, 1, 2])) > 50  # control: a tile is missing
