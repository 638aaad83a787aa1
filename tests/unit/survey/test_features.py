"""Features, their matches, the ties that follow, and which of them are used."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.survey.ties.features import Features, detect, matches_between, propose_pairs
from ladarreg_core.survey.ties.ties import spread, thinned, tracks


def _picture(seed: int, side: int = 420) -> NDArray[np.uint8]:
    """Return a picture of rectangles of all sizes, as of posters and boxes."""
    rng = np.random.default_rng(seed)
    picture = np.full((side, side, 3), 128, np.uint8)
    for _ in range(220):
        x, y = rng.integers(0, side, 2)
        w, h = rng.integers(4, 60, 2)
        cv2.rectangle(picture, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 255, 3).tolist(), -1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), np.uint8)


def test_matches_of_a_turned_and_enlarged_picture_lie_where_they_must() -> None:
    picture = _picture(1)
    by = np.array([[1.3 * np.cos(0.3), -1.3 * np.sin(0.3), 40.0], [1.3 * np.sin(0.3), 1.3 * np.cos(0.3), -60.0]])
    other = np.asarray(cv2.warpAffine(picture, by, (520, 520), flags=cv2.INTER_CUBIC), np.uint8)
    first, second = detect(picture), detect(other)
    found = matches_between(first, second)
    assert len(found) > 60
    off = first.uv[found[:, 0]] @ by[:, :2].T + by[:, 2] - second.uv[found[:, 1]]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.4
    assert (np.linalg.norm(off, axis=1) < 2.5).mean() > 0.97


def test_different_pictures_share_nothing() -> None:
    features = [detect(_picture(seed)) for seed in range(2, 6)]
    assert all(len(matches_between(a, b)) == 0 for k, a in enumerate(features) for b in features[:k])


def test_partners_are_proposed_by_what_is_shared() -> None:
    scene = [_picture(seed, 700) for seed in (7, 8)]
    parts = [scene[0][:, :420], scene[0][:, 200:620], scene[1][:, :420], scene[1][:, 200:620]]
    pairs = propose_pairs([detect(np.ascontiguousarray(part)) for part in parts], partners=1)
    assert pairs == [(0, 1), (2, 3)]


@pytest.mark.slow
def test_a_large_photograph_has_its_features_in_its_own_pixels() -> None:
    small = _picture(9)
    large = np.asarray(cv2.resize(small, (2520, 2520), interpolation=cv2.INTER_CUBIC), np.uint8)
    found = matches_between(detect(small), detect(large))
    first, second = detect(small), detect(large)
    assert len(found) > 60
    at = (first.uv[found[:, 0]] + 0.5) * 6 - 0.5
    assert np.median(np.abs(at - second.uv[found[:, 1]])) < 2.0


def test_a_picture_without_contrast_has_no_features() -> None:
    empty = detect(np.full((80, 90, 3), 77, np.uint8))
    assert len(empty) == 0
    assert len(matches_between(empty, detect(_picture(1)))) == 0


def test_tracks_join_matches_and_leave_out_contradictory_ones() -> None:
    pairs = {
        (0, 1): np.array([[1, 4], [2, 5]]),
        (1, 2): np.array([[4, 7], [6, 8]]),
        (0, 2): np.array([[2, 8], [9, 9]]),  # 0:2 - 1:5 and 0:2 - 2:8 - 1:6: two features in photograph 1
    }
    assert sorted(tracks(pairs)) == [[(0, 1), (1, 4), (2, 7)], [(0, 9), (2, 9)]]


def test_thinned_matches_are_spread_over_the_photograph() -> None:
    rng = np.random.default_rng(3)
    crowd, others = rng.uniform(0, 40, (900, 2)), rng.uniform(0, 640, (100, 2))
    uv = np.concatenate([crowd, others, [[0, 0], [640, 640]]])
    matches = np.stack([np.arange(len(uv))] * 2, axis=1)
    kept = thinned(matches, uv, 150)
    assert len(kept) == 150
    assert np.isin(np.arange(900, 1000), kept[:, 0]).mean() > 0.9
    assert np.array_equal(thinned(matches[:100], uv, 150), matches[:100])
    assert spread(uv, np.ones(len(uv), bool)) > 60


def test_features_that_were_kept_are_used_again(tmp_path: Path) -> None:
    from ladarreg_core.camera import Camera
    from ladarreg_core.photo import Photo
    from ladarreg_core.survey import work

    photo = Photo(_picture(4), Camera.from_focal(420, 420, 400.0))
    files = work.PhotoFiles(id="one", source=photo, key="0" * 64)
    first = work.photo_features(files, tmp_path, 10**9)
    work._held_features.clear()
    lost = work.PhotoFiles(id="one", source=Photo(_picture(5), photo.camera), key="0" * 64)
    again = work.photo_features(lost, tmp_path, 10**9)
    assert isinstance(again, Features)
    assert np.array_equal(first.uv, again.uv)
    assert np.array_equal(first.descriptors, again.descriptors)
