"""The edge under a drawn line: sub-pixel across it, never along it, and only where there is one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.snapping import PhotoSnapper
from ladarreg_core.matching.features.edges import EdgeOptions, edge_under
from ladarreg_core.photo import Photo

SIDE = 200
MIDDLE = (SIDE - 1) / 2


def picture(*edges: tuple[float, float, float], noise: float = 1.0, seed: int = 0) -> FloatArray:
    """Return an image with straight edges through its middle: (angle, distance from the middle, step) each."""
    v, u = np.mgrid[:SIDE, :SIDE] - MIDDLE
    image = np.full((SIDE, SIDE), 90.0)
    for angle, distance, step in edges:
        across = v * np.cos(angle) - u * np.sin(angle) - distance
        image += step * np.clip(0.5 + across, 0, 1)
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    return np.asarray(image + np.random.default_rng(seed).normal(0, noise, image.shape), dtype=np.float32)


def sampler(image: FloatArray):  # type: ignore[no-untyped-def]
    return lambda at: np.asarray(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR))[None]


def line(angle: float, distance: float, half: float = 60) -> NDArray[np.float64]:
    """Return the ends (2, 2) of a line at an angle, at a distance from the middle."""
    along, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    return MIDDLE + distance * normal + np.array([-half, half])[:, None] * along


def across(ends: FloatArray, angle: float, distance: float) -> NDArray[np.float64]:
    """Return the distances (2,) of ends from the line."""
    return np.asarray((ends - MIDDLE) @ [-np.sin(angle), np.cos(angle)] - distance)


@settings(max_examples=40, deadline=None)
@given(
    angle=st.floats(0, 3.2),
    distance=st.floats(-3, 3),
    step=st.sampled_from([-60.0, 8.0, 100.0]),
    off=st.tuples(st.floats(-3.5, 3.5), st.floats(-3.5, 3.5)),
)
def test_both_ends_move_onto_the_edge_and_not_along_it(
    angle: float, distance: float, step: float, off: tuple[float, float]
) -> None:
    normal = np.array([-np.sin(angle), np.cos(angle)])
    drawn = line(angle, distance) + np.array(off)[:, None] * normal
    found = edge_under(sampler(picture((angle, distance, step))), drawn)
    assert found is not None
    assert np.abs(across(found, angle, distance)).max() < 0.2
    along = np.array([np.cos(angle), np.sin(angle)])
    assert np.abs((found - drawn) @ along).max() < 0.05


@pytest.mark.parametrize("beside_px", [3.5, 5.0, -4.0])
def test_a_strong_edge_beside_a_faint_one_does_not_steal_the_line(beside_px: float) -> None:
    image = picture((0.3, 0.0, 12.0), (0.3, beside_px, 120.0))
    found = edge_under(sampler(image), line(0.3, 0.4))
    assert found is not None
    assert np.abs(across(found, 0.3, 0.0)).max() < 0.3


def test_a_line_out_of_reach_of_every_edge_stays() -> None:
    edge = sampler(picture((0.3, 0.0, 120.0)))
    assert edge_under(edge, line(0.3, 8.0)) is None
    assert edge_under(edge, line(0.3, -8.0)) is None
    one_end_off = line(0.3, 0.0) + np.array([[0, 0], [-8 * np.sin(0.3), 8 * np.cos(0.3)]])
    assert edge_under(edge, one_end_off) is None
    assert edge_under(edge, line(0.3, 8.0), EdgeOptions(reach_px=20, expected_px=5)) is not None


def test_noise_alone_has_no_edge() -> None:
    found = [edge_under(sampler(picture(noise=6.0, seed=k)), line(0.2 * k, 0.0)) for k in range(20)]
    assert sum(each is not None for each in found) == 0


def test_a_line_too_short_or_outside_has_none() -> None:
    image = sampler(picture((0.0, 0.0, 120.0)))
    assert edge_under(image, line(0.0, 0.5, half=4)) is None
    assert edge_under(image, line(0.0, 0.5) + 5000) is None
    assert edge_under(image, [[np.nan, 1], [50, 50]]) is None


def test_an_edge_bent_by_the_lens_is_found_along_its_whole_length() -> None:
    camera = Camera(width=400, height=300, fx=300, fy=300, cx=199.5, cy=149.5, distortion=(-0.25, 0.05, 0, 0))
    v, u = np.mgrid[:300, :400].astype(float)
    rays = camera.unproject(np.stack([u, v], axis=-1))
    height = rays[..., 1] / rays[..., 2] + 0.3  # a horizontal edge near the upper border
    gray = np.clip(60 + 120 * np.clip(0.5 + 300 * height, 0, 1), 0, 255).astype(np.uint8)
    photo = Photo(np.repeat(gray[..., None], 3, axis=-1), camera)
    true = camera.project(np.array([[-0.5, -0.3, 1.0], [0.5, -0.3, 1.0]]))
    middle = camera.project(np.array([0.0, -0.3, 1.0]))
    assert abs(true[:, 1].mean() - middle[1]) > 4, "a straight line would miss it"
    found = PhotoSnapper.of(photo).line(true + np.array([[0.2, 2.0], [-0.1, -1.5]]))
    assert found is not None
    assert np.abs(found[:, 1] - true[:, 1]).max() < 0.3
