import numpy as np
import pytest

from ladarreg_core.surface import remap


@pytest.mark.parametrize("outside", [None, (9.0, 8.0, 7.0)])
@pytest.mark.parametrize(("picture_shape", "places"), [((7, 40_000), (50, 60)), ((300, 200), (33_000, 2)),
                                                       ((7, 33_000), (33_000, 1))])  # fmt: skip
def test_large_pictures_and_many_places_give_what_small_ones_do(picture_shape, places, outside):
    rng = np.random.default_rng(0)
    picture = rng.random((*picture_shape, 3)).astype(np.float32)
    u = rng.uniform(-5, picture_shape[1] + 5, places).astype(np.float32).round()
    v = rng.uniform(-5, picture_shape[0] + 5, places).astype(np.float32).round()
    found = remap.look_up(picture, u, v, outside=outside)
    column, row = u.astype(int), v.astype(int)
    inside = (column >= 0) & (column < picture_shape[1]) & (row >= 0) & (row < picture_shape[0])
    expected = picture[np.clip(row, 0, picture_shape[0] - 1), np.clip(column, 0, picture_shape[1] - 1)]
    if outside is not None:
        expected[~inside] = outside
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert 0.3 < inside.mean() < 1
