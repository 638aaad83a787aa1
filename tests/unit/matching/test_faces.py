"""Faces of wide photographs: they cover the picture once, and their pixels are the photograph's."""

from __future__ import annotations

from fractions import Fraction
from math import comb

import numpy as np
import pytest

from ladarreg_core.camera import CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.matching.images.faces import FACE_FIELD_RAD, FaceSet, icosahedron
from ladarreg_core.matching.images.structure import structured_cells
from ladarreg_core.matching.verify.agreement import Agreement, joined
from ladarreg_core.photo import Photo

_FISHEYE = FisheyeCamera(400, 400, 120.0, 120.0, 199.5, 199.5, (0.0, 0.0, 0.0, 0.0))


def _photo(camera: CameraModel) -> Photo:
    """Return a photograph whose colours are the direction of each pixel."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.nan_to_num(camera.unproject(np.stack([u, v], axis=-1)))
    return Photo(np.rint(127.5 + 120 * rays).astype(np.uint8), camera)


def test_cones_of_half_a_face_around_the_vertices_cover_the_sphere() -> None:
    rays = np.random.default_rng(0).standard_normal((20_000, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    nearest = (rays @ icosahedron(np.array([0.0, 0.0, 1.0])).T).max(axis=-1)
    assert np.degrees(np.arccos(nearest.min())) < np.degrees(FACE_FIELD_RAD) / 2


@pytest.mark.parametrize("camera", [EquirectangularCamera(720, 360), _FISHEYE], ids=["equirectangular", "fisheye"])
def test_every_pixel_of_a_face_shows_its_own_direction(camera: CameraModel) -> None:
    faces = FaceSet(_photo(camera))
    for face in faces.faces:
        own = np.argwhere(face.own)[:: max(1, int(face.own.sum() // 200))]
        uv = own[:, ::-1].astype(np.float64)
        rays = face.camera.unproject(uv) @ face.face_from_camera.rotation
        shown = face.photo.pixels[own[:, 0], own[:, 1]]
        assert np.abs((shown - 127.5) / 120 - rays).max() < 0.03  # rounding, and the width of a pixel
        there = face.in_photo(uv, face.camera)
        again = camera.unproject(there)
        assert np.abs(again - rays).max() < 1e-9


def test_the_faces_of_a_panorama_share_the_sphere_without_counting_a_direction_twice() -> None:
    faces = FaceSet(_photo(EquirectangularCamera(720, 360)))
    assert len(faces.faces) == 12
    solid = 0.0
    for face in faces.faces:
        camera = face.camera
        v, u = np.nonzero(face.own)
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        solid += float((1 / (1 + x * x + y * y) ** 1.5).sum()) / camera.fx**2
    assert solid == pytest.approx(4 * np.pi, rel=0.01)


def test_only_what_both_halves_of_the_cells_show_is_structure() -> None:
    rng = np.random.default_rng(1)
    gray = rng.normal(100, 10, (120, 240)).astype(np.float32)
    ranges = np.full((120, 240), 3.0, np.float32) + rng.normal(0, 0.002, (120, 240)).astype(np.float32)
    gray[40:80, 150:200] += 80
    found = structured_cells(ranges, gray)
    assert found[60, 150]
    assert found[:, :100].mean() < 0.05


def test_the_regions_of_several_faces_are_counted_together() -> None:
    def part(count: int, at: int) -> Agreement:
        maps = np.zeros((count, 13, 13))
        maps[:, at, at] = 1
        grid = np.zeros((count, 2), np.intp)
        members = tuple(np.array([k]) for k in range(count))
        return Agreement(1, 6, maps, grid, np.full(count, 9), members, np.zeros((count, 2)), np.ones(count, bool), maps)

    both = joined([part(30, 6), part(10, 0)])
    assert both.windows == 40
    assert both.agreeing(3.0).sum() == 30
    assert [int(index[0]) for index in both.members] == list(range(40))
    # more blocks than binomial coefficients of floats allow: the exact tail in whole numbers, chance 1 / 4
    many = joined([part(500, 6), *(part(100, at) for at in (0, 1, 2, 3, 9, 10, 12))])
    tail = Fraction(sum(comb(1200, k) * 3 ** (1200 - k) for k in range(500, 1201)), 4**1200)
    assert many.false_alarm(3.0, least_chance=0.25) == pytest.approx(float(tail), rel=1e-9)
